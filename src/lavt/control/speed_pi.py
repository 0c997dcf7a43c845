"""Holding a speed with the pedals: a PI controller that does not wind up."""

from __future__ import annotations

PROPORTIONAL_PER_S = 0.8
"""m/s2 for each m/s of error: closes an error in 1.3 s, slow against pedal lag and network delay together."""
INTEGRAL_PER_S2 = 0.1
"""m/s2 for each m/s of error and second: takes up drag and slope within some 8 s."""
GENTLE_BRAKING_MPS2 = 1.5
"""To become slower is not to brake for something: a few pictures seen badly make no jolt."""
INTEGRATE_WITHIN_MPS = 0.5
"""Farther from the target nothing is integrated: what happens there is acceleration, not an error to be learnt."""
INTEGRAL_WITHIN_MPS2 = 0.5
"""Drag and a slope of 5 % need no more."""
FULL_SPEED_CONFIDENCE = 0.5
"""With one line seen over the whole length, or both over half of it, the driver keeps its speed."""
SLOWEST_SHARE = 0.4
"""Of the full speed, with hardly any lane seen: 12 of 30 km/h, still fast enough to come to the next marks."""
LONGEST_STEP_S = 0.1
"""A controller that was not asked for longer learns nothing from the time in between."""


class SpeedPi:
    """Keeps a speed; has one state, the acceleration it has learnt to add."""

    def __init__(self, max_acceleration_mps2: float, max_braking_mps2: float) -> None:
        self._max_acceleration_mps2 = max_acceleration_mps2
        self._max_braking_mps2 = max_braking_mps2
        self._integral_mps2 = 0.0

    def acceleration_mps2(self, target_mps: float, speed_mps: float, step_s: float) -> float:
        """Give the acceleration wanted now, `step_s` after the last call.

        It is within what the car can do, and brakes gently.
        """
        error_mps = target_mps - speed_mps
        if abs(error_mps) < INTEGRATE_WITHIN_MPS:
            learnt = self._integral_mps2 + INTEGRAL_PER_S2 * error_mps * min(step_s, LONGEST_STEP_S)
            self._integral_mps2 = min(max(learnt, -INTEGRAL_WITHIN_MPS2), INTEGRAL_WITHIN_MPS2)
        wanted_mps2 = PROPORTIONAL_PER_S * error_mps + self._integral_mps2
        lowest_mps2 = -min(GENTLE_BRAKING_MPS2, self._max_braking_mps2)
        return min(max(wanted_mps2, lowest_mps2), self._max_acceleration_mps2)

    def pedals(self, acceleration_mps2: float) -> tuple[float, float]:
        """Give throttle and brake, each in [0, 1] and one of them 0, for an acceleration."""
        if acceleration_mps2 >= 0:
            return min(acceleration_mps2 / self._max_acceleration_mps2, 1.0), 0.0
        return 0.0, min(-acceleration_mps2 / self._max_braking_mps2, 1.0)


def confident_speed_mps(speed_mps: float, confidence: float) -> float:
    """Give the speed to drive at: `speed_mps` while the lane is seen well, less the less is seen."""
    return speed_mps * min(max(confidence / FULL_SPEED_CONFIDENCE, SLOWEST_SHARE), 1.0)
