"""Confidence intervals, and corrections of p values, for few runs. `docs/metrics.md` explains their meaning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.stats import binomtest, bootstrap, chi2, norm, t

from lavt.streams import stream

RESAMPLES = 10_000
"""The number of bootstrap samples for an interval."""

FEWEST_CLUSTERS = 6
"""With fewer values, even their whole range contains the median of the population with a probability of less than 95 %:
1 - 2 / 2^n. And no two-sided sign test of n pairs can have a p value of less than 2 / 2^n."""


def exact_interval(successes: int, trials: int) -> list[float] | None:
    """Return the 95 % Clopper-Pearson interval of a proportion; None without trials.

    If the trials have different probabilities, the interval is valid for their mean (Hoeffding, Annals of Mathematical
    Statistics 27, 1956, theorem 4). So trials on different routes can be counted together.
    """
    if trials == 0:
        return None
    return list(_clopper_pearson(successes, trials))


@cache  # a sweep needs the same few intervals many times
def _clopper_pearson(successes: int, trials: int) -> tuple[float, float]:
    interval = binomtest(successes, trials).proportion_ci(confidence_level=0.95, method="exact")
    return float(interval.low), float(interval.high)


def exact_rate_interval(count: int, runs: int) -> list[float] | None:
    """Return the 95 % interval of the mean number of events per run, from the number of all events; None without runs.

    It is exact for Poisson distributed numbers, also if the runs have different rates (F. Garwood, Fiducial Limits for
    the Poisson Distribution, Biometrika 28, 1936).
    """
    if runs == 0:
        return None
    low = float(chi2.ppf(0.025, 2 * count)) / 2 if count else 0.0
    return [low / runs, float(chi2.ppf(0.975, 2 * count + 2)) / 2 / runs]


def stratified_interval(strata: Sequence[Sequence[float]]) -> list[float] | None:
    """Return the 95 % interval of the mean of all values, from the spread within each stratum.

    So differences between the strata do not widen the interval. It is Student's t, with the degrees of freedom of
    F. E. Satterthwaite (An Approximate Distribution of Estimates of Variance Components, Biometrics Bulletin 2, 1946),
    because the strata may spread differently. A stratum with one value has no spread. The result is None if no stratum
    has two values.
    """
    samples = [np.asarray(values, np.float64) for values in strata if values]
    spread = [values for values in samples if len(values) > 1]
    if not spread:
        return None
    count = sum(map(len, samples))
    mean = float(sum(values.sum() for values in samples)) / count
    variances = np.array([len(values) * values.var(ddof=1) for values in spread]) / count**2
    variance = float(variances.sum())
    if variance == 0:
        return [mean, mean]
    freedom = variance**2 / np.sum(variances**2 / [len(values) - 1 for values in spread])
    half_width = float(t.ppf(0.975, freedom)) * math.sqrt(variance)
    return [mean - half_width, mean + half_width]


def has_enough_clusters(count: int) -> bool:
    """Return whether so many clusters can support a 95 % statement about the population of clusters."""
    return count >= FEWEST_CLUSTERS


def cluster_interval(means: Sequence[float]) -> list[float] | None:
    """Return the 95 % interval of the mean over a population of clusters, from the means of sampled clusters.

    It is the expanded percentile bootstrap interval (T. C. Hesterberg, What Teachers Should Know About the Bootstrap,
    The American Statistician 69, 2015, section 5.3), which is as wide as Student's t for these few values. The result
    is None for fewer than `FEWEST_CLUSTERS` means, and if all are equal.
    """
    count = len(means)
    if not has_enough_clusters(count) or len(set(means)) == 1:
        return None
    level = 1 - 2 * float(norm.cdf(-np.sqrt(count / (count - 1)) * t.ppf(0.975, count - 1)))
    return list(_bootstrap(tuple(means), level))


def cluster_rate_interval(rates: Sequence[float]) -> list[float] | None:
    """Return the 95 % interval of the mean rate over a population of clusters; None for fewer than `FEWEST_CLUSTERS`.

    It is Clopper and Pearson's interval, as if each cluster had the rate 0 or 1: of all rates with the same mean, these
    are spread most. A sum of rates that is not whole is rounded down for the lower and up for the upper limit.
    """
    count, total = len(rates), round(math.fsum(rates), 9)
    if not has_enough_clusters(count):
        return None
    return [_clopper_pearson(math.floor(total), count)[0], _clopper_pearson(math.ceil(total), count)[1]]


@cache  # the runs of the base config are summarized twice
def _bootstrap(values: tuple[float, ...], level: float) -> tuple[float, float]:
    interval = bootstrap(
        (np.asarray(values, np.float64),),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=level,
        method="percentile",
        random_state=stream(0, "bootstrap interval"),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Return the p values of tests that were planned together, corrected by Holm's method; None remains None."""
    tested = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, index) in enumerate(tested):
        largest = max(largest, min(1.0, (len(tested) - rank) * p))
        corrected[index] = largest
    return corrected
