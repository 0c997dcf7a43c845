"""The state of a by-wire kit: its actuators, its gearbox, the driver, and the car.

An order is a command that the kit received. Angles and torques are those of the steering wheel, left positive; pedals
are fractions, 0 to 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final, Literal

from msgspec import Struct

from lavt.vehicle.software_car.sensor_faults import SensorFaults

Axis = Literal["steering", "brake", "throttle"]
AXES: Final[tuple[Axis, ...]] = ("steering", "brake", "throttle")

STATIONARY_BELOW_MPS = 0.1
"""Our choice: the car is stationary if it is slower than this."""
MIN_PRESSED_PEDAL: Final = 0.05
"""Our choice: the smallest fraction at which a pedal counts as pressed. A pedal that the driver presses is an override.
The gearbox shifts only while the brake is pressed."""


class Gear(IntEnum):
    """Gears with their numbers, which are the same in both generations."""

    NONE = 0
    PARK = 1
    REVERSE = 2
    NEUTRAL = 3
    DRIVE = 4
    LOW = 5


class GearRejection(IntEnum):
    """Why a gear order was rejected."""

    NONE = 0
    IN_PROGRESS = 1
    OVERRIDE = 2
    BRAKE_OR_MOTION = 5
    """The brake is not pressed, or the car moves."""
    UNSUPPORTED = 6
    FAULT = 7


class SystemState(IntEnum):
    """The state of a kit of generation 2 as a whole."""

    MANUAL = 0
    READY = 1
    ACTIVE = 2
    FAULT = 7


class ReleaseReason(IntEnum):
    """Why a kit released its axes, or is not ready.

    The names of the reasons up to the lockouts are published, but not their codes; here the codes follow the order of
    the names. The reasons after the lockouts are internal to the kit and not reported. Code 10 is missing: the tenth
    published reason is a delay before engaging again, which is not simulated, because its length is not published.
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
    """A command came without its enable bit, or none came."""
    FAULT = 13
    REMOTE = 14
    """The remote's switch is at emergency stop or pause."""


class AxisOrder(Struct, frozen=True):
    """An order to an axis, of either generation."""

    axis: Axis
    is_valid: bool
    """Whether the checksum is right; True without a checksum."""
    target: float = 0.0
    """Steering wheel angle in rad, or a pedal as a fraction."""
    is_enabling: bool = False
    """Whether the order has the enable bit and a known type."""
    is_clearing: bool = False
    """Whether the order clears an override, and the watchdog."""
    ignores_driver: bool = False
    """Whether actions of the driver are no override."""
    rate_radps: float = 0.0
    """The largest rate of the steering wheel."""
    count: int | None = None
    """The counter; None for a frame without one, which can only clear."""


class GearOrder(Struct, frozen=True):
    """An order to the gearbox."""

    is_valid: bool
    gear: int
    is_clearing: bool = False


class SystemOrder(Struct, frozen=True):
    """An order to a kit of generation 2 as a whole."""

    is_valid: bool
    request: int
    """0 nothing, 1 enable, 2 disable."""
    count: int


@dataclass(slots=True)
class Actuator:
    """The state of an axis."""

    order: AxisOrder | None = None
    """The newest valid order; None before the first one, and after it has timed out."""
    received_ns: int = 0
    """Time of the newest valid order."""
    count: int | None = None
    """The counter of the newest frame with a right checksum."""
    is_enabled: bool = False
    driver_acts: bool = False
    """Whether the driver acts on the axis now."""
    is_overridden: bool = False
    """Whether the driver has overridden the axis; True until the override is cleared."""
    has_timed_out: bool = False
    is_crc_bad: bool = False
    is_count_bad: bool = False
    faults: set[str] = field(default_factory=set)

    @property
    def may_be_enabled(self) -> bool:
        """Whether order and state allow the axis to be enabled."""
        order = self.order
        return order is not None and order.is_enabling and not self.is_overridden and not self.faults


@dataclass(slots=True)
class KitState:
    """The state from which reports are made."""

    actuators: dict[Axis, Actuator] = field(default_factory=lambda: {axis: Actuator() for axis in AXES})
    # The car, as reported by the simulator.
    speed_mps: float = 0.0
    wheel_rad: float = 0.0
    """Angle of the steering wheel."""
    invalid: set[str] = field(default_factory=set)
    """Values reported as unknown: `angle`, `speed`, `wheel_speed`."""
    sensor_faults: SensorFaults = field(default_factory=SensorFaults)
    brake_share: float = 1.0
    """Share of the brake's force that reaches the wheels; it is in no report."""
    # The driver.
    driver_torque_nm: float = 0.0
    driver_brake: float = 0.0
    driver_throttle: float = 0.0
    # The actuation.
    setpoint_rad: float = 0.0
    """The kit's setpoint for the steering wheel's angle."""
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
    disengage_reason: ReleaseReason = ReleaseReason.NONE
    not_ready_reason: ReleaseReason = ReleaseReason.NONE
    watchdog_reason: ReleaseReason = ReleaseReason.NONE
    """Why the watchdog tripped; kept until the watchdog is cleared, after the driver has ended its braking."""
    watchdog_axis: Axis | None = None
    watchdog_brakes: bool = False
    remote_state: int = 2
    """State of the remote's switch, one of `REMOTE_STATES` in `console_commands.py`."""
    sent: dict[int, int] = field(default_factory=dict)
    """Number of frames sent, by identifier."""

    @property
    def is_stationary(self) -> bool:
        """Whether the car is stationary."""
        return abs(self.speed_mps) < STATIONARY_BELOW_MPS

    def reported_mps(self, source: str) -> float:
        """Return the speed that `source`, one of `SPEED_SOURCES`, reports."""
        return self.sensor_faults.reported_mps(source, self.speed_mps)

    @property
    def is_in_gear(self) -> bool:
        """Whether the gear transmits power."""
        return self.gear in {Gear.REVERSE, Gear.DRIVE, Gear.LOW}

    @property
    def is_overridden(self) -> bool:
        """Whether the driver overrides an axis or the gear."""
        return self.is_gear_overridden or any(actuator.is_overridden for actuator in self.actuators.values())
