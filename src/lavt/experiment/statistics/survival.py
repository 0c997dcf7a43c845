"""Survival: the distances at which runs ended early, by route."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from scipy.stats import CensoredData, ecdf

from lavt.experiment.statistics.intervals import exact_interval


def survival(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Return the share of runs that still drive, and the incidence of each ending, over distance.

    `runs` are the valid runs on one route. Both results are step functions: a value is valid from its `distance_m` up
    to the next one. Any ending except `completed` is an event at the distance driven. A completed run is censored at
    the length of the route, where the steps end. Runs whose distance is unknown are left out. Without runs, the result
    is None.
    """
    runs = [run for run in runs if run.get("distance_m") is not None]
    if not runs:
        return None
    ended = [run for run in runs if run["ending"] != "completed"]
    length_m = _length_m(runs)
    ended_m = [min(float(run["distance_m"]), length_m) for run in ended]
    lifetimes = CensoredData(uncensored=ended_m, right=[length_m] * (len(runs) - len(ended)))
    distances_m = sorted({0.0, *ended_m, length_m})
    surviving = [float(share) for share in ecdf(lifetimes).sf.evaluate(distances_m)]
    # No run is censored before the end of the route, so the number of runs that still drive at a distance is binomial.
    intervals = [
        exact_interval(sum(end_m > distance_m for end_m in ended_m) + len(runs) - len(ended), len(runs))
        for distance_m in distances_m
    ]
    endings = sorted({str(run["ending"]) for run in ended})
    return {
        "distance_m": distances_m,
        "surviving": surviving,
        "low": [interval[0] for interval in intervals if interval],
        "high": [interval[1] for interval in intervals if interval],
        "incidence": {
            ending: [
                sum(run["ending"] == ending and end_m <= distance_m for run, end_m in zip(ended, ended_m, strict=True))
                / len(runs)
                for distance_m in distances_m
            ]
            for ending in endings
        },
    }


def _length_m(runs: Sequence[Mapping[str, Any]]) -> float:
    """Return the length of the route or, if no run has it, the longest distance of any run."""
    lengths_m = [run["route_length_m"] for run in runs if run.get("route_length_m")]
    return float(max(lengths_m or [run["distance_m"] for run in runs]))
