from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.stats import binom, poisson

from lavt.experiment.statistics.intervals import (
    cluster_interval,
    cluster_rate_interval,
    exact_interval,
    exact_rate_interval,
    holm,
    stratified_interval,
)


@pytest.mark.parametrize(
    ("successes", "low", "high"), [(30, 0.025 ** (1 / 30), 1.0), (15, 0.3130, 0.6870), (0, 0.0, 1 - 0.025 ** (1 / 30))]
)
def test_the_interval_of_thirty_runs_is_exact(successes: int, low: float, high: float) -> None:
    """For 0 and 30 of 30 runs the interval is Clopper and Pearson's closed form; for 15 of 30 it is as published."""
    assert exact_interval(successes, 30) == pytest.approx([low, high], abs=5e-5)


def completion_distribution(probabilities: Sequence[float], runs: Sequence[int]) -> np.ndarray:
    """Return the probability of each total number of completed runs.

    `probabilities` and `runs` have, for each route, the probability of completion and the number of runs.
    """
    distribution = np.ones(1)
    for probability, count in zip(probabilities, runs, strict=True):
        distribution = np.convolve(distribution, binom.pmf(np.arange(count + 1), count, probability))
    return distribution


ROUTE_PROBABILITIES = [
    (1.0, 1.0, 0.0, 1.0, 1.0, 1.0),
    (0.9, 0.9, 0.1, 0.9, 0.9, 0.9),
    (0.5,) * 6,
    (0.98,) * 6,
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0253),
    (0.0, 0.2, 0.0, 0.0, 0.0, 0.4),
    (0.05, 0.3, 0.5, 0.7, 0.95, 1.0),
]


@pytest.mark.parametrize("probabilities", ROUTE_PROBABILITIES)
@pytest.mark.parametrize("runs", [(5,) * 6, (1,) * 6, (5, 5, 4, 5, 3, 5), (2, 20, 1, 1, 1, 5)])
def test_the_pooled_interval_covers_the_mean_over_routes(probabilities: Sequence[float], runs: Sequence[int]) -> None:
    """For any routes, the interval includes the mean probability over all runs in at least 95 % of experiments."""
    mean = float(np.dot(probabilities, runs)) / sum(runs)
    covered = 0.0
    for count, chance in enumerate(completion_distribution(probabilities, runs)):
        low, high = exact_interval(count, sum(runs)) or [1.0, 0.0]
        covered += chance * (low <= mean + 1e-12 and mean - 1e-12 <= high)
    assert covered >= 0.95


def test_the_pooled_interval_covers_any_three_routes() -> None:
    """For three routes with five runs each and any probabilities on a grid, the coverage is at least 95 %."""
    grid = np.linspace(0, 1, 21)
    intervals = [exact_interval(count, 15) or [1.0, 0.0] for count in range(16)]
    for probabilities in itertools.combinations_with_replacement(grid.tolist(), 3):
        mean = sum(probabilities) / 3
        distribution = completion_distribution(probabilities, (5, 5, 5))
        covered = sum(
            chance
            for chance, (low, high) in zip(distribution, intervals, strict=True)
            if low - 1e-12 <= mean <= high + 1e-12
        )
        assert covered >= 0.95, probabilities


def test_the_interval_of_a_count_is_exact() -> None:
    """No event in 30 runs gives 0 to ln 40 / 30, five give the published limits 1.62 and 11.67; no run gives none."""
    assert exact_rate_interval(0, 30) == pytest.approx([0.0, np.log(40) / 30])
    assert exact_rate_interval(5, 1) == pytest.approx([1.62, 11.67], abs=0.005)
    assert exact_rate_interval(0, 0) is None


@pytest.mark.parametrize("mean", [0.02, 0.1, 0.5, 0.9, 2.0])
def test_the_interval_of_a_count_covers_the_mean(mean: float) -> None:
    """The coverage is at least 95 % if the events of 30 runs are Poisson distributed, or at most one in a run."""
    counts = range(150)
    intervals = [exact_rate_interval(count, 30) or [1.0, 0.0] for count in counts]
    covers = [low <= mean <= high for low, high in intervals]
    assert float(np.dot(poisson.pmf(counts, 30 * mean), covers)) >= 0.95
    if mean <= 1:
        assert float(np.dot(binom.pmf(counts, 30, mean), covers)) >= 0.95


def test_intervals_of_too_few_values_are_null() -> None:
    """Without runs there is no exact interval, and with fewer than two values no interval of their mean."""
    assert exact_interval(0, 0) is None
    assert stratified_interval([[]]) is None
    assert stratified_interval([[1.0]]) is None


def test_the_interval_of_one_stratum_is_students() -> None:
    """The interval of the values 1, 2 and 3 is 2 +- 4.303 / sqrt(3)."""
    assert stratified_interval([[1.0, 2.0, 3.0]]) == pytest.approx([2 - 4.303 / 3**0.5, 2 + 4.303 / 3**0.5], abs=0.001)


def test_differences_between_strata_do_not_widen_the_interval() -> None:
    """Three strata of equal spread and different means have 12 degrees of freedom, and the spread within a stratum."""
    deviations = [-0.02, -0.01, 0.0, 0.01, 0.02]
    apart = stratified_interval([[centre + deviation for deviation in deviations] for centre in (0.0, 1.0, 5.0)])
    half_width = 2.179 * float(np.std(deviations, ddof=1)) / 15**0.5
    assert apart == pytest.approx([2 - half_width, 2 + half_width], abs=1e-5)
    assert apart is not None
    pooled = stratified_interval([[centre + deviation for centre in (0.0, 1.0, 5.0) for deviation in deviations]])
    assert pooled is not None
    assert pooled[1] - pooled[0] > 50 * (apart[1] - apart[0])


def test_strata_weigh_as_many_runs_as_they_have() -> None:
    """The interval is that of the mean of all values; a stratum with one value has a weight, but no spread."""
    assert stratified_interval([[1.0, 1.0, 1.0], [5.0]]) == [2.0, 2.0]
    assert stratified_interval([[1.0], [5.0], []]) is None
    assert stratified_interval([]) is None


def test_a_stratum_that_spreads_more_has_the_degrees_of_freedom() -> None:
    """Beside a stratum without spread, the interval is that of the other one, for its share of all values."""
    low, high = stratified_interval([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0]]) or [0.0, 0.0]
    assert (low + high) / 2 == pytest.approx(3.5)
    assert (high - low) / 2 == pytest.approx(4.303 / 3**0.5 / 2, abs=0.001)


@pytest.mark.parametrize("runs", [2, 3, 5])
def test_the_interval_of_strata_covers_the_mean(runs: int) -> None:
    """With six strata of normal values, two of which spread more, it covers the mean in about 95 % of experiments."""
    values = np.random.default_rng(1).normal(0.0, 1.0, (1000, 6, runs)) * np.array([[5], [2], [1], [1], [1], [1]])
    intervals = [stratified_interval(strata) or [1.0, 0.0] for strata in values.tolist()]
    assert sum(low <= 0.0 <= high for low, high in intervals) >= 0.93 * 1000


def test_fewer_than_six_clusters_have_no_interval() -> None:
    """Five values have no interval, six have one, and six equal values have none."""
    assert cluster_interval([0.1, 0.5, 0.2, 0.9, 0.4]) is None
    assert cluster_interval([0.1, 0.5, 0.2, 0.9, 0.4, 0.3]) is not None
    assert cluster_interval([0.5] * 6) is None


def test_the_interval_of_rates_counts_clusters() -> None:
    """Rates of 0 and 1 have the exact interval of their number; a sum between whole numbers is rounded outwards."""
    assert cluster_rate_interval([1.0] + [0.0] * 29) == exact_interval(1, 30)
    assert cluster_rate_interval([0.1] * 10) == exact_interval(1, 10)  # despite the rounding of ten times 0.1
    low, high = cluster_rate_interval([0.5] + [0.0] * 9) or [1.0, 0.0]
    assert [low, high] == [0.0, (exact_interval(1, 10) or [])[1]]
    assert cluster_rate_interval([1.0] * 5) is None


@pytest.mark.parametrize("clusters", [6, 12])
def test_the_interval_of_rates_covers_any_population(clusters: int) -> None:
    """For any distribution over clusters with the rates 0, 1/2 and 1, the coverage is at least 95 %."""
    for none, half in itertools.product(np.linspace(0, 1, 11), repeat=2):
        if none + half > 1 + 1e-9:
            continue
        one_cluster = np.array([none, half, max(1 - none - half, 0.0)])  # of twice the rate
        distribution = np.ones(1)
        for _ in range(clusters):
            distribution = np.convolve(distribution, one_cluster)
        mean = float(one_cluster @ [0.0, 0.5, 1.0])
        covered = 0.0
        for doubled, chance in enumerate(distribution):
            rates = [1.0] * (doubled // 2) + [0.5] * (doubled % 2)
            low, high = cluster_rate_interval([*rates, *[0.0] * (clusters - len(rates))]) or [1.0, 0.0]
            covered += chance * (low - 1e-12 <= mean <= high + 1e-12)
        assert covered >= 0.95, (none, half)


@pytest.mark.parametrize("clusters", [6, 10, 30])
def test_the_interval_of_clusters_covers_the_population(clusters: int) -> None:
    """For normally distributed clusters, the interval covers the true mean in about 95 % of 300 experiments."""
    generator = np.random.default_rng(1)
    covered = 0
    for _ in range(300):
        low, high = cluster_interval(generator.normal(0.0, 1.0, clusters).tolist()) or [1.0, 0.0]
        covered += low <= 0.0 <= high
    assert covered >= 0.92 * 300


def test_holms_correction() -> None:
    """The smallest p value is multiplied by 3, the next by 2, the largest by 1; the results never decrease."""
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])


def test_holms_correction_ignores_missing_tests() -> None:
    """A missing p value remains null and is not counted; no p value exceeds 1."""
    assert holm([None, 0.6, 0.9]) == [None, 1.0, 1.0]
    assert holm([]) == []
