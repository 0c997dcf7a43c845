"""The stability of the lateral loop with the model of a human driver, from a sampled-data model.

The car, the camera, the moving average of the lane and the total delay are those of
`lavt.experiment.boundary.delay_margin`. The driver is `lavt.control.two_point`, linearised about the centre of a
straight lane, without limits and noise. A picture is seen, and a command is made, once per frame. Within a frame the
reaction delay consists of whole frames and a fraction, after which the wanted angle changes; the arms' lag is exact.
"""

from __future__ import annotations

import math

import numpy as np

from lavt.control.two_point import TwoPointSettings
from lavt.domain import FloatArray
from lavt.experiment.boundary.delay_margin import LateralLoop, sampled_plant, smallest_unstable_s
from lavt.perception.lane_detector import GRID

SEEN_M = GRID.far_m
"""The lane is seen up to this distance from the rear axle."""
_CAR = 5
"""Number of the car's states; the lateral error and the heading error are 2 and 3."""


def two_point_closed_loop(loop: LateralLoop, driver: TwoPointSettings, total_delay_s: float) -> FloatArray:
    """Return the state transition matrix of the closed loop over one frame; `loop.lookahead_s` has no effect.

    The states are the car's, the past commands u[k - 1], u[k - 2] .., the past wanted angles of the road wheels, and
    the averages of the near and the far angle at the last frame.
    """
    sampled = sampled_plant(loop, total_delay_s)
    period_s, lag_s = 1 / loop.frame_rate_hz, driver.neuromuscular_lag_s
    delay_frames = int(driver.reaction_delay_s / period_s + 1e-9)
    fraction_s = max(driver.reaction_delay_s - delay_frames * period_s, 0.0)
    commands, wanted = sampled.delay_frames + 1, delay_frames + 2
    near_at = _CAR + commands + wanted
    state = np.eye(near_at + 2)

    def seen(ahead_m: float, average_at: int) -> FloatArray:
        newest: FloatArray = -(state[2] + ahead_m * state[3]) / (ahead_m - driver.eye_ahead_m)
        average: FloatArray = loop.smoothing * newest + (1 - loop.smoothing) * state[average_at]
        return average

    def share_left(duration_s: float) -> float:
        return math.exp(-duration_s / lag_s) if lag_s > 0 else float(duration_s <= 0)

    near, far = seen(driver.near_point_m, near_at), seen(_far_point_m(driver, loop), near_at + 1)
    turned = (
        driver.far_gain * (far - state[near_at + 1])
        + driver.near_gain * (near - state[near_at])
        + driver.near_integral_gain_per_s * period_s * near
    )
    # wanted_angles[j] is the angle wanted j frames ago, commanded[j] the command of j frames ago.
    wanted_angles = [state[_CAR + commands] + turned / driver.steering_ratio, *state[_CAR + commands : near_at]]
    before, after = share_left(fraction_s), share_left(period_s - fraction_s)
    if lag_s > 0:
        command = (
            before * after * state[_CAR]
            + after * (1 - before) * wanted_angles[delay_frames + 2]
            + (1 - after) * wanted_angles[delay_frames + 1]
        )
    else:
        command = wanted_angles[delay_frames + (fraction_s > 0)]
    commanded = [command, *state[_CAR : _CAR + commands]]
    step = np.zeros_like(state)
    step[:_CAR, :_CAR] = sampled.transition
    step[:_CAR] += np.outer(sampled.new_input, commanded[sampled.delay_frames])
    step[:_CAR] += np.outer(sampled.previous_input, commanded[sampled.delay_frames + 1])
    step[_CAR:near_at] = [*commanded[:commands], *wanted_angles[:wanted]]
    step[near_at:] = [near, far]
    return step


def _far_point_m(driver: TwoPointSettings, loop: LateralLoop) -> float:
    """Return the distance of the far point on a lane that is seen up to `SEEN_M`."""
    return min(max(driver.far_point_s * loop.speed_mps, driver.far_point_min_m), SEEN_M)


def two_point_spectral_radius(loop: LateralLoop, driver: TwoPointSettings, total_delay_s: float) -> float:
    """Return the factor by which the least damped mode grows per frame; the loop is stable if this is less than 1."""
    return float(np.max(np.abs(np.linalg.eigvals(two_point_closed_loop(loop, driver, total_delay_s)))))


def two_point_critical_delay_s(loop: LateralLoop, driver: TwoPointSettings) -> float:
    """Return the smallest total delay, without the driver's own, at which the loop is unstable; over 3 s, infinity."""
    return smallest_unstable_s(lambda delay_s: two_point_spectral_radius(loop, driver, delay_s))
