"""Growth of a swing: by hand, and of the whole loop on a straight road beside the theory."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.boundary.boundary import theoretical_ms, with_video_delay
from lavt.experiment.boundary.oscillation_growth import (
    CALM_START,
    calm_seed,
    growth_per_s,
    half_swings,
    straight_growth,
)
from lavt.experiment.runs.monitored_run import MonitoredRun
from lavt.vehicle.sim.simulator import start_of

LOOPBACK_MS = 11.8
"""Of exposure to the wheel's command without any injected delay, of which the tests must only know it roughly."""
WITHIN_MS = 10.0

CASES = list(itertools.product((0.74, 1.01, 1.3), (15, 30), (6.0, 10.0)))
QUICK = (1.01, 30, 6.0)


def swinging(rate_per_s: float, *, size_m: float = 0.01, limited_s: tuple[float, ...] = ()) -> MonitoredRun:
    """Make a drive that swings once in 2 s, at full speed after 5 s."""
    time_s = np.arange(0, 40, 0.02)
    return MonitoredRun(
        ending=None,
        lane_invasions=0,
        total_delay_ms=0.0,
        time_s=time_s,
        cross_track_m=size_m * np.exp(rate_per_s * time_s) * np.cos(math.pi * time_s),
        speed_mps=np.where(time_s < 5, 2.0, 10.0),
        limited_s=np.array(limited_s),
    )


def test_a_half_swing_reaches_from_crossing_to_crossing() -> None:
    """Only what lies between two crossings of the centre counts, with its farthest place."""
    time_s = np.arange(9.0)
    times_s, sizes_m = half_swings(time_s, np.array([5.0, -1.0, -3.0, -2.0, 1.0, 4.0, -2.0, -1.0, 9.0]))
    assert times_s.tolist() == [2.0, 5.0, 6.0]
    assert sizes_m.tolist() == [3.0, 4.0, 2.0]


@pytest.mark.parametrize("rate_per_s", [-0.3, -0.01, 0.01, 0.05])
def test_the_rate_is_that_of_the_envelope(rate_per_s: float) -> None:
    """A swing of e^(rate t) cos grows with that rate."""
    assert growth_per_s(swinging(rate_per_s)) == pytest.approx(rate_per_s, rel=0.01)


def test_nothing_counts_from_the_first_limit_on() -> None:
    """What comes after a command that safety changed says nothing; one before the speed has settled does not count."""
    drive = swinging(0.05, limited_s=(0.1, 20.0))
    drive.cross_track_m[drive.time_s > 20] = 0.02
    assert growth_per_s(drive) == pytest.approx(0.05, rel=0.01)


def test_a_swing_that_was_too_large_at_once_has_grown() -> None:
    """Fewer than four half swings before the swing is no small one any more are growth, as it began small."""
    assert growth_per_s(swinging(0.0, size_m=0.3)) == math.inf


def test_a_car_that_only_comes_nearer_does_not_swing() -> None:
    """Without any crossing there is no swing to grow."""
    drive = swinging(-0.1)
    drive.cross_track_m[:] = 0.1 * np.exp(-drive.time_s)
    assert growth_per_s(drive) == -math.inf


def test_the_seed_of_a_straight_drive_has_a_calm_start() -> None:
    """Whatever the run's seed, the straight drive begins near the centre, and each run has a seed of its own."""
    seeds = [calm_seed(seed) for seed in range(5)]
    assert len(set(seeds)) == 5
    for seed in seeds:
        _, aside_m, turned_rad = start_of(seed)
        assert abs(aside_m) <= CALM_START[0]
        assert abs(turned_rad) <= CALM_START[1]


def loop_config(lookahead_s: float, rate_hz: float, speed_mps: float, *changes: str) -> RunConfig:
    changed = [
        "fidelity=geometry",
        f"controller.lookahead_s={lookahead_s}",
        f"controller.speed_mps={speed_mps}",
        f"camera.rate_hz={rate_hz}",
        "safety.sight_m=200",  # at 10 m/s the car would be slowed from 0.27 s on
        *changes,
    ]
    return load_config(RunConfig, shipped("configs/demo.yaml"), changed)


def check_onset(config: RunConfig) -> None:
    """Check that the swing dies away just less than 10 ms below the theory's delay, and grows just less above it."""
    theory_ms = theoretical_ms(config)
    assert theory_ms is not None
    for side in (-1, 1):
        requested_ms = theory_ms + side * (WITHIN_MS - 0.5) - LOOPBACK_MS
        total_ms, rate_per_s = straight_growth(with_video_delay(config, requested_ms))
        assert abs(total_ms - theory_ms) <= WITHIN_MS
        assert rate_per_s * side > 0, (total_ms, theory_ms)


@pytest.mark.parametrize(
    ("lookahead_s", "rate_hz", "speed_mps"),
    [pytest.param(*case, marks=() if case == QUICK else pytest.mark.full) for case in CASES],
)
def test_the_swing_begins_to_grow_where_theory_says(lookahead_s: float, rate_hz: float, speed_mps: float) -> None:
    """On a straight road, far from every limit, the whole loop's onset of growth is within 10 ms of the theory."""
    check_onset(loop_config(lookahead_s, rate_hz, speed_mps))


@pytest.mark.full
def test_dead_time_and_lag_of_the_steering_move_the_onset_as_theory_says() -> None:
    """With 60 ms of dead time and another lag, the onset is within 10 ms of the theory for that car."""
    check_onset(loop_config(1.01, 30, 30 / 3.6, "vehicle.steering_dead_time_ms=60", "vehicle.steering_lag_ms=200"))
