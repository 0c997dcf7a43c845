"""Speed control with the pedals: a PI controller with anti-windup."""

from __future__ import annotations

PROPORTIONAL_PER_S = 0.8
"""m/s2 for each m/s of error: a time constant of 1.3 s, slow compared with pedal lag plus network delay."""
INTEGRAL_PER_S2 = 0.1
"""m/s2 for each m/s of error and second: compensates drag and slope within some 8 s."""
GENTLE_BRAKING_MPS2 = 1.5
"""Largest deceleration of speed control, so that a few badly seen pictures cause no jolt."""
INTEGRATE_WITHIN_MPS = 0.5
"""Nothing is integrated farther from the target: the error there is a transient, not an offset."""
INTEGRAL_WITHIN_MPS2 = 0.5
"""Largest integral term; drag and a slope of 5 % need no more."""
FULL_SPEED_CONFIDENCE = 0.5
"""From this confidence on, the full speed is driven: one line over the whole length, or both over half of it."""
SLOWEST_SHARE = 0.4
"""Share of the full speed at low confidence: 12 of 30 km/h, fast enough to reach the next marks."""
LONGEST_STEP_S = 0.1
"""Longest time that one call integrates over."""


class SpeedPi:
    """A PI speed controller; its only state is the integral term."""

    def __init__(self, max_acceleration_mps2: float, max_braking_mps2: float) -> None:
        self._max_acceleration_mps2 = max_acceleration_mps2
        self._max_braking_mps2 = max_braking_mps2
        self._integral_mps2 = 0.0

    def acceleration_mps2(self, target_mps: float, speed_mps: float, step_s: float) -> float:
        """Return the acceleration to command now, `step_s` after the last call.

        It is limited to what the car can do, and to `GENTLE_BRAKING_MPS2` of braking.
        """
        error_mps = target_mps - speed_mps
        if abs(error_mps) < INTEGRATE_WITHIN_MPS:
            integral_mps2 = self._integral_mps2 + INTEGRAL_PER_S2 * error_mps * min(step_s, LONGEST_STEP_S)
            self._integral_mps2 = min(max(integral_mps2, -INTEGRAL_WITHIN_MPS2), INTEGRAL_WITHIN_MPS2)
        wanted_mps2 = PROPORTIONAL_PER_S * error_mps + self._integral_mps2
        lowest_mps2 = -min(GENTLE_BRAKING_MPS2, self._max_braking_mps2)
        return min(max(wanted_mps2, lowest_mps2), self._max_acceleration_mps2)

    def pedals(self, acceleration_mps2: float) -> tuple[float, float]:
        """Return throttle and brake for an acceleration, each in [0, 1] and one of them 0."""
        if acceleration_mps2 >= 0:
            return min(acceleration_mps2 / self._max_acceleration_mps2, 1.0), 0.0
        return 0.0, min(-acceleration_mps2 / self._max_braking_mps2, 1.0)


def confident_speed_mps(speed_mps: float, confidence: float) -> float:
    """Return the speed to drive at: `speed_mps` at high confidence, proportionally less below that."""
    return speed_mps * min(max(confidence / FULL_SPEED_CONFIDENCE, SLOWEST_SHARE), 1.0)
