"""A profile describes how to control one kind of by-wire kit. `lavt.assembly.dbw` has checked it against its DBC.

This module converts units and signs. The bus has the steering wheel's angle; LAVT has the road wheels' angle, left
positive. Pedals are fractions.
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
"""Names of the reported speeds. Only `speed` is used to drive; the others are compared with it."""

LEAST_GAP_NS = 5 * NS_PER_MS
"""Shortest time between two sets of frames; it applies when the commands change."""
REPEAT_PERIOD_NS = 20 * NS_PER_MS
"""Unchanged commands are repeated with this period: 50 Hz, as in the vendor's demo. The kit needs one within 100 ms."""
CLEARING_PERIOD_NS = 50 * NS_PER_MS
"""Period of the frames that clear overrides: 20 Hz, as in the published sources (docs/can.md)."""
COMMAND_TIMEOUT_NS = 100 * NS_PER_MS
"""A kit disengages this long after its last command."""
TICK_LIMIT_NS = 60 * NS_PER_MS
"""The adapter does not send a command that was requested longer ago, and the bus's port does not write it: the program
may have been frozen since."""

IN_DEGREES = {"deg": 1.0, "rad": math.radians(1.0)}
IN_FRACTIONS = {"": 1.0, "%": 100.0}
IN_METRES_PER_SECOND = {"m/s": 1.0, "km/h": 3.6}
IN_RADIANS_PER_SECOND = {"rad/s": 1.0, "deg/s": math.degrees(1.0)}
IN_DEGREES_PER_SECOND = {"": 1.0, "deg/s": 1.0, "rad/s": math.radians(1.0)}
"""For each table: one unit of LAVT in the units that a DBC may have. Other units are rejected."""


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
    """The value of the signal for each gear."""
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
    """A condition on a signal: it equals `number`, or is not 0 if `number` is None."""

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
    """Signal names by value name."""
    no_value: Mapping[str, float]
    """By value name: the number that means "not known", in the DBC's unit. It is the lowest number of a signed signal;
    for generation 2 this is our assumption."""
    override: tuple[SignalCondition, ...]
    """The conditions that mean an override by the driver; the next three fields are of the same kind."""
    trip: tuple[SignalCondition, ...]
    command_error: tuple[SignalCondition, ...]
    fault: tuple[SignalCondition, ...]
    needs: Mapping[str, frozenset[int]]
    """By signal: the values that it must have; any other value is a fault."""
    reasons: tuple[str, ...]
    """Signals with the reason for a rejection; 0 means no reason."""
    count: str
    checksum: str


@dataclass(frozen=True, slots=True)
class OwnBrake:
    """Evidence that the kit brakes by itself: `signal` is more than `above` while the brake is not enabled."""

    message: str
    signal: str
    above: float


@dataclass(frozen=True, slots=True)
class ByWireCar:
    """Properties of the car with the kit."""

    wheelbase_m: float
    steering_ratio: float
    steering_sign: Literal[1, -1] | None
    """1: left is positive on the bus; None: unknown."""
    wheel_radius_m: float
    max_acceleration_mps2: float
    max_braking_mps2: float


@dataclass(frozen=True, slots=True)
class ByWireLimits:
    """Limits on everything sent to the bus; pedal rates limit pressing, not releasing."""

    steering_wheel_deg: float
    steering_wheel_rate_degps: float
    throttle: float
    brake: float
    throttle_rate_per_s: float
    brake_rate_per_s: float
    holding_brake: float
    """The least brake while the kit is enabled before driving, and while the car is parked after driving."""


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
    """Length of the frames that clear overrides; None: as long as other commands."""
    reports: Mapping[str, ReportSpec]
    """By message name."""
    watchdog: OwnBrake | None
    """How to detect that the kit's watchdog brakes; None if that is not possible."""
    speeds_per_mps: Mapping[str, float]
    """By value name, one of `SPEEDS`: converts m/s into the unit of a reported speed. A kit has at least `speed`."""
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
