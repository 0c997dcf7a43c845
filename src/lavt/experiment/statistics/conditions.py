"""The summary of a condition's runs, an entry of `summary.json`. `docs/metrics.md` defines every number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lavt.experiment.statistics.by_road import by_road, collisions_end_runs, completed_values
from lavt.experiment.statistics.intervals import exact_interval, exact_rate_interval, stratified_interval
from lavt.experiment.statistics.survival import survival

Run = Mapping[str, Any]
"""An entry of `runs` in `summary.json`, as `results.run_result` returns it. Entries of older versions lack some
keys."""

CommonDistances = Mapping[tuple[Any, ...], int]
"""The common distance up to which runs are compared, in units of 10 m, by route, repetition and seed."""

MEANS = (
    "mae_m",
    "rms_m",
    "max_m",
    "heading_rms_rad",
    "lateral_jerk_rms_mps3",
    "steering_rate_rms_radps",
    "steering_reversals_per_s",
    "oscillation_hz",
)
"""The measures of which the summary of a condition has the mean, over all valid runs that have the measure."""

QUARTILES = {"p25": 25, "p50": 50, "p75": 75}


def summarize_conditions(runs: Iterable[Run]) -> dict[str, dict[str, Any]]:
    """Summarize runs by condition, sorted by name; all conditions have the same common distances."""
    runs_of = group_by(runs, "condition")
    distances = common_distances([run for condition_runs in runs_of.values() for run in condition_runs])
    return {name: summarize_condition(runs_of[name], distances) for name in sorted(runs_of)}


def summarize_condition(all_runs: Sequence[Run], distances: CommonDistances) -> dict[str, Any]:
    """Summarize the valid runs of one condition."""
    runs = [run for run in all_runs if run["valid"]]
    routes = group_by(runs, "route")
    by_route = [routes[name] for name in sorted(routes)]
    curves = {name: survival(routes[name]) for name in sorted(routes)}
    return {
        **completion(runs),
        **own_lane_completion(runs),
        "endings": dict(sorted(Counter(str(run["ending"]) for run in runs).items())),
        "routes": {name: _summarize_route(routes[name], distances) for name in sorted(routes)},
        "collisions_per_run": _mean([run["collisions"] for run in runs]),
        "collisions_per_run_interval": _collisions_interval(runs),
        "invasion_free_completion_rate": _mean(
            [run["ending"] == "completed" and run["lane_invasions"] == 0 for run in runs]
        ),
        "lane_invasions_per_run": _mean([run["lane_invasions"] for run in runs]),
        "collisions_per_km": _per_km(runs, "collisions"),
        "lane_invasions_per_km": _per_km(runs, "lane_invasions"),
        "by_road": by_road(runs, lambda runs_on_road: common_p95_m(runs_on_road, distances)),
        "p95_m": _mean(completed_values(runs, "p95_m")),
        "p95_interval": stratified_interval([completed_values(runs_on, "p95_m") for runs_on in by_route]),
        "p95_route_balanced_m": _route_balanced(by_route, "p95_m"),
        "p95_routes": sum(bool(completed_values(runs_on, "p95_m")) for runs_on in by_route),
        "followed_p95_m": _mean(completed_values(runs, "followed_p95_m")),
        "followed_p95_route_balanced_m": _route_balanced(by_route, "followed_p95_m"),
        "p95_common_m": _mean(common_p95_m(runs, distances)),
        "p95_common_interval": stratified_interval([common_p95_m(runs_on, distances) for runs_on in by_route]),
        "p95_worst_rank_m": worst_rank_m(runs),
        **{name: _mean([run[name] for run in runs if run.get(name) is not None]) for name in MEANS},
        **{f"{name}_per_run": _lane_kept_mean(runs, name) for name in ("followed_changes", "occupied_changes")},
        **{name: _lane_kept_mean(runs, name) for name in ("own_lane_share", "followed_unknown_share")},
        "injected_ms": _injected_ms(all_runs),
        "tau_v_ms": _latency([run["tau_v_ms"] for run in runs], bounded=True),
        "tau_c_ms": _latency([run["tau_c_ms"] for run in runs], bounded=True),
        "page_decoded_ms": _page_latency(runs, "page_decoded_ms"),
        "page_shown_ms": _page_latency(runs, "page_shown_ms"),
        "loop_ms": _latency([run["loop_ms"] for run in runs]),
        "picture_age_ms": _picture_age_ms(runs),
        "age_at_actuation_ms": _latency([run.get("age_at_actuation_ms") or {"n": 0} for run in runs]),
        "stages_ms": _stages_ms(runs),
        "survival": {name: curve for name, curve in curves.items() if curve},
    }


def completion(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the completion rate of these valid runs, with its exact interval."""
    completed = sum(run["ending"] == "completed" for run in runs)
    return {
        "runs": len(runs),
        "completed": completed,
        "completion_rate": completed / len(runs) if runs else None,
        "completion_interval": exact_interval(completed, len(runs)),
    }


def own_lane_completion(runs: Sequence[Run]) -> dict[str, Any]:
    """Return how many of these valid runs were completed in their own lane, the rate, and its exact interval.

    Runs of which this is unknown are left out of the rate.
    """
    known = [run["completed_in_own_lane"] for run in runs if run.get("completed_in_own_lane") is not None]
    return {
        "completed_in_own_lane": sum(known) if known else None,
        "own_lane_completion_rate": sum(known) / len(known) if known else None,
        "own_lane_completion_interval": exact_interval(sum(known), len(known)),
    }


def _collisions_interval(runs: Sequence[Run]) -> list[float] | None:
    """Return the exact interval of the number of collisions per run, a share of the runs if a collision ends a run."""
    interval = exact_interval if collisions_end_runs(runs) else exact_rate_interval
    return interval(sum(run["collisions"] for run in runs), len(runs))


def group_by(runs: Iterable[Run], key: str) -> dict[str, list[Run]]:
    """Group the runs by their value of `key`, converted to text."""
    runs_of: dict[str, list[Run]] = {}
    for run in runs:
        runs_of.setdefault(str(run[key]), []).append(run)
    return runs_of


def common_distances(runs: Sequence[Run]) -> CommonDistances:
    """Return for each route, repetition and seed the distance, in units of 10 m, that all its valid runs reached."""
    distances: dict[tuple[Any, ...], int] = {}
    for run in runs:  # `p95_by_10m` has an entry for each 10 m that the run reached
        if run["valid"] and run.get("p95_by_10m") is not None:
            key, distance = _start_key(run), len(run["p95_by_10m"])
            distances[key] = min(distances.get(key, distance), distance)
    return distances


def common_p95_m(runs: Sequence[Run], distances: CommonDistances) -> list[float]:
    """Return the P95 error of each run up to its common distance; runs whose common distance is 0 are left out."""
    runs_and_distances = [(run, distances.get(_start_key(run), 0)) for run in runs if run.get("p95_by_10m")]
    return [float(run["p95_by_10m"][distance - 1]) for run, distance in runs_and_distances if distance]


def worst_rank_m(runs: Sequence[Run]) -> dict[str, float | None]:
    """Return the quartiles of P95 of all runs, with the worst rank for each run that was not completed.

    The worst rank is an infinite P95. The quartile of 25, 50 or 75 % is the smallest P95 of any run that at least this
    share of the runs does not exceed. An infinite quartile is returned as None. A completed run whose error is unknown
    is left out.
    """
    errors_m = [run["p95_m"] if run["ending"] == "completed" else np.inf for run in runs]
    known = [value for value in errors_m if value is not None]
    quartiles = {
        name: float(np.percentile(known, share, method="inverted_cdf")) if known else np.inf
        for name, share in QUARTILES.items()
    }
    return {name: value if np.isfinite(value) else None for name, value in quartiles.items()}


def _start_key(run: Run) -> tuple[Any, ...]:
    """Return a key that is equal for runs with the same start on the same route, under any condition."""
    return run["route"], run.get("repetition"), run.get("seed")


def _summarize_route(runs: Sequence[Run], distances: CommonDistances) -> dict[str, Any]:
    return {
        **completion(runs),
        "completed_in_own_lane": own_lane_completion(runs)["completed_in_own_lane"],
        "p95_m": _mean(completed_values(runs, "p95_m")),
        "followed_p95_m": _mean(completed_values(runs, "followed_p95_m")),
        "p95_common_m": _mean(common_p95_m(runs, distances)),
    }


def _route_balanced(runs_by_route: Sequence[Sequence[Run]], name: str) -> float | None:
    """Return the mean over routes of the mean over their completed runs; routes without such a run are left out."""
    values = [completed_values(runs, name) for runs in runs_by_route]
    return _mean([float(np.mean(on_route)) for on_route in values if on_route])


def _lane_kept_mean(runs: Sequence[Run], name: str) -> float | None:
    return _mean([run["lane_kept"][name] for run in runs if name in (run.get("lane_kept") or {})])


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _per_km(runs: Sequence[Run], name: str) -> float | None:
    """Return the number of all events `name` divided by the sum of all distances in km.

    So the weight of a run is proportional to its distance, and a run of a few metres has almost no weight.
    """
    driven = [run for run in runs if run.get("distance_m")]
    return sum(run[name] for run in driven) / (sum(run["distance_m"] for run in driven) / 1000) if driven else None


def _injected_ms(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the requested delay, which is the same for all runs of a condition."""
    requested: Mapping[str, Any] = next((run["injected_ms"] for run in runs if run.get("injected_ms")), {})
    return {"video": requested.get("video"), "control": requested.get("control")}


def _latency(entries: Sequence[Mapping[str, Any]], *, bounded: bool = False) -> dict[str, Any]:
    """Return for each percentile its median over all runs, and with `bounded` the largest bound.

    The bound is None if one of the runs has no bound.
    """
    known = [entry for entry in entries if entry["n"]]
    summary: dict[str, Any] = {
        name: float(np.median([entry[name] for entry in known])) if known else None for name in ("p5", "p50", "p95")
    }
    if bounded:
        bounds = [entry["bound"] for entry in known]
        summary["bound"] = max(bounds) if bounds and None not in bounds else None
    summary["n"] = sum(entry["n"] for entry in known)
    return summary


def _page_latency(runs: Sequence[Run], name: str) -> dict[str, Any]:
    """Return the summary of a latency with a bound and a maximum; the maximum is the largest of all runs."""
    known = [run[name] for run in runs if (run.get(name) or {}).get("n")]
    return {**_latency(known, bounded=True), "max": max((entry["max"] for entry in known), default=None)}


def _picture_age_ms(runs: Sequence[Run]) -> dict[str, float | None]:
    known = [run["picture_age_ms"] for run in runs if (run.get("picture_age_ms") or {}).get("mean") is not None]
    return {name: float(np.median([age[name] for age in known])) if known else None for name in ("mean", "p95")}


def _stages_ms(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the stages in the order in which a frame passes them, with the median of the runs' median latencies."""
    medians_ms: dict[tuple[str, str], list[float]] = {}
    # The order is that of the run with the most stages.
    most_stages_first = sorted(runs, key=lambda run: -len(run.get("stages_ms") or []))
    for run in most_stages_first:
        for entry in run.get("stages_ms") or []:
            medians_ms.setdefault((entry["node"], entry["stage"]), []).append(entry["p50"])
    return [
        {"node": node, "stage": stage, "p50": float(np.median(values_ms))}
        for (node, stage), values_ms in medians_ms.items()
    ]
