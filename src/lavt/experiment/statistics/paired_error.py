"""The tracking error of conditions of which not every run was completed, beside the paper's over completed runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

QUARTILES = {"p25": 25, "p50": 50, "p75": 75}

Run = Mapping[str, Any]


def common_place(runs: Sequence[Run]) -> dict[tuple[Any, ...], int]:
    """Count the 10 m that every valid run of a route and repetition drove, over all conditions that are in `runs`."""
    places: dict[tuple[Any, ...], int] = {}
    for run in runs:
        if run["valid"] and run.get("p95_by_10m") is not None:
            places[_start(run)] = min(places.get(_start(run), len(run["p95_by_10m"])), len(run["p95_by_10m"]))
    return places


def common_p95_m(runs: Sequence[Run], places: Mapping[tuple[Any, ...], int]) -> list[float]:
    """Give each run's P95 up to the common place; runs of a route and repetition without one are left out."""
    places_of = [(run, places.get(_start(run), 0)) for run in runs if run.get("p95_by_10m")]
    return [float(run["p95_by_10m"][place - 1]) for run, place in places_of if place]


def worst_rank_m(runs: Sequence[Run]) -> dict[str, float | None]:
    """Quartiles of P95 over all runs, one that was not completed being worse than all that were.

    Each is the smallest value that the share of runs does not exceed; null where that is a run not completed. A
    completed run whose error is not known has no rank and is left out.
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
