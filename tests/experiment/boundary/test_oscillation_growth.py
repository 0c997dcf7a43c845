"""Tests of the oscillation growth: of simple oscillations, and of the whole loop, compared with theory."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.boundary.boundary import theoretical_ms, with_video_delay
from lavt.experiment.boundary.oscillation_growth import (
    NEAR_CENTRE_START,
    growth_per_s,
    half_period_peaks,
    near_centre_seed,
    straight_growth,
)
from lavt.experiment.runs.monitored_run import MonitoredRun
from lavt.vehicle.sim.simulator import start_offset

DELAY_WITHOUT_INJECTION_MS = 17.0
"""The delay from exposure to the applied command with the shipped costs; an approximate value is sufficient."""
TOLERANCE_MS = 10.0

CASES = list(itertools.product((0.74, 1.01, 1.3), (15, 30), (6.0, 10.0)))
QUICK_CASE = (1.01, 30, 6.0)


def oscillating_drive(
    rate_per_s: float, *, amplitude_m: float = 0.01, limited_s: tuple[float, ...] = ()
) -> MonitoredRun:
    """Return a drive that oscillates with a period of 2 s and has full speed from 5 s on."""
    time_s = np.arange(0, 40, 0.02)
    return MonitoredRun(
        ending=None,
        lane_invasions=0,
        total_delay_ms=0.0,
        time_s=time_s,
        cross_track_m=amplitude_m * np.exp(rate_per_s * time_s) * np.cos(math.pi * time_s),
        speed_mps=np.where(time_s < 5, 2.0, 10.0),
        limited_s=np.array(limited_s),
    )


def test_a_half_period_reaches_from_crossing_to_crossing() -> None:
    """The peak of a half period is the largest distance from the centre between two crossings of the centre."""
    time_s = np.arange(9.0)
    times_s, peaks_m = half_period_peaks(time_s, np.array([5.0, -1.0, -3.0, -2.0, 1.0, 4.0, -2.0, -1.0, 9.0]))
    assert times_s.tolist() == [2.0, 5.0, 6.0]
    assert peaks_m.tolist() == [3.0, 4.0, 2.0]


@pytest.mark.parametrize("rate_per_s", [-0.3, -0.01, 0.01, 0.05])
def test_the_growth_is_that_of_the_envelope(rate_per_s: float) -> None:
    """The growth of an oscillation with the envelope e^(rate t) is its rate."""
    assert growth_per_s(oscillating_drive(rate_per_s)) == pytest.approx(rate_per_s, rel=0.01)


def test_growth_is_measured_before_the_first_limit() -> None:
    """Growth is measured up to the first limited command after the speed has settled; earlier limits do not matter."""
    drive = oscillating_drive(0.05, limited_s=(0.1, 20.0))
    drive.cross_track_m[drive.time_s > 20] = 0.02
    assert growth_per_s(drive) == pytest.approx(0.05, rel=0.01)


def test_an_oscillation_beyond_the_linear_range_has_infinite_growth() -> None:
    """If an oscillation leaves the linear range before four half periods are complete, its growth is infinite."""
    assert growth_per_s(oscillating_drive(0.0, amplitude_m=0.3)) == math.inf


def test_an_approach_without_crossing_is_no_oscillation() -> None:
    """A car that approaches the centre without crossing it has no oscillation."""
    drive = oscillating_drive(-0.1)
    drive.cross_track_m[:] = 0.1 * np.exp(-drive.time_s)
    assert growth_per_s(drive) == -math.inf


def test_a_straight_drive_starts_near_the_centre() -> None:
    """For any seed of a run, the straight drive starts near the centre; different runs have different drives."""
    seeds = [near_centre_seed(seed) for seed in range(5)]
    assert len(set(seeds)) == 5
    offset_limit_m, heading_limit_rad = NEAR_CENTRE_START
    for seed in seeds:
        _, offset_m, heading_rad = start_offset(seed)
        assert abs(offset_m) <= offset_limit_m
        assert abs(heading_rad) <= heading_limit_rad


def loop_config(lookahead_s: float, rate_hz: float, speed_mps: float, *changes: str) -> RunConfig:
    changed = [
        "fidelity=geometry",
        f"controller.lookahead_s={lookahead_s}",
        f"controller.speed_mps={speed_mps}",
        f"camera.rate_hz={rate_hz}",
        "safety.stopping_distance_limit_m=200",  # the default slows a car of 10 m/s if the delay exceeds 0.27 s
        *changes,
    ]
    return load_config(RunConfig, shipped("configs/demo.yaml"), changed)


def check_onset(config: RunConfig) -> None:
    """Check that the oscillation decays about 9.5 ms below the theoretical delay and grows about 9.5 ms above it."""
    theory_ms = theoretical_ms(config)
    assert theory_ms is not None
    for sign in (-1, 1):
        requested_ms = theory_ms + sign * (TOLERANCE_MS - 0.5) - DELAY_WITHOUT_INJECTION_MS
        total_ms, rate_per_s = straight_growth(with_video_delay(config, requested_ms))
        assert abs(total_ms - theory_ms) <= TOLERANCE_MS
        assert rate_per_s * sign > 0, (total_ms, theory_ms)


@pytest.mark.parametrize(
    ("lookahead_s", "rate_hz", "speed_mps"),
    [pytest.param(*case, marks=() if case == QUICK_CASE else pytest.mark.full) for case in CASES],
)
def test_the_onset_matches_theory(lookahead_s: float, rate_hz: float, speed_mps: float) -> None:
    """On a straight road, far from every limit, the onset of growth is within 10 ms of the theory."""
    check_onset(loop_config(lookahead_s, rate_hz, speed_mps))


@pytest.mark.full
def test_the_onset_with_steering_dead_time_matches_theory() -> None:
    """With 60 ms of dead time and 200 ms of lag, the onset is within 10 ms of the theory for that car."""
    check_onset(loop_config(1.01, 30, 30 / 3.6, "vehicle.steering_dead_time_ms=60", "vehicle.steering_lag_ms=200"))
