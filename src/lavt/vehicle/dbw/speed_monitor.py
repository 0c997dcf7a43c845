"""Check whether the reported speeds are plausible, given each other, the pedals, and what a car can do.

A kit reports `speed`, which is used to drive, and possibly other speeds to compare it with: a second speed and the
speeds of the wheels. If all of them come from one control unit, they can be wrong together; the checks against the
pedals detect this. An implausible speed is a fault until two conditions are met: the fault has lasted for
`FULL_BRAKE_NS`, and the car has been stationary for `STANDSTILL_NS`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Final

from msgspec import Struct

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.dbw.profile import COMMAND_TIMEOUT_NS
from lavt.vehicle.dbw.states import STATIONARY_BELOW_MPS

MAX_FALL_MPS2: Final = 12.0
"""No car brakes harder than this, 1.22 g: road tyres on dry asphalt reach 1.0 to 1.1 g."""
MAX_DROP_MPS: Final = 2.5
"""A fall by `MAX_FALL_MPS2` gives the lowest plausible speed. A speed that is lower by more than this tolerance is a
fault. Lower speeds are real in two cases: anti-lock brakes let wheels lock at less than about 2 m/s, and wheels that
spun regain grip between two reports."""
LOCKED_DROP_MPS: Final = 0.5
"""A speed that is lower than the lowest plausible speed by more than this is that of locked wheels, or wrong."""
ICE_BRAKING_MPS2: Final = 1.0
"""The smallest deceleration of a braked car on ice."""
SURE_BRAKE_SHARE: Final = 0.25
"""Our choice: a brake reaches at least this share of its configured deceleration. A car that possibly slides, or has
driven off unnoticed, is stationary only after it would have stopped even with this share, and even on ice."""
DISAGREEMENT_MPS: Final = 1.0
DISAGREEMENT_SHARE: Final = 0.2
"""Two speeds differ if their difference is more than 1 m/s plus a fifth of the larger speed. Smaller differences are
normal: wheels with anti-lock control slip by 10 to 20 %, and the radius of a tyre is known to a few per cent."""
DISAGREEMENT_NS: Final = 500 * NS_PER_MS
"""Speeds that differ for less than this time are no fault: anti-lock control cycles at 3 Hz or faster, and so does
traction control."""
SOURCE_LIMIT_NS: Final = 200 * NS_PER_MS
"""A speed whose report is older than this is not compared. The absence of a report that the kit must send inhibits
driving anyway."""
MIN_CHECKED_BRAKE_MPS2: Final = 3.0
"""The effect of the brake is checked if the pedal should decelerate the car by at least this much. The car then becomes
slower even on a descent of 20 % (2 m/s2)."""
BRAKE_SETTLING_NS: Final = 500 * NS_PER_MS
"""Dead time and lag of the brake, and of a throttle that was pressed before the brake. The check of the brake begins
after this time."""
BRAKE_CHECK_NS: Final = NS_PER_S
"""Duration of a check of the brake."""
MIN_SPEED_LOSS_MPS: Final = 0.2
"""During `BRAKE_CHECK_NS` a braked car must become slower by this much. On ice it becomes slower by 1 m/s."""
MIN_CHECKED_SPEED_MPS: Final = 1.0
"""The brake is not checked if the car is slower than this."""
CONSTANT_WITHIN_MPS: Final = 0.005
"""A speed is constant if it changes by at most this much: kits report steps of 0.01 km/h, which is 0.003 m/s."""
MOVING_ABOVE_MPS: Final = 0.5
"""A constant speed is checked as frozen if it is above this limit, otherwise as that of a car that does not start."""
FROZEN_ACCELERATION_MPS2: Final = 0.4
"""A throttle for this acceleration makes a car on a level road faster, because drag at less than 40 km/h is smaller (in
the simulator at most 0.12 m/s2)."""
FROZEN_NS: Final = 2 * NS_PER_S
"""A constant speed under throttle is frozen after this time. On a slope weight and drag can balance the throttle, but
the speed of a real car is never constant for so long."""
ROLLING_RESISTANCE_MPS2: Final = 0.1
"""Deceleration of a rolling car on a level road, 1 % of its weight. It reduces the effect of the throttle.
If the kit has released the brake, a car that has driven off unnoticed becomes slower by this deceleration only."""
UNANSWERED_MPS: Final = 2.7
"""The car does not start if its reported speed stays constant although the throttle would have given it this speed. The
slope is too steep, a wheel is blocked, or the car moves and the reported speed is wrong. Each of these ends the drive.
A car that reaches 2 m/s2 has 1.4 s to start at full throttle, and 3 s at half throttle."""
FULL_BRAKE_NS: Final = 8 * NS_PER_S
"""A fault lasts for at least this long. Meanwhile the adapter brakes fully. A deceleration of 1.4 m/s2, a quarter of
what the brakes should reach, stops a car from 40 km/h in this time."""
STANDSTILL_NS: Final = NS_PER_S
"""The car must be stationary for this long."""


class SpeedFault(StrEnum):
    """Why the reported speed is implausible; the values are the shown texts."""

    FALL = "speed_fall: the speed fell faster than brakes can slow a car"
    DISAGREEMENT = "speed_disagreement: the reported speeds differ"
    NO_BRAKING = "speed_unbraked: the speed does not answer the brake"
    FROZEN = "speed_frozen: the speed does not change under throttle"
    NO_START = "speed_no_start: the car does not start under throttle"

    @property
    def code(self) -> str:
        """A word for counters and logs."""
        return self.value.partition(":")[0]


class SpeedReport(Struct, frozen=True):
    """A reported speed and the time when it arrived."""

    mps: float
    mono_ns: int


class Pedals(Struct, frozen=True):
    """The pedals that the kit is applying, as fractions."""

    throttle: float
    brake: float
    is_brake_axis_released: bool = False
    """Whether the kit has disabled the brake axis. It is then unknown whether the kit's watchdog or a driver brakes."""


class SpeedMonitor:
    """A monitor of the reported speeds. Call `update` after each report and regularly.

    A report can be processed after an update for a later time; then the later time counts. The accelerations are the
    car's at full pedals.
    """

    def __init__(self, *, max_acceleration_mps2: float, max_braking_mps2: float) -> None:
        self._max_acceleration_mps2, self._max_braking_mps2 = max_acceleration_mps2, max_braking_mps2
        self.fault: SpeedFault | None = None
        self._fault_ns = 0
        self._speeds: Mapping[str, SpeedReport] = {"speed": SpeedReport(0.0, 0)}
        self._checked = SpeedReport(0.0, 0)
        """The newest `speed` that was checked for a fall."""
        self._least_mps = 0.0
        """The lowest speed that the car can have now, given the speeds reported earlier."""
        self._now_ns = 0
        self._moved_ns = -STANDSTILL_NS
        """Time of the last update at which the car possibly moved."""
        self._sliding_mps = 0.0
        """The speed that the car has now if its wheels have slipped since they last rolled without brake."""
        self._may_slide = False
        """Whether the speed fell as that of locked wheels, and the car has possibly not stopped since then."""
        self._throttled_mps = 0.0
        """The speed that the throttle can have given the car on a level road since the reported speed last changed."""
        self._changed_mps = 0.0
        """The reported speed at its last change."""
        self._agreed_ns: int | None = None
        """Time of the last update at which the speeds did not differ."""
        self._brake_reference: SpeedReport | None = None
        """The speed with which the present check of the brake began, and the time when the brake began to settle."""
        self._frozen_reference: SpeedReport | None = None
        """The speed at its last change under throttle, and the time of this change."""

    @property
    def is_stationary(self) -> bool:
        """Whether every reported speed is that of a stationary car that neither slides nor has driven off unnoticed."""
        return self._moved_ns < self._now_ns

    @property
    def speed_mps(self) -> float:
        """The speed to drive with.

        It is `speed`, or the largest of all speeds if `speed` is implausible or that of a stationary car.
        """
        speed_mps = self._speeds["speed"].mps
        if self.fault is None and abs(speed_mps) >= STATIONARY_BELOW_MPS:
            return speed_mps
        return max((report.mps for report in self._speeds.values()), key=abs)

    def update(self, speeds: Mapping[str, SpeedReport], pedals: Pedals, now_ns: int) -> SpeedFault | None:
        """Process the newest speeds (by name) and the pedals; return a fault that begins now, or None."""
        now_ns = max(now_ns, self._now_ns)
        passed_ns = min(now_ns - self._now_ns, COMMAND_TIMEOUT_NS)  # a kit releases the throttle after this time
        self._speeds, self._now_ns = speeds, now_ns
        self._update_throttled(pedals, passed_ns / NS_PER_S)
        has_fallen = self._has_fallen(speeds["speed"])
        self._update_sliding(pedals, passed_ns / NS_PER_S)
        may_move = self._may_slide or self._throttled_mps >= STATIONARY_BELOW_MPS
        if may_move or any(abs(report.mps) >= STATIONARY_BELOW_MPS for report in speeds.values()):
            self._moved_ns = now_ns
        checks = (
            (SpeedFault.FALL, has_fallen),
            (SpeedFault.DISAGREEMENT, self._disagrees(now_ns)),
            (SpeedFault.NO_BRAKING, self._is_unbraked(pedals.brake, now_ns)),
            (SpeedFault.FROZEN, self._is_frozen(pedals, now_ns)),
            (SpeedFault.NO_START, self._throttled_mps >= UNANSWERED_MPS),
        )
        found = next((fault for fault, is_present in checks if is_present), None)
        if self.fault is not None:
            if now_ns - self._fault_ns >= FULL_BRAKE_NS and now_ns - self._moved_ns >= STANDSTILL_NS:
                self.fault = None
            return None
        if found is not None:
            self.fault, self._fault_ns = found, now_ns
        return found

    def _has_fallen(self, speed: SpeedReport) -> bool:
        """Return whether the speed is lower than a real one can be, given the speeds reported earlier."""
        before, self._checked = self._checked, speed
        passed_s = (speed.mono_ns - before.mono_ns) / NS_PER_S
        if passed_s <= 0:
            return False
        least_mps = self._least_mps - MAX_FALL_MPS2 * passed_s
        self._least_mps = max(abs(speed.mps), least_mps)
        self._may_slide |= abs(speed.mps) < least_mps - LOCKED_DROP_MPS
        return abs(speed.mps) < least_mps - MAX_DROP_MPS

    def _disagrees(self, now_ns: int) -> bool:
        if self._agreed_ns is None or not self._differs(now_ns):
            self._agreed_ns = now_ns
        return now_ns - self._agreed_ns >= DISAGREEMENT_NS

    def _differs(self, now_ns: int) -> bool:
        """Return whether `speed` differs from the second speed, or is outside of the range of the wheels' speeds."""
        fresh_mps = {
            name: abs(report.mps) for name, report in self._speeds.items() if now_ns - report.mono_ns <= SOURCE_LIMIT_NS
        }
        speed_mps = fresh_mps.pop("speed", None)
        if speed_mps is None:
            return False
        second_mps = [mps for name, mps in fresh_mps.items() if name == "second_speed"]
        wheels_mps = [mps for name, mps in fresh_mps.items() if name != "second_speed"]
        return _is_outside(speed_mps, second_mps) or _is_outside(speed_mps, wheels_mps)

    def _is_unbraked(self, brake: float, now_ns: int) -> bool:
        speed_mps = abs(self._speeds["speed"].mps)
        if brake * self._max_braking_mps2 < MIN_CHECKED_BRAKE_MPS2 or speed_mps < MIN_CHECKED_SPEED_MPS:
            self._brake_reference = None
            return False
        reference = self._brake_reference
        if reference is None:
            self._brake_reference = SpeedReport(speed_mps, now_ns)
            return False
        passed_ns = now_ns - reference.mono_ns
        if passed_ns < BRAKE_SETTLING_NS:
            self._brake_reference = SpeedReport(speed_mps, reference.mono_ns)
            return False
        if passed_ns < BRAKE_SETTLING_NS + BRAKE_CHECK_NS:
            return False
        self._brake_reference = SpeedReport(speed_mps, now_ns - BRAKE_SETTLING_NS)
        return speed_mps > reference.mps - MIN_SPEED_LOSS_MPS

    def _is_frozen(self, pedals: Pedals, now_ns: int) -> bool:
        speed_mps, reference = abs(self._speeds["speed"].mps), self._frozen_reference
        if pedals.brake > 0 or pedals.throttle * self._max_acceleration_mps2 < FROZEN_ACCELERATION_MPS2:
            self._frozen_reference = None
            return False
        if reference is None or abs(speed_mps - reference.mps) > CONSTANT_WITHIN_MPS:
            self._frozen_reference = SpeedReport(speed_mps, now_ns)
            return False
        return reference.mps > MOVING_ABOVE_MPS and now_ns - reference.mono_ns >= FROZEN_NS

    def _update_throttled(self, pedals: Pedals, passed_s: float) -> None:
        speed_mps = abs(self._speeds["speed"].mps)
        if speed_mps > MOVING_ABOVE_MPS or abs(speed_mps - self._changed_mps) > CONSTANT_WITHIN_MPS:
            self._changed_mps, self._throttled_mps = speed_mps, 0.0
            return
        braking_mps2 = ROLLING_RESISTANCE_MPS2 if pedals.is_brake_axis_released else self._sure_braking_mps2(pedals)
        change_mps = (self._acceleration_mps2(pedals) - braking_mps2) * passed_s
        self._throttled_mps = max(0.0, self._throttled_mps + change_mps)

    def _update_sliding(self, pedals: Pedals, passed_s: float) -> None:
        speed_mps = abs(self._speeds["speed"].mps)
        if pedals.brake == 0 and not pedals.is_brake_axis_released and speed_mps >= STATIONARY_BELOW_MPS:
            self._sliding_mps = speed_mps  # wheels that roll
        braking_mps2 = ICE_BRAKING_MPS2 if pedals.is_brake_axis_released else self._sure_braking_mps2(pedals)
        acceleration_mps2 = self._acceleration_mps2(pedals) if self._may_slide else 0.0  # else the speed shows it
        self._sliding_mps = max(speed_mps, self._sliding_mps + (acceleration_mps2 - braking_mps2) * passed_s)
        self._may_slide &= self._sliding_mps > speed_mps

    def _acceleration_mps2(self, pedals: Pedals) -> float:
        """Return the acceleration that the throttle gives on a level road."""
        return max(0.0, pedals.throttle * self._max_acceleration_mps2 - ROLLING_RESISTANCE_MPS2)

    def _sure_braking_mps2(self, pedals: Pedals) -> float:
        """Return the deceleration that even a weak brake and ice give."""
        return min(SURE_BRAKE_SHARE * pedals.brake * self._max_braking_mps2, ICE_BRAKING_MPS2)


def _is_outside(speed_mps: float, others_mps: Iterable[float]) -> bool:
    """Return whether a speed is lower than all others, or higher than all others, by more than the tolerance."""
    others = [*others_mps]
    if not others:
        return False
    nearest_mps = min(max(speed_mps, min(others)), max(others))
    return abs(speed_mps - nearest_mps) > DISAGREEMENT_MPS + DISAGREEMENT_SHARE * max(speed_mps, nearest_mps)
