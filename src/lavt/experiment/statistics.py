"""Intervals: how far a number from few runs can be trusted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest

from lavt.streams import stream

RESAMPLES = 10_000


def wilson_interval(successes: int, trials: int) -> list[float] | None:
    """Wilson score interval of a proportion, 95 %; None without trials."""
    if trials == 0:
        return None
    interval = binomtest(successes, trials).proportion_ci(confidence_level=0.95, method="wilson")
    return [float(interval.low), float(interval.high)]


def bootstrap_interval(values: Sequence[float]) -> list[float] | None:
    """Percentile bootstrap interval of the mean over runs, 95 %; None for fewer than two.

    The resampling has a fixed seed: the same runs give the same interval.
    """
    if len(values) < 2:
        return None
    chosen = stream(0, "bootstrap interval").integers(0, len(values), size=(RESAMPLES, len(values)))
    means = np.asarray(values, np.float64)[chosen].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return [float(low), float(high)]
