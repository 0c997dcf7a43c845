"""Confidence intervals, and corrections of p values, for few runs. `docs/metrics.md` explains their meaning."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.stats import binomtest, bootstrap

from lavt.streams import stream

RESAMPLES = 10_000
"""The number of bootstrap samples for an interval."""


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


def bootstrap_interval(values: Sequence[float]) -> list[float] | None:
    """Return the 95 % percentile bootstrap interval of the mean; None for fewer than two values.

    The resampling has a fixed seed, so the interval is reproducible.
    """
    if len(values) < 2:
        return None
    interval = bootstrap(
        (np.asarray(values, np.float64),),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=0.95,
        method="percentile",
        random_state=stream(0, "bootstrap interval"),
    ).confidence_interval
    return [float(interval.low), float(interval.high)]


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Return the p values of tests that were planned together, corrected by Holm's method; None remains None."""
    tested = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    corrected: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, index) in enumerate(tested):
        largest = max(largest, min(1.0, (len(tested) - rank) * p))
        corrected[index] = largest
    return corrected
