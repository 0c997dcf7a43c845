import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from lavt.control.preset import Preset
from lavt.control.two_point import TwoPointDriver, TwoPointSettings
from lavt.domain import NS_PER_S, Lane
from lavt.experiment.boundary.delay_margin import LateralLoop, plant
from lavt.experiment.boundary.two_point_margin import two_point_critical_delay_s, two_point_spectral_radius

LOOP = LateralLoop(1.0)
FRAME_S = 1 / LOOP.frame_rate_hz


def simulated_radius(driver_settings: TwoPointSettings, delay_frames: int) -> float:
    """Return the growth per frame of a lateral error of the linear car, which the real controller corrects.

    The error begins so small that the controller remains linear while it grows.
    """
    a, b = plant(LOOP)
    augmented = np.zeros((6, 6))
    augmented[:5, :5], augmented[:5, 5] = a, b
    frame = expm(augmented * FRAME_S)
    driver = TwoPointDriver(Preset("", lookahead_s=1.0), wheelbase_m=2.8448, settings=driver_settings)
    state, pending = np.array([0, 0, 1e-9, 0, 0.0]), [0.0] * delay_frames
    lateral_m, heading_rad, sizes = 0.0, 0.0, []
    for number in range(4000):
        newest = LOOP.smoothing if number else 1.0
        lateral_m += newest * (-state[2] - lateral_m)
        heading_rad += newest * (-state[3] - heading_rad)
        lane = Lane((lateral_m, heading_rad, 0.0), 3.5, 3.6, 20.0, 1.0)
        pending.append(driver.decide(lane, LOOP.speed_mps, round(number * FRAME_S * NS_PER_S)).steering_rad)
        state = (frame @ np.append(state, pending.pop(0)))[:5]
        sizes.append(float(np.linalg.norm(state[2:4])))
    # The mean of the logarithms over several periods does not depend on the phase of the oscillation.
    logarithms = np.log(sizes)
    return float(np.exp((logarithms[3200:4000].mean() - logarithms[1200:2000].mean()) / 2000))


@pytest.mark.parametrize("delay_frames", [2, 8, 10])
@pytest.mark.parametrize(("reaction_delay_s", "lag_s"), [(0.12, 0.11), (0.08, 0.2)])
def test_the_model_agrees_with_the_real_controller(delay_frames: int, reaction_delay_s: float, lag_s: float) -> None:
    """The spectral radius is the growth per frame of the real controller in closed loop with the linear car."""
    driver = replace(TwoPointSettings(), reaction_delay_s=reaction_delay_s, neuromuscular_lag_s=lag_s)
    simulated = simulated_radius(driver, delay_frames)
    assert two_point_spectral_radius(LOOP, driver, delay_frames * FRAME_S) == pytest.approx(simulated, abs=2e-4)


def test_the_default_gains_are_stable_at_l0() -> None:
    """With their own delay, the default gains are stable for 81 ms of total delay, and gains twice as large are not."""
    default = TwoPointSettings()
    assert 0.2 < two_point_critical_delay_s(LOOP, default) < 0.4
    twice = replace(
        default,
        far_gain=2 * default.far_gain,
        near_gain=2 * default.near_gain,
        near_integral_gain_per_s=2 * default.near_integral_gain_per_s,
    )
    assert two_point_critical_delay_s(LOOP, twice) < 0.081


@pytest.mark.full
def test_the_driver_s_own_delay_counts_like_delay_of_the_network() -> None:
    """A frame more of reaction delay reduces the critical delay by a frame."""
    by_delay_s = [
        two_point_critical_delay_s(LOOP, replace(TwoPointSettings(), reaction_delay_s=frames * FRAME_S))
        for frames in (2, 3)
    ]
    assert by_delay_s[0] - by_delay_s[1] == pytest.approx(FRAME_S, abs=1e-4)
    assert math.isfinite(by_delay_s[0])
