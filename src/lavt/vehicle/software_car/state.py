"""What a by-wire kit knows: the orders it got, its actuators, the people in the car, and the car itself.

Angles and torques are those of the steering wheel, left positive; pedals are fractions, 0 to 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final, Literal

from lavt.value import value

Axis = Literal["steering", "brake", "throttle"]
AXES: Final[tuple[Axis, ...]] = ("steering", "brake", "throttle")

STATIONARY_BELOW_MPS = 0.1
"""Ours: below it the car stands."""
OVERRIDE_PEDAL: Final = 0.05
"""Ours: from where on a foot is an override. So much brake is also what a shift needs."""


class Gear(IntEnum):
    """Gears by the number they have in both generations."""

    NONE = 0
    PARK = 1
    REVERSE = 2
    NEUTRAL = 3
    DRIVE = 4
    LOW = 5


class GearRejection(IntEnum):
    """Why a gear was refused."""

    NONE = 0
    IN_PROGRESS = 1
    OVERRIDE = 2
    VEHICLE = 5
    UNSUPPORTED = 6
    FAULT = 7


class SystemState(IntEnum):
    """State of a kit of generation 2."""

    MANUAL = 0
    READY = 1
    ACTIVE = 2
    FAULT = 7


class ReleaseReason(IntEnum):
    """Why a kit let go, or is not ready.

    The facts name those up to the lockouts and give no numbers: they are counted in the order of the names.
    The rest are the kit's own and not reported. The tenth, a delay before engaging again, is not played: no fact
    tells its length.
    """

    NONE = 0
    TIMEOUT = 1
    CRC = 2
    COUNTER = 3
    OVERRIDE = 4
    SEAT_BELT = 5
    DOOR = 6
    LOCKOUT_SPEED = 7
    LOCKOUT_ACCELERATION = 8
    LOCKOUT_REVERSE = 9
    REQUESTED = 11
    DISABLED = 12
    """A command came without its enable bit."""
    FAULT = 13
    REMOTE = 14
    """The remote's switch is at emergency stop or pause."""


@value
class Order:
    """A command for an actuator, whatever generation it came by."""

    axis: Axis
    is_valid: bool
    """Its checksum is right, where it has one."""
    target: float = 0.0
    """Steering wheel angle in rad, or a pedal's fraction."""
    is_enabling: bool = False
    is_clearing: bool = False
    ignores_driver: bool = False
    rate_radps: float = 0.0
    """How fast the steering wheel may turn."""
    count: int | None = None
    """None: the frame has no counter, and asks only to clear."""


@value
class GearOrder:
    """A command for the gearbox."""

    is_valid: bool
    gear: int
    is_clearing: bool = False


@value
class SystemOrder:
    """A command to a kit of generation 2 as a whole."""

    is_valid: bool
    request: int
    """0 nothing, 1 enable, 2 disable."""
    count: int


@dataclass(slots=True)
class Actuator:
    """One axis."""

    order: Order | None = None
    """The newest valid one, until it times out."""
    heard_ns: int = 0
    count: int | None = None
    """Of the newest frame with a right checksum."""
    is_enabled: bool = False
    driver_acts: bool = False
    is_overridden: bool = False
    """Latched."""
    has_timed_out: bool = False
    is_crc_bad: bool = False
    is_count_bad: bool = False
    faults: set[str] = field(default_factory=set)

    @property
    def may_be_enabled(self) -> bool:
        """Whether its own orders and state allow it."""
        order = self.order
        return order is not None and order.is_enabling and not self.is_overridden and not self.faults


@dataclass(slots=True)
class KitState:
    """Everything that reports are made of."""

    actuators: dict[Axis, Actuator] = field(default_factory=lambda: {axis: Actuator() for axis in AXES})
    # The car, as the simulator tells it.
    speed_mps: float = 0.0
    wheel_rad: float = 0.0
    """Angle of the steering wheel."""
    invalid: set[str] = field(default_factory=set)
    """Which of `angle`, `speed`, `wheel_speed` are reported as unknown."""
    # The people in it.
    driver_torque_nm: float = 0.0
    driver_brake: float = 0.0
    driver_throttle: float = 0.0
    # What goes to the wheels.
    held_rad: float = 0.0
    """Where the kit has the steering wheel."""
    brake: float = 0.0
    throttle: float = 0.0
    # The gearbox.
    gear: Gear = Gear.PARK
    gear_order: int = 0
    gear_reject: GearRejection = GearRejection.NONE
    is_gear_overridden: bool = False
    gear_faults: set[str] = field(default_factory=set)
    # The kit as a whole.
    system: SystemState = SystemState.MANUAL
    disengaged: ReleaseReason = ReleaseReason.NONE
    not_ready: ReleaseReason = ReleaseReason.NONE
    watchdog: ReleaseReason = ReleaseReason.NONE
    """Why the watchdog tripped; latched until it is cleared after somebody has taken over."""
    watchdog_axis: Axis | None = None
    watchdog_brakes: bool = False
    remote_state: int = 2
    sent: dict[int, int] = field(default_factory=dict)
    """How often each report was sent."""

    @property
    def is_stationary(self) -> bool:
        """Whether the car stands."""
        return abs(self.speed_mps) < STATIONARY_BELOW_MPS

    @property
    def is_in_gear(self) -> bool:
        """Whether the engine could move the car."""
        return self.gear in {Gear.REVERSE, Gear.DRIVE, Gear.LOW}

    @property
    def is_overridden(self) -> bool:
        """Whether the driver has taken anything over."""
        return self.is_gear_overridden or any(actuator.is_overridden for actuator in self.actuators.values())
