"""Tracking errors that include runs that were not completed, unlike the paper's error over completed runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

QUARTILES = {"p25": 25, "p50": 50, "p75": 75}

Run = Mapping[str, Any]


def common_distances(runs: Sequence[Run]) -> dict[tuple[Any, ...], int]:
    """Return for each route, repetition and seed the distance (in 10 m) that its valid runs of all conditions drove."""
    distances: dict[tuple[Any, ...], int] = {}
    for run in runs:
        if run["valid"] and run.get("p95_by_10m") is not None:
            distances[_start(run)] = min(distances.get(_start(run), len(run["p95_by_10m"])), len(run["p95_by_10m"]))
    return distances


def common_p95_m(runs: Sequence[Run], distances: Mapping[tuple[Any, ...], int]) -> list[float]:
    """Return each run's P95 up to its common distance; runs with a common distance of 0 are left out."""
    with_distance = [(run, distances.get(_start(run), 0)) for run in runs if run.get("p95_by_10m")]
    return [float(run["p95_by_10m"][distance - 1]) for run, distance in with_distance if distance]


def worst_rank_m(runs: Sequence[Run]) -> dict[str, float | None]:
    """Return the quartiles of P95 over all runs, where a run that was not completed is worse than all completed ones.

    Each is the smallest value that the share of runs does not exceed; None where that is a run that was not completed.
    A completed run with an unknown error is left out.
    """
    ranked = [run["p95_m"] if run["ending"] == "completed" else np.inf for run in runs]
    known = [value for value in ranked if value is not None]
    quartiles = {
        name: float(np.percentile(known, share, method="inverted_cdf")) if known else np.inf
        for name, share in QUARTILES.items()
    }
    return {name: value if np.isfinite(value) else None for name, value in quartiles.items()}


def _start(run: Run) -> tuple[Any, ...]:
    return run["route"], run.get("repetition"), run.get("seed")
