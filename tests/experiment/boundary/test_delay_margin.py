import math
from dataclasses import replace

import numpy as np
import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.control.preset import PRESETS
from lavt.experiment.boundary.delay_margin import (
    DELAY_PER_LOOKAHEAD,
    LateralLoop,
    configured_loop,
    critical_delay_s,
    phase_margin_rad,
    plant,
    smallest_lookahead_s,
    spectral_radius,
)
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ

INDEPENDENT_RESULTS = [  # lookahead s, steering lag s, delay margin ms: an independent computation of the same model
    (0.60, 0.15, 114),
    (0.70, 0.15, 162),
    (0.70, 0.10, 200),
    (0.74, 0.12, 204),
    (0.80, 0.12, 234),
    (1.00, 0.12, 336),
    (1.20, 0.12, 440),
]


@pytest.mark.parametrize(("lookahead_s", "steering_lag_s", "critical_ms"), INDEPENDENT_RESULTS)
def test_delay_margins_match_an_independent_computation(
    lookahead_s: float, steering_lag_s: float, critical_ms: float
) -> None:
    """The delay margins agree with an independent computation within 3 ms."""
    loop = LateralLoop(lookahead_s, car=replace(LINCOLN_MKZ, steering_lag_s=steering_lag_s))
    assert 1e3 * critical_delay_s(loop) == pytest.approx(critical_ms, abs=3)


def test_the_simplified_loop_has_the_textbook_delay_margin() -> None:
    """Without lag, averaging, hold and tyre dynamics, the delay margin approaches 0.5205 times lookahead time."""
    simplified = LateralLoop(
        2.0, speed_mps=1.0, frame_rate_hz=100.0, smoothing=1.0, car=replace(LINCOLN_MKZ, steering_lag_s=1e-3)
    )
    bound_s = DELAY_PER_LOOKAHEAD * 2.0
    assert pytest.approx(0.52049, abs=1e-5) == DELAY_PER_LOOKAHEAD
    # The difference, up to 3 %, is due to 1 ms of lag, half a frame of hold and 7 ms of tyre relaxation at 1 m/s.
    assert spectral_radius(simplified, 0.97 * bound_s) < 1 < spectral_radius(simplified, bound_s)


def test_the_plant_is_kinematic_at_low_speed() -> None:
    """At 1 m/s the yaw rate settles at speed x wheel angle / wheelbase, independent of the tyres."""
    loop = LateralLoop(1.0, speed_mps=1.0)
    a, _ = plant(loop)
    # The steady state for a wheel angle of 1 rad.
    _lateral_mps, yaw_rate_radps = np.linalg.solve(a[:2, :2], -a[:2, 4])
    assert yaw_rate_radps == pytest.approx(1.0 / loop.car.wheelbase_m, rel=0.01)


def test_the_phase_margin_is_zero_at_the_delay_margin() -> None:
    """Phase margin and spectral radius, computed in different ways, agree on the delay margin."""
    loop = LateralLoop(0.74)
    critical_s = critical_delay_s(loop)
    assert phase_margin_rad(loop, critical_s) == pytest.approx(0, abs=1e-3)
    assert spectral_radius(loop, critical_s - 0.001) < 1 < spectral_radius(loop, critical_s + 0.001)
    assert phase_margin_rad(loop, critical_s - 0.05) > 0 > phase_margin_rad(loop, critical_s + 0.05)


def test_the_phase_margin_is_continuous_in_the_delay() -> None:
    """The phase margin does not jump where the delay passes a whole number of frames."""
    loop = LateralLoop(1.0)
    before, after = (phase_margin_rad(loop, 3 / 30 + shift) for shift in (-1e-7, 1e-7))
    assert before == pytest.approx(after, abs=1e-5)


def test_the_smallest_lookahead_has_the_requested_margin() -> None:
    """The smallest lookahead has exactly the requested phase margin; a shorter lookahead has a smaller margin."""
    lookahead_s = smallest_lookahead_s(math.radians(30), total_delay_s=0.081)
    assert math.degrees(phase_margin_rad(LateralLoop(lookahead_s), 0.081)) == pytest.approx(30, abs=0.01)
    assert math.degrees(phase_margin_rad(LateralLoop(lookahead_s - 0.05), 0.081)) < 30


@pytest.mark.parametrize(
    ("smaller_margin", "larger_margin"),
    [
        (LateralLoop(0.74, speed_mps=50 / 3.6), LateralLoop(0.74, speed_mps=20 / 3.6)),
        (LateralLoop(0.74, frame_rate_hz=15), LateralLoop(0.74, frame_rate_hz=60)),
        (LateralLoop(0.74, smoothing=0.3), LateralLoop(0.74, smoothing=1.0)),
        (
            LateralLoop(0.74, car=replace(LINCOLN_MKZ, steering_lag_s=0.2)),
            LateralLoop(0.74, car=replace(LINCOLN_MKZ, steering_lag_s=0.05)),
        ),
    ],
)
def test_four_changes_reduce_the_margin(smaller_margin: LateralLoop, larger_margin: LateralLoop) -> None:
    """A higher speed, a lower frame rate, more averaging and a longer steering lag each reduce the delay margin."""
    assert critical_delay_s(smaller_margin) < critical_delay_s(larger_margin)


def test_too_short_a_lookahead_is_unstable_without_delay() -> None:
    """With too short a lookahead, the lags of the car alone make the loop unstable."""
    assert critical_delay_s(LateralLoop(0.2)) == 0.0


def test_the_designed_preset_comes_from_the_model() -> None:
    """The preset `designed` has the smallest lookahead with a phase margin of 30 degrees at 81 ms, rounded up."""
    smallest_s = smallest_lookahead_s(math.radians(30), total_delay_s=0.081)
    assert PRESETS["designed"].lookahead_s == math.ceil(100 * smallest_s) / 100


def config(*changes: str) -> RunConfig:
    return load_config(RunConfig, shipped("configs/demo.yaml"), changes)


def test_the_configured_loop_has_the_settings_of_the_run() -> None:
    """The configured loop has the preset, changed settings, frame rate, car and lags of the run."""
    assert configured_loop(config()) == LateralLoop(0.74, controller_wheelbase_m=LINCOLN_MKZ.wheelbase_m)
    changed = configured_loop(
        config(
            "controller.preset=designed",
            "controller.lookahead_s=1.2",
            "controller.speed_mps=10",
            "controller.wheelbase_m=3.0",
            "camera.rate_hz=15",
            "vehicle.steering_lag_ms=200",
            "vehicle.steering_dead_time_ms=60",
        )
    )
    assert changed == LateralLoop(
        1.2,
        10.0,
        15.0,
        car=replace(LINCOLN_MKZ, steering_lag_s=0.2, steering_dead_time_s=0.06),
        controller_wheelbase_m=3.0,
    )


@pytest.mark.parametrize(("lookahead_s", "speed_mps", "limited_m"), [(0.74, 5.0, 4.0), (3.0, 10.0, 20.0)])
def test_the_lookahead_is_within_the_controllers_bounds(lookahead_s: float, speed_mps: float, limited_m: float) -> None:
    """Lookaheads below 4 m and above 20 m are limited to 4 and 20 m, as in the controller."""
    loop = configured_loop(config(f"controller.lookahead_s={lookahead_s}", f"controller.speed_mps={speed_mps}"))
    assert loop is not None
    assert loop.lookahead_s * speed_mps == pytest.approx(limited_m)


@pytest.mark.parametrize("change", ["controller.kind=my_controller", "vehicle.kind=my_car"])
def test_other_controllers_and_vehicles_have_no_model(change: str) -> None:
    """A controller or a vehicle that is not LAVT's has no model."""
    assert configured_loop(config(change)) is None


def test_steering_dead_time_reduces_the_delay_margin() -> None:
    """A steering dead time of 60 ms reduces the delay margin by 60 ms."""
    with_dead_time = LateralLoop(1.01, car=replace(LINCOLN_MKZ, steering_dead_time_s=0.06))
    assert critical_delay_s(with_dead_time) == pytest.approx(critical_delay_s(LateralLoop(1.01)) - 0.06, abs=1e-6)


def test_too_long_a_controller_wheelbase_reduces_the_delay_margin() -> None:
    """A longer wheelbase in the controller increases its gain and reduces the delay margin."""
    assert critical_delay_s(LateralLoop(1.01, controller_wheelbase_m=3.5)) < critical_delay_s(LateralLoop(1.01))
