import math
from dataclasses import replace

import numpy as np
import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.control.drive_controller import PRESETS
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
from lavt.vehicle.sim.rendering.cars import LINCOLN_MKZ

PROTOTYPE_TABLE = [  # lookahead s, steering lag s, critical delay ms: an independent computation of the same model
    (0.60, 0.15, 114),
    (0.70, 0.15, 162),
    (0.70, 0.10, 200),
    (0.74, 0.12, 204),
    (0.80, 0.12, 234),
    (1.00, 0.12, 336),
    (1.20, 0.12, 440),
]


@pytest.mark.parametrize(("lookahead_s", "steering_lag_s", "critical_ms"), PROTOTYPE_TABLE)
def test_reproduces_the_prototype(lookahead_s: float, steering_lag_s: float, critical_ms: float) -> None:
    """The critical delays are those of an independent computation, within 3 ms."""
    loop = LateralLoop(lookahead_s, car=replace(LINCOLN_MKZ, steering_lag_s=steering_lag_s))
    assert 1e3 * critical_delay_s(loop) == pytest.approx(critical_ms, abs=3)


def test_without_lag_filter_and_hold_the_bound_is_the_textbook_one() -> None:
    """As lag, averaging, hold and tyres vanish, the critical delay becomes 0.5205 lookahead / speed."""
    bare = LateralLoop(
        2.0, speed_mps=1.0, frame_rate_hz=100.0, smoothing=1.0, car=replace(LINCOLN_MKZ, steering_lag_s=1e-3)
    )
    bound_s = DELAY_PER_LOOKAHEAD * 2.0
    assert pytest.approx(0.52049, abs=1e-5) == DELAY_PER_LOOKAHEAD
    # 1 ms of lag, half a frame of hold and the 7 ms in which tyres relax at 1 m/s take their share.
    assert spectral_radius(bare, 0.97 * bound_s) < 1 < spectral_radius(bare, bound_s)


def test_the_plant_turns_as_the_kinematic_car_at_walking_pace() -> None:
    """At 1 m/s the yaw rate settles at speed x wheel angle / wheelbase: the tyres do not matter."""
    loop = LateralLoop(1.0, speed_mps=1.0)
    a, _ = plant(loop)
    settled = np.linalg.solve(a[:2, :2], -a[:2, 4])  # lateral speed and yaw rate for a wheel angle of 1 rad
    assert settled[1] == pytest.approx(1.0 / loop.car.wheelbase_m, rel=0.01)


def test_the_margin_vanishes_where_the_loop_turns_unstable() -> None:
    """Phase margin and spectral radius, computed on different ways, agree on the critical delay."""
    loop = LateralLoop(0.74)
    critical_s = critical_delay_s(loop)
    assert phase_margin_rad(loop, critical_s) == pytest.approx(0, abs=1e-3)
    assert spectral_radius(loop, critical_s - 0.001) < 1 < spectral_radius(loop, critical_s + 0.001)
    assert phase_margin_rad(loop, critical_s - 0.05) > 0 > phase_margin_rad(loop, critical_s + 0.05)


def test_a_fraction_of_a_frame_joins_the_whole_frames() -> None:
    """The phase margin is continuous in the delay where the fraction turns into one more frame."""
    loop = LateralLoop(1.0)
    before, after = (phase_margin_rad(loop, 3 / 30 + shift) for shift in (-1e-7, 1e-7))
    assert before == pytest.approx(after, abs=1e-5)


def test_the_smallest_lookahead_leaves_just_the_margin() -> None:
    """With the smallest lookahead the margin is what was asked for; with less it is smaller."""
    lookahead_s = smallest_lookahead_s(math.radians(30), total_delay_s=0.081)
    assert math.degrees(phase_margin_rad(LateralLoop(lookahead_s), 0.081)) == pytest.approx(30, abs=0.01)
    assert math.degrees(phase_margin_rad(LateralLoop(lookahead_s - 0.05), 0.081)) < 30


@pytest.mark.parametrize(
    ("slower", "faster"),
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
def test_whatever_slows_the_loop_costs_delay(slower: LateralLoop, faster: LateralLoop) -> None:
    """Speed, a low frame rate, more averaging and a lazier steering each lower the critical delay."""
    assert critical_delay_s(slower) < critical_delay_s(faster)


def test_a_lookahead_that_is_too_short_is_unstable_without_any_delay() -> None:
    """The lags of the car alone can use up the whole margin."""
    assert critical_delay_s(LateralLoop(0.2)) == 0.0


def test_the_designed_preset_is_what_the_model_gives() -> None:
    """The lookahead in the table of presets is the smallest with 30 degrees of margin at 81 ms, rounded up."""
    smallest_s = smallest_lookahead_s(math.radians(30), total_delay_s=0.081)
    assert PRESETS["designed"].lookahead_s == math.ceil(100 * smallest_s) / 100


def config(*changes: str) -> RunConfig:
    return load_config(RunConfig, shipped("configs/demo.yaml"), changes)


def test_the_loop_as_configured_is_the_one_driven() -> None:
    """Preset, what replaces its settings, frame rate, car and lags are those of the run."""
    assert configured_loop(config()) == LateralLoop(0.74, supposed_wheelbase_m=LINCOLN_MKZ.wheelbase_m)
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
        supposed_wheelbase_m=3.0,
    )


@pytest.mark.parametrize(("lookahead_s", "speed_mps", "driven_m"), [(0.74, 5.0, 4.0), (3.0, 10.0, 20.0)])
def test_the_lookahead_is_within_the_controllers_bounds(lookahead_s: float, speed_mps: float, driven_m: float) -> None:
    """What would be nearer than 4 m or farther than 20 m is driven at 4 or 20 m."""
    loop = configured_loop(config(f"controller.lookahead_s={lookahead_s}", f"controller.speed_mps={speed_mps}"))
    assert loop is not None
    assert loop.lookahead_s * speed_mps == pytest.approx(driven_m)


@pytest.mark.parametrize("change", ["controller.kind=my_controller", "vehicle.kind=my_car"])
def test_of_others_nothing_is_known(change: str) -> None:
    """For a controller or a vehicle that is not of LAVT there is no model."""
    assert configured_loop(config(change)) is None


def test_dead_time_of_the_steering_comes_off_the_delay() -> None:
    """With 60 ms of dead time the loop bears just 60 ms less."""
    late = LateralLoop(1.01, car=replace(LINCOLN_MKZ, steering_dead_time_s=0.06))
    assert critical_delay_s(late) == pytest.approx(critical_delay_s(LateralLoop(1.01)) - 0.06, abs=1e-6)


def test_a_wheelbase_supposed_too_long_steers_too_much() -> None:
    """The controller's gain is that of the wheelbase it supposes, so more of it bears less delay."""
    assert critical_delay_s(LateralLoop(1.01, supposed_wheelbase_m=3.5)) < critical_delay_s(LateralLoop(1.01))
