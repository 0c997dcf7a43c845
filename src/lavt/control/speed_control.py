"""Speed control: from a target speed and a confidence to the pedals."""

from __future__ import annotations

from lavt.control.lane_watch import LANE_CONFIDENCE

MAX_ACCELERATION_MPS2 = 2.0
"""Acceleration of the simulator's car at full throttle."""
MAX_BRAKING_MPS2 = 6.0
"""Deceleration of the simulator's car at full brake."""

PROPORTIONAL_PER_S = 0.8
"""Acceleration in m/s2 for each m/s of speed error. The loop's time constant, 1.3 s, is long compared with pedal lag
plus network delay."""
INTEGRAL_PER_S2 = 0.1
"""Change of the integral term in m/s2 per second, for each m/s of error. The term compensates drag and slope within
about 8 s."""
GENTLE_BRAKING_MPS2 = 1.5
"""Largest deceleration that speed control requests, so that a few pictures with a badly visible lane cause no jolt."""
INTEGRATION_ERROR_LIMIT_MPS = 0.5
"""A larger error is not integrated: it is a transient, not an offset."""
MAX_INTEGRAL_MPS2 = 0.5
"""Largest integral term; drag and a slope of 5 % need no more."""
FULL_SPEED_CONFIDENCE = 0.5
"""From this confidence on, the car drives at full speed. One line that is visible over the whole length gives this
confidence, and so do two lines that are visible over half of the length."""
MIN_SPEED_SHARE = 0.4
"""Share of the full speed at low confidence: 12 km/h instead of 30, fast enough to reach the next marks."""
MAX_STEP_S = 0.1
"""The longest step that the integral term takes for one decision."""


class SpeedPiController:
    """A PI speed controller; its only state is the integral term."""

    def __init__(self) -> None:
        self._integral_mps2 = 0.0

    def acceleration_mps2(self, target_mps: float, speed_mps: float, step_s: float) -> float:
        """Return the acceleration to command now, `step_s` after the last call.

        The result is between -`GENTLE_BRAKING_MPS2` and `MAX_ACCELERATION_MPS2`.
        """
        error_mps = target_mps - speed_mps
        if abs(error_mps) < INTEGRATION_ERROR_LIMIT_MPS:
            integral_mps2 = self._integral_mps2 + INTEGRAL_PER_S2 * error_mps * min(step_s, MAX_STEP_S)
            self._integral_mps2 = min(max(integral_mps2, -MAX_INTEGRAL_MPS2), MAX_INTEGRAL_MPS2)
        unlimited_mps2 = PROPORTIONAL_PER_S * error_mps + self._integral_mps2
        return min(max(unlimited_mps2, -GENTLE_BRAKING_MPS2), MAX_ACCELERATION_MPS2)


def pedals(acceleration_mps2: float) -> tuple[float, float]:
    """Return throttle and brake for an acceleration, each in [0, 1] and at least one of them 0."""
    if acceleration_mps2 >= 0:
        return min(acceleration_mps2 / MAX_ACCELERATION_MPS2, 1.0), 0.0
    return 0.0, min(-acceleration_mps2 / MAX_BRAKING_MPS2, 1.0)


def speed_for_confidence_mps(speed_mps: float, confidence: float) -> float:
    """Return the speed to drive at: `speed_mps` times a share that depends on the confidence.

    The share rises in proportion to the confidence, from `MIN_SPEED_SHARE` to 1 at `FULL_SPEED_CONFIDENCE`.
    """
    return speed_mps * min(max(confidence / FULL_SPEED_CONFIDENCE, MIN_SPEED_SHARE), 1.0)


class SpeedKeeper:
    """The pedals of a driver that keeps a speed: PI control, slower if the lane is badly visible."""

    def __init__(self, speed_mps: float, lane_confidence: float = LANE_CONFIDENCE) -> None:
        self.full_speed_mps = speed_mps
        """The speed with a well visible lane."""
        self._lane_confidence = lane_confidence
        self._controller = SpeedPiController()

    def pedals(self, confidence: float, speed_mps: float, step_s: float) -> tuple[float, float]:
        """Return throttle and brake for the newest lane's confidence and speed, `step_s` after the last call.

        Without a lane both are 0: braking would jolt the car at each failed picture.
        """
        if confidence < self._lane_confidence:
            return pedals(0.0)
        target_mps = speed_for_confidence_mps(self.full_speed_mps, confidence)
        return pedals(self._controller.acceleration_mps2(target_mps, speed_mps, step_s))
