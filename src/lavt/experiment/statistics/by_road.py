"""Statistics with the road as their unit: repeated runs on one road are not independent evidence on other roads."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lavt.experiment.statistics.intervals import cluster_interval, cluster_rate_interval

Run = Mapping[str, Any]
"""An entry of `runs` in `summary.json`."""

KEY_PART = "_key"
"""The suffix of a route that is the key part of another route. Both routes are on the same road."""


def is_key_part(route: str) -> bool:
    """Return whether a route is the key part of another route."""
    return _route_name(route).endswith(KEY_PART)


def road_of(route: str) -> str:
    """Return the name of the road of a route; a route and its key part have the same road."""
    return _route_name(route).removesuffix(KEY_PART)


def _route_name(route: str) -> str:
    """Return a route's name, or the path of its file without ".yaml"."""
    return route.removesuffix(".yaml").removesuffix(".yml")


def group_by_road(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Group the runs by road, sorted by road."""
    runs_on: dict[str, list[Run]] = {}
    for run in runs:
        runs_on.setdefault(road_of(str(run["route"])), []).append(run)
    return {road: runs_on[road] for road in sorted(runs_on)}


def completed_values(runs: Sequence[Run], name: str) -> list[float]:
    """Return the known values of a measure, of the completed runs only."""
    return [run[name] for run in runs if run["ending"] == "completed" and run.get(name) is not None]


def collisions_end_runs(runs: Sequence[Run]) -> bool:
    """Return whether each collision ended its run, so that collisions per run are a share of the runs."""
    return all(run["collisions"] == (run["ending"] == "collision") for run in runs)


def by_road(valid_runs: Sequence[Run], common_p95_m: Callable[[Sequence[Run]], Sequence[float]]) -> dict[str, Any]:
    """Return for each main result its mean over roads, with the interval for other roads of this kind.

    The value of a road is the mean over its runs. `common_p95_m` returns the P95 errors of runs up to the common
    distance.
    """
    measures: dict[str, Callable[[Sequence[Run]], Sequence[float]]] = {
        "completion_rate": lambda runs: [float(run["ending"] == "completed") for run in runs],
        "own_lane_completion_rate": lambda runs: [
            float(run["completed_in_own_lane"]) for run in runs if run.get("completed_in_own_lane") is not None
        ],
        "collisions_per_run": lambda runs: [float(run["collisions"]) for run in runs],
        "p95_m": lambda runs: completed_values(runs, "p95_m"),
        "p95_all_runs_m": lambda runs: [run["p95_m"] for run in runs if run.get("p95_m") is not None],
        "followed_p95_m": lambda runs: completed_values(runs, "followed_p95_m"),
        "p95_common_m": common_p95_m,
    }
    rates = {"completion_rate", "own_lane_completion_rate"}
    if collisions_end_runs(valid_runs):
        rates.add("collisions_per_run")
    roads = list(group_by_road(valid_runs).values())
    return {
        name: _over_roads([values_of(runs) for runs in roads], is_rate=name in rates)
        for name, values_of in measures.items()
    }


def _over_roads(values_by_road: Sequence[Sequence[float]], *, is_rate: bool) -> dict[str, Any]:
    """Return the number of roads that have a value, the mean over these roads, and its interval."""
    means = [float(np.mean(values)) for values in values_by_road if values]
    interval = cluster_rate_interval(means) if is_rate else cluster_interval(means)
    low, high = interval or (None, None)
    return {"roads": len(means), "mean": float(np.mean(means)) if means else None, "low": low, "high": high}
