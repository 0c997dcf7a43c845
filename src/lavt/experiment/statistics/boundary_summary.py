"""Summary of the boundaries of many seeds: median, quartiles, and an exact confidence interval of the median."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import quantile_test

CRITERIA = ("onset", "departure", "completion")

Run = Mapping[str, Any]
"""An entry of `runs` in `boundary.json`."""


def summarize_groups(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Summarize the runs of each route with each preset and, if there are several routes, of all routes together."""
    presets = list(dict.fromkeys(run["preset"] for run in runs))
    routes: list[str | None] = list(dict.fromkeys(run["route"] for run in runs))
    if len(routes) > 1:
        routes.append(None)
    groups = []
    for preset in presets:
        for route in routes:
            chosen = [run for run in runs if run["preset"] == preset and route in (None, run["route"])]
            if chosen:
                groups.append({"route": route, "preset": preset, **_summarize_group(chosen)})
    return groups


def _summarize_group(runs: Sequence[Run]) -> dict[str, Any]:
    return {
        "n": len(runs),
        "theory_ms": runs[0]["theory_ms"],  # a property of the loop, equal for all routes
        **{f"{name}_ms": summarize_boundaries([ranked_ms(run, name) for run in runs]) for name in CRITERIA},
        "not_monotone": {name: sum(name in run["not_monotone"] for run in runs) for name in CRITERIA},
    }


def ranked_ms(run: Run, name: str) -> float:
    """Return a run's boundary by the criterion `name` in ms.

    A boundary outside the searched range is infinite: its value is unknown, but its rank is known.
    """
    value_ms = run[f"{name}_ms"]
    if value_ms is not None:
        return float(value_ms)
    return -math.inf if name in run["below"] else math.inf


def summarize_boundaries(values_ms: Sequence[float]) -> dict[str, Any]:
    """Return quartiles, median and the median's confidence interval; values outside the searched range are infinite.

    A quantile that depends on an infinite value is None. The ends of the interval are two order statistics. The median
    of the population lies between them with a probability of at least 95 %, for any distribution
    (`scipy.stats.quantile_test`; W. J. Conover, Practical Nonparametric Statistics, section 3.2). The interval is None
    for fewer than six values. An end of the interval that is out of range is None. `n` is the number of values in the
    range.
    """
    quartiles = {f"p{share}": _quantile_ms(values_ms, share / 100) for share in (25, 50, 75)}
    return {**quartiles, "interval": _interval(values_ms), "n": sum(math.isfinite(value) for value in values_ms)}


def _quantile_ms(values_ms: Sequence[float], share: float) -> float | None:
    """Return the quantile, interpolated linearly; None if it depends on a value that is out of range."""
    ordered = sorted(values_ms)
    position = share * (len(ordered) - 1)
    first, rest = int(position), position - int(position)
    value = ordered[first] if rest == 0 else (1 - rest) * ordered[first] + rest * ordered[first + 1]
    return float(value) if math.isfinite(value) else None


def _interval(values_ms: Sequence[float]) -> list[float | None] | None:
    bounds = quantile_test(np.array(values_ms), q=0, p=0.5).confidence_interval(confidence_level=0.95)
    ends = [float(bounds.low), float(bounds.high)]
    if any(math.isnan(end) for end in ends):
        return None
    return [end if math.isfinite(end) else None for end in ends]
