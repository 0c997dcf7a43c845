from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import binom

from lavt.experiment.statistics.intervals import bootstrap_interval, exact_interval, holm


@pytest.mark.parametrize(
    ("successes", "low", "high"), [(30, 0.025 ** (1 / 30), 1.0), (15, 0.3130, 0.6870), (0, 0.0, 1 - 0.025 ** (1 / 30))]
)
def test_the_interval_of_thirty_runs_is_exact(successes: int, low: float, high: float) -> None:
    """The interval of 30 and 0 in 30 is the closed form of Clopper and Pearson, that of 15 the published one."""
    assert exact_interval(successes, 30) == pytest.approx([low, high], abs=5e-5)


def completed(probabilities: Sequence[float], runs: Sequence[int]) -> np.ndarray:
    """Give the chance of each number of completed runs, over routes with these probabilities."""
    chances = np.ones(1)
    for probability, many in zip(probabilities, runs, strict=True):
        chances = np.convolve(chances, binom.pmf(np.arange(many + 1), many, probability))
    return chances


ROUTES = [
    (1.0, 1.0, 0.0, 1.0, 1.0, 1.0),
    (0.9, 0.9, 0.1, 0.9, 0.9, 0.9),
    (0.5,) * 6,
    (0.98,) * 6,
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0253),
    (0.0, 0.2, 0.0, 0.0, 0.0, 0.4),
    (0.05, 0.3, 0.5, 0.7, 0.95, 1.0),
]


@pytest.mark.parametrize("probabilities", ROUTES)
@pytest.mark.parametrize("runs", [(5,) * 6, (1,) * 6, (5, 5, 4, 5, 3, 5), (2, 20, 1, 1, 1, 5)])
def test_the_pooled_interval_covers_the_mean_over_routes(probabilities: Sequence[float], runs: Sequence[int]) -> None:
    """However the routes differ, at least 95 % of experiments have their runs' mean probability in the interval."""
    mean = float(np.dot(probabilities, runs)) / sum(runs)
    covered = 0.0
    for count, chance in enumerate(completed(probabilities, runs)):
        low, high = exact_interval(count, sum(runs)) or [1.0, 0.0]
        covered += chance * (low <= mean + 1e-12 and mean - 1e-12 <= high)
    assert covered >= 0.95


def test_the_pooled_interval_covers_wherever_three_routes_lie() -> None:
    """On a grid of all probabilities of three routes with five runs each, coverage is nowhere below 95 %."""
    grid = np.linspace(0, 1, 21)
    intervals = [exact_interval(count, 15) or [1.0, 0.0] for count in range(16)]
    for probabilities in itertools.combinations_with_replacement(grid.tolist(), 3):
        mean = sum(probabilities) / 3
        chances = completed(probabilities, (5, 5, 5))
        covered = sum(
            chance
            for chance, (low, high) in zip(chances, intervals, strict=True)
            if low - 1e-12 <= mean <= high + 1e-12
        )
        assert covered >= 0.95, probabilities


def test_intervals_of_too_little_are_null() -> None:
    """No runs give no exact interval, and fewer than two values no bootstrap interval."""
    assert exact_interval(0, 0) is None
    assert bootstrap_interval([]) is None
    assert bootstrap_interval([1.0]) is None


def test_bootstrap_is_repeatable_and_about_right() -> None:
    """The same runs give the same interval, and that of 100 equal steps is 1.96 standard errors wide to a tenth."""
    values = [index / 99 for index in range(100)]
    interval = bootstrap_interval(values)
    assert interval == bootstrap_interval(values)
    assert interval is not None
    assert interval[0] == pytest.approx(0.5 - 1.96 * 0.0291, abs=0.006)
    assert interval[1] == pytest.approx(0.5 + 1.96 * 0.0291, abs=0.006)


def test_the_bootstrap_of_three_is_their_range() -> None:
    """Every 27th resample of three values is three times the least: at 95 % the interval is from least to most."""
    assert bootstrap_interval([0.2, 1.0, 0.6]) == pytest.approx([0.2, 1.0])
    assert bootstrap_interval([1.0, 1.0, 1.0]) == [1.0, 1.0]


def test_holm_by_hand() -> None:
    """0.01, 0.04, 0.03 become 0.03, 0.06, 0.06: the least by 3, the next by 2, none below the one before it."""
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])


def test_holm_leaves_out_what_was_not_tested() -> None:
    """A test that could not be made stays null and does not count; no p value exceeds 1."""
    assert holm([None, 0.6, 0.9]) == [None, 1.0, 1.0]
    assert holm([]) == []
