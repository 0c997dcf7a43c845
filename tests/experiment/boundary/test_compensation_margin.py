"""The model of the loops that know their delay: against the model of the others, the rule, and the whole loop."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.control.compensation import VARIANTS, CompensationSettings
from lavt.experiment.boundary.boundary import theoretical_ms, with_video_delay
from lavt.experiment.boundary.compensation_margin import (
    Predictor,
    compensated_phase_margin_rad,
    compensated_spectral_radius,
    scheduled_loop,
)
from lavt.experiment.boundary.delay_margin import DEFAULT_CAR, LateralLoop, phase_margin_rad, spectral_radius
from lavt.experiment.boundary.oscillation_growth import straight_growth
from lavt.perception.lane_detector import SMOOTHING

AVERAGE_S = (1 / SMOOTHING - 1) / 30
NO_PREDICTION = Predictor(constant_delay_s=0.0, lane_error_s=-AVERAGE_S)
"""From the picture to the picture."""
CONDITIONS = [(0.081, 0.03), (0.156, 0.03), (0.231, 0.03), (0.306, 0.03), (0.306, 0.105), (0.406, 0.13)]
"""Total delay and its part without reports at L0 to L5."""
MARGIN_RAD = math.radians(30)


@pytest.mark.parametrize("total_delay_s", [0.0, 0.05, 0.081, 0.3, 0.7])
def test_no_prediction_is_the_loop_without_prediction(total_delay_s: float) -> None:
    """With a prediction over no time, eigenvalues and phase margin are those of the lane keeper's model."""
    loop = LateralLoop(1.01)
    radius = compensated_spectral_radius(loop, NO_PREDICTION, total_delay_s)
    assert radius == pytest.approx(spectral_radius(loop, total_delay_s), abs=1e-6)
    if radius < 1:
        margin_rad = compensated_phase_margin_rad(loop, NO_PREDICTION, total_delay_s)
        assert margin_rad == pytest.approx(phase_margin_rad(loop, total_delay_s), abs=1e-4)


@pytest.mark.parametrize("uses_reports", [True, False])
def test_a_car_without_steering_lag_has_nearly_the_loop_of_a_short_lag(uses_reports: bool) -> None:
    """A steering lag of 0, which a config may have, gives the eigenvalues of a lag of 2 ms, with both models."""
    loops = [LateralLoop(1.01, car=replace(DEFAULT_CAR, steering_lag_s=lag_s)) for lag_s in (0.0, 0.002)]
    knows = [Predictor(steering_lag_s=loop.car.steering_lag_s, uses_reports=uses_reports) for loop in loops]
    radii = [compensated_spectral_radius(*known, 0.3) for known in zip(loops, knows, strict=True)]
    assert radii[0] == pytest.approx(radii[1], abs=1e-3)
    assert spectral_radius(loops[0], 0.3) == pytest.approx(spectral_radius(loops[1], 0.3), abs=1e-3)


def predictor(kind: str) -> Predictor:
    """Return what a variant assumes."""
    variant = VARIANTS[kind]
    constant_s = None if variant.measures_delay else CompensationSettings().constant_delay_s
    return Predictor(uses_reports=variant.uses_reports, constant_delay_s=constant_s)


def margins_rad(kind: str, change: float = 0.0) -> list[float]:
    """Return the phase margins at L0 to L5 with the settings of the code; `change` is added to the tuned one."""
    variant, knows, loop = VARIANTS[kind], predictor(kind), LateralLoop(VARIANTS[kind].lookahead_s)
    if not variant.predicts:
        return [phase_margin_rad(scheduled_loop(variant, loop, total_s), total_s) for total_s, _ in CONDITIONS]
    if knows.constant_delay_s is not None:
        knows = replace(knows, constant_delay_s=knows.constant_delay_s + change)
    else:
        loop = replace(loop, lookahead_s=loop.lookahead_s + change)
    return [
        compensated_phase_margin_rad(loop, replace(knows, unreported_s=unreported_s), total_s)
        for total_s, unreported_s in CONDITIONS
    ]


@pytest.mark.parametrize("kind", VARIANTS)
def test_every_controller_keeps_the_rule(kind: str) -> None:
    """Each controller has 30 degrees of phase margin at L0 to L5."""
    assert min(margins_rad(kind)) >= MARGIN_RAD


@pytest.mark.parametrize("kind", ["predictive", "smith", "constant_delay"])
def test_no_smaller_setting_keeps_the_rule(kind: str) -> None:
    """With 0.02 s less lookahead, or assumed delay, the margin is smaller than 30 degrees under some condition."""
    assert min(margins_rad(kind, -0.02)) < MARGIN_RAD


@pytest.mark.parametrize(
    ("kind", "change", "low_ms", "high_ms"),
    [
        ("lane_keeper", "vehicle.speed_report_factor=0.75", 197, 247),
        ("constant_delay", "controller.compensation.camera_delay_s=0.2", 0, 417),
        ("constant_delay", "camera.sensor_delay_ms=100", 0, 600),
    ],
)
def test_the_model_knows_wrong_speeds_and_stamps(kind: str, change: str, low_ms: float, high_ms: float) -> None:
    """The critical delay with a wrong speed report, or a wrong age of the picture, is far below the exact one."""
    critical_ms = theoretical_ms(config(kind, "controller.preset=designed", change))
    assert critical_ms is not None
    assert low_ms < critical_ms < high_ms


def test_exact_knowledge_needs_no_shorter_delay() -> None:
    """The predictive loop is stable at every total delay up to 1.5 s, the lane keeper's only up to 0.34 s."""
    loop = LateralLoop(VARIANTS["predictive"].lookahead_s)
    assert all(compensated_spectral_radius(loop, Predictor(), number * 0.05) < 1 for number in range(31))
    assert spectral_radius(LateralLoop(1.01), 0.35) > 1


def config(kind: str, *changes: str) -> RunConfig:
    """Return the config of a run without pixels."""
    settings = (
        "fidelity=geometry",
        f"controller.kind={kind}",
        "network.condition=L0",
        "safety.picture_age_limit_ms=2000",
        "safety.stopping_distance_limit_m=200",
    )
    return load_config(RunConfig, shipped("configs/demo.yaml"), ["time=virtual", *settings, *changes])


@pytest.mark.full
@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        ("predictive", ("controller.wheelbase_m=4.4", "network.control.delay_ms=100")),
        ("constant_delay", ()),
        ("smith", ("controller.wheelbase_m=5.5",)),
        ("constant_delay", ("controller.compensation.camera_delay_s=0.2",)),
    ],
)
def test_the_whole_loop_becomes_unstable_where_the_model_does(kind: str, changes: tuple[str, ...]) -> None:
    """The oscillation of a whole loop decays 15 ms below the model's critical delay, and grows 15 ms above it."""
    run = config(kind, *changes)
    critical_ms = theoretical_ms(run)
    assert critical_ms is not None
    measured_ms, _ = straight_growth(with_video_delay(run, 0.0))
    (_, below), (_, above) = (
        straight_growth(with_video_delay(run, critical_ms - measured_ms + side_ms)) for side_ms in (-15.0, 15.0)
    )
    assert below < 0 < above
