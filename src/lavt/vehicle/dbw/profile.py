"""A profile describes how to control one kind of by-wire kit. `lavt.assembly.dbw` has checked it against its DBC.

This module also converts angles: on the bus there is the angle of the steering wheel, and in LAVT the angle of the road
wheels, left positive. Pedals are fractions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from lavt.domain import NS_PER_MS
from lavt.vehicle.dbw.codec import Codec

Axis = Literal["steering", "brake", "throttle"]
AXES: tuple[Axis, ...] = ("steering", "brake", "throttle")
Gear = Literal["park", "reverse", "neutral", "drive"]

VEHICLE_SPEEDS = ("speed", "second_speed")
WHEEL_SPEEDS = ("wheel_1", "wheel_2", "wheel_3", "wheel_4")
SPEEDS = (*VEHICLE_SPEEDS, *WHEEL_SPEEDS)
"""Names of the reported speeds. Only `speed` is used to drive; the other speeds are compared with it."""

LEAST_GAP_NS = 5 * NS_PER_MS
"""Shortest time between two sets of frames, if the second set has another drive command."""
REPEAT_PERIOD_NS = 20 * NS_PER_MS
"""Period at which an unchanged drive command is repeated: 50 Hz, as in the vendor's demo. A kit needs a command every
100 ms."""
CLEARING_PERIOD_NS = 50 * NS_PER_MS
"""Period of the frames that clear overrides: 20 Hz, as in the published sources (docs/can.md)."""
COMMAND_TIMEOUT_NS = 100 * NS_PER_MS
"""The time after the last command when a kit disengages."""
TICK_LIMIT_NS = 60 * NS_PER_MS
"""The largest age of a command. The adapter does not send an older command, and the port does not write an older frame,
because the program was possibly frozen."""

IN_DEGREES = {"deg": 1.0, "rad": math.radians(1.0)}
IN_FRACTIONS = {"": 1.0, "%": 100.0}
IN_METRES_PER_SECOND = {"m/s": 1.0, "km/h": 3.6}
IN_RADIANS_PER_SECOND = {"rad/s": 1.0, "deg/s": math.degrees(1.0)}
IN_DEGREES_PER_SECOND = {"": 1.0, "deg/s": 1.0, "rad/s": math.radians(1.0)}
"""In each of these tables: the value of one degree, fraction, m/s, rad/s or deg/s in each unit that a DBC is allowed to
have. Other units are rejected."""


@dataclass(frozen=True, slots=True)
class AxisCommand:
    """The signals that command an axis; an empty name means that the kit has no such signal."""

    message: str
    value: str
    per_unit: float
    """One degree of the steering wheel, or one full pedal, in the DBC's unit."""
    constants: Mapping[str, float]
    """Values of signals that never change: the command type, the maximum rate."""
    enable: str
    clear: str
    count: str
    modulus: int
    """The counter counts modulo this number."""
    checksum: str


@dataclass(frozen=True, slots=True)
class GearCommand:
    """The signals that command a gear."""

    message: str
    value: str
    clear: str
    codes: Mapping[Gear, int]
    """The value of the signal `value` for each gear."""
    checksum: str


@dataclass(frozen=True, slots=True)
class SystemCommand:
    """The signals that enable and disable the kit as a whole."""

    message: str
    value: str
    enable: int
    disable: int
    count: str
    modulus: int
    checksum: str


@dataclass(frozen=True, slots=True)
class SignalCondition:
    """A condition on a signal: the signal equals `number` or, if `number` is None, is not 0."""

    signal: str
    number: int | None
    text: str
    """The text for people if the condition is met."""


@dataclass(frozen=True, slots=True)
class ReportSpec:
    """The signals of a report."""

    part: str
    """The part of the kit that the report describes."""
    timeout_ns: int
    values: Mapping[str, str]
    """The names of signals, by name of the value that the signal has (`speed`, `angle`, ...)."""
    no_value: Mapping[str, float]
    """By name of the value: the number that means "not known", in the DBC's unit. It is the lowest number of a signed
    signal; for generation 2 this is our assumption."""
    override: tuple[SignalCondition, ...]
    """The conditions that mean an override by the driver."""
    trip: tuple[SignalCondition, ...]
    """The conditions that mean that the kit's watchdog has tripped."""
    command_error: tuple[SignalCondition, ...]
    """The conditions that mean a late or invalid command."""
    fault: tuple[SignalCondition, ...]
    """The conditions that mean a fault."""
    needs: Mapping[str, frozenset[int]]
    """By name of the signal: the values that the signal must have; any other value is a fault."""
    reasons: tuple[str, ...]
    """Names of the signals with the reason for a rejection; 0 means no reason."""
    count: str
    checksum: str


@dataclass(frozen=True, slots=True)
class OwnBrake:
    """The sign that the kit brakes on its own: `signal` is greater than `above` although the brake is not enabled."""

    message: str
    signal: str
    above: float


@dataclass(frozen=True, slots=True)
class ByWireCar:
    """Properties of the car with the kit."""

    wheelbase_m: float
    steering_ratio: float
    steering_sign: Literal[1, -1] | None
    """1 if left is positive on the bus, -1 if right is; None if unknown."""
    wheel_radius_m: float
    max_acceleration_mps2: float
    max_braking_mps2: float


@dataclass(frozen=True, slots=True)
class ByWireLimits:
    """Limits on everything that is sent to the bus. The rates of pedals limit pressing, not releasing."""

    steering_wheel_deg: float
    steering_wheel_rate_degps: float
    throttle: float
    brake: float
    throttle_rate_per_s: float
    brake_rate_per_s: float
    holding_brake: float
    """The smallest brake when the kit is enabled before driving, and when the car is parked after driving."""


@dataclass(frozen=True, slots=True)
class Profile:
    """A by-wire kit, its limits and its messages."""

    name: str
    kit: Literal["dataspeed_1", "dataspeed_2"]
    commands: Literal["remote", "user"] | None
    """The command set in use; None if the kit has only one."""
    car: ByWireCar
    limits: ByWireLimits
    command_step_deg: float
    """One step of the steering command that the kit reports."""
    axes: Mapping[Axis, AxisCommand]
    gear: GearCommand
    system: SystemCommand | None
    clearing_bytes: int | None
    """Length of the frames that clear overrides; None if they are as long as other commands."""
    reports: Mapping[str, ReportSpec]
    """The reports by message name."""
    watchdog: OwnBrake | None
    """How to detect that the kit's watchdog brakes; None if that is not possible."""
    speeds_per_mps: Mapping[str, float]
    """By name of the speed, one of `SPEEDS`: 1 m/s in the unit of the reported speed. A kit has at least `speed`."""
    angle_per_deg: float
    """One degree in the unit of the reported angle."""
    unverified: tuple[str, ...]
    """Names, as `message.signal`, of the signals in use whose position is an assumption."""
    codec: Codec

    def wheel_deg(self, road_rad: float) -> float:
        """Convert a road-wheel angle to the steering wheel's angle on the bus."""
        return math.degrees(road_rad) * self.car.steering_ratio * (self.car.steering_sign or 1)

    def road_rad(self, wheel_deg: float) -> float:
        """Convert a steering-wheel angle on the bus to the road wheels' angle."""
        return math.radians(wheel_deg) / self.car.steering_ratio * (self.car.steering_sign or 1)
