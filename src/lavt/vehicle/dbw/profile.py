"""A profile: how one kind of by-wire kit is spoken to, already checked against its DBC. Units and signs are here.

On the bus the angle is the steering wheel's; here it is the road wheels', left positive. Pedals are fractions.
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

LEAST_GAP_NS = 5 * NS_PER_MS
"""Commands that change leave no closer to each other."""
PERIOD_NS = 20 * NS_PER_MS
"""Commands leave no further from each other: 50 Hz, the vendor's demo. The kit wants one within 100 ms."""
CLEARING_PERIOD_NS = 50 * NS_PER_MS
"""20 Hz, as the facts have it."""
COMMAND_TIMEOUT_NS = 100 * NS_PER_MS
"""A kit lets go so long after its last command."""
TICK_LIMIT_NS = 60 * NS_PER_MS
"""Nothing leaves that was asked for longer ago."""

IN_DEGREES = {"deg": 1.0, "rad": math.radians(1.0)}
IN_FRACTIONS = {"": 1.0, "%": 100.0}
IN_METRES_PER_SECOND = {"m/s": 1.0, "km/h": 3.6}
IN_DEGREES_PER_SECOND = {"": 1.0, "deg/s": 1.0, "rad/s": math.radians(1.0)}
"""What one of ours is in a unit of a DBC; units that are not here are refused."""


@dataclass(frozen=True, slots=True)
class AxisCommand:
    """How an axis is commanded; an empty name: there is no such signal."""

    message: str
    value: str
    per_unit: float
    """Of the DBC's unit: for one degree of the steering wheel, or one whole pedal."""
    constants: Mapping[str, float]
    """Signals that are always the same: the type of command, the greatest rate."""
    enable: str
    clear: str
    count: str
    modulus: int
    """Of the counter."""
    checksum: str


@dataclass(frozen=True, slots=True)
class GearCommand:
    """How a gear is asked for."""

    message: str
    value: str
    clear: str
    numbers: Mapping[Gear, int]
    checksum: str


@dataclass(frozen=True, slots=True)
class SystemCommand:
    """How the kit as a whole is enabled and disabled."""

    message: str
    value: str
    enable: int
    disable: int
    count: str
    modulus: int
    checksum: str


@dataclass(frozen=True, slots=True)
class SignalCondition:
    """A signal that means something: where it is `number`, or anything but 0 where that is None."""

    signal: str
    number: int | None
    words: str


@dataclass(frozen=True, slots=True)
class ReportSpec:
    """How a report is read."""

    part: str
    """What it is about."""
    timeout_ns: int
    values: Mapping[str, str]
    """Our word: the signal."""
    no_value: Mapping[str, float]
    """Our word: what stands for none, in the DBC's unit. The lowest number of a signed signal does, though generation
    2's facts do not say so."""
    override: tuple[SignalCondition, ...]
    trip: tuple[SignalCondition, ...]
    lapse: tuple[SignalCondition, ...]
    fault: tuple[SignalCondition, ...]
    needs: Mapping[str, frozenset[int]]
    reasons: tuple[str, ...]
    """Signals that tell why something is refused; 0 is no reason."""
    checksum: str


@dataclass(frozen=True, slots=True)
class OwnBrake:
    """The kit brakes by itself where a report's signal is more than `above` and its brake is not enabled."""

    message: str
    signal: str
    above: float


@dataclass(frozen=True, slots=True)
class ByWireCar:
    """The car that the kit is in."""

    wheelbase_m: float
    steering_ratio: float
    steering_sign: Literal[1, -1] | None
    """1: left is positive on the bus; None: not known."""
    max_acceleration_mps2: float
    max_braking_mps2: float


@dataclass(frozen=True, slots=True)
class ByWireLimits:
    """What is never exceeded on the bus; rates of pedals are of pressing."""

    steering_wheel_deg: float
    steering_wheel_rate_degps: float
    throttle: float
    brake: float
    throttle_rate_per_s: float
    brake_rate_per_s: float
    holding_brake: float


@dataclass(frozen=True, slots=True)
class Profile:
    """How one kind of kit is spoken to, and the messages to do so."""

    name: str
    kit: Literal["dataspeed_1", "dataspeed_2"]
    commands: Literal["remote", "user"] | None
    """Which of the kit's sets of commands; None: it has one."""
    car: ByWireCar
    limits: ByWireLimits
    command_step_deg: float
    axes: Mapping[Axis, AxisCommand]
    gear: GearCommand
    system: SystemCommand | None
    clearing_bytes: int | None
    reports: Mapping[str, ReportSpec]
    """By message."""
    watchdog: OwnBrake | None
    """How it is seen that the kit's watchdog brakes; None: it is not."""
    speed_per_mps: float
    """Of the reported speed's unit."""
    angle_per_deg: float
    unverified: tuple[str, ...]
    """Of the signals that are used, those whose place is an assumption: `message.signal`."""
    codec: Codec

    def wheel_deg(self, road_rad: float) -> float:
        """Give the steering wheel's angle on the bus for the road wheels' angle."""
        return math.degrees(road_rad) * self.car.steering_ratio * (self.car.steering_sign or 1)

    def road_rad(self, wheel_deg: float) -> float:
        """Give the road wheels' angle for the steering wheel's angle on the bus."""
        return math.radians(wheel_deg) / self.car.steering_ratio * (self.car.steering_sign or 1)
