"""The runs of one condition as one entry of `summary.json`. `docs/metrics.md` has the meaning of every number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lavt.experiment.statistics.intervals import bootstrap_interval, exact_interval
from lavt.experiment.statistics.paired_error import common_p95_m, common_place, worst_rank_m
from lavt.experiment.statistics.survival import survival

Run = Mapping[str, Any]
"""An entry of `runs`, as `results.run_result` makes it. One of an older version lacks some keys."""

Places = Mapping[tuple[Any, ...], int]
"""How far runs are compared, from `compared_error.common_place`."""

KEY_PART = "_key"
"""Ends the name of a route that is a part of another: the two are the same road."""

MEANS = (
    "mae_m",
    "rms_m",
    "max_m",
    "heading_rms_rad",
    "steering_reversals_per_s",
    "oscillation_hz",
)
"""Of these a condition has the mean over its valid runs, as far as they are known."""


def by_condition(runs: Iterable[Run]) -> dict[str, dict[str, Any]]:
    """Aggregate runs condition by condition, in order of the conditions' names; they are compared with each other."""
    members = by_name(runs, "condition")
    places = common_place([run for each in members.values() for run in each])
    return {name: condition_summary(members[name], places) for name in sorted(members)}


def condition_summary(all_runs: Sequence[Run], places: Places) -> dict[str, Any]:
    """Aggregate the runs of one condition. Runs that are not valid are left out of everything."""
    runs = [run for run in all_runs if run["valid"]]
    routes = by_name(runs, "route")
    p95_m, p95_common_m = _completed_p95_m(runs), common_p95_m(runs, places)
    curves = {name: survival(routes[name]) for name in sorted(routes)}
    return {
        **completion(runs),
        "completion_such_roads": bootstrap_interval(road_rates(runs)),
        "endings": dict(sorted(Counter(str(run["ending"]) for run in runs).items())),
        "routes": {name: _route(routes[name], places) for name in sorted(routes)},
        "collisions_per_run": _mean([run["collisions"] for run in runs]),
        "lane_invasions_per_run": _mean([run["lane_invasions"] for run in runs]),
        "collisions_per_km": _per_km(runs, "collisions"),
        "lane_invasions_per_km": _per_km(runs, "lane_invasions"),
        "p95_m": _mean(p95_m),
        "p95_interval": bootstrap_interval(p95_m),
        "p95_common_m": _mean(p95_common_m),
        "p95_common_interval": bootstrap_interval(p95_common_m),
        "p95_worst_rank_m": worst_rank_m(runs),
        **{name: _mean([run[name] for run in runs if run.get(name) is not None]) for name in MEANS},
        "injected_ms": _injected_ms(all_runs),
        "tau_v_ms": _latency([run["tau_v_ms"] for run in runs], bounded=True),
        "tau_c_ms": _latency([run["tau_c_ms"] for run in runs], bounded=True),
        "loop_ms": _latency([run["loop_ms"] for run in runs]),
        "picture_age_ms": _picture_age_ms(runs),
        "age_at_actuation_ms": _latency([run.get("age_at_actuation_ms") or {"n": 0} for run in runs]),
        "stages_ms": _stages_ms(runs),
        "survival": {name: curve for name, curve in curves.items() if curve},
    }


def completion(runs: Sequence[Run]) -> dict[str, Any]:
    """Count how many of these valid runs were completed, with the exact interval."""
    completed = sum(run["ending"] == "completed" for run in runs)
    return {
        "runs": len(runs),
        "completed": completed,
        "completion_rate": completed / len(runs) if runs else None,
        "completion_interval": exact_interval(completed, len(runs)),
    }


def stem_of(route: str) -> str:
    """Give a route's name, or the path of its file without ".yaml"."""
    return route.removesuffix(".yaml").removesuffix(".yml")


def road_of(route: str) -> str:
    """Give the name of the road that a route, or a key part, is of."""
    return stem_of(route).removesuffix(KEY_PART)


def road_rates(runs: Sequence[Run]) -> list[float]:
    """Completion rate of each road: a route and its key part are one, by name or by path."""
    members: dict[str, list[bool]] = {}
    for run in runs:
        members.setdefault(road_of(str(run["route"])), []).append(run["ending"] == "completed")
    return [sum(members[road]) / len(members[road]) for road in sorted(members)]


def by_name(runs: Iterable[Run], key: str) -> dict[str, list[Run]]:
    """Sort runs into lists by the text of one of their keys."""
    members: dict[str, list[Run]] = {}
    for run in runs:
        members.setdefault(str(run[key]), []).append(run)
    return members


def _route(runs: Sequence[Run], places: Places) -> dict[str, Any]:
    return {
        **completion(runs),
        "p95_m": _mean(_completed_p95_m(runs)),
        "p95_common_m": _mean(common_p95_m(runs, places)),
    }


def _completed_p95_m(runs: Sequence[Run]) -> list[float]:
    return [run["p95_m"] for run in runs if run["ending"] == "completed" and run["p95_m"] is not None]


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _per_km(runs: Sequence[Run], name: str) -> float | None:
    """All events over all kilometres: a run that ended after a few metres does not outweigh one that drove far."""
    driven = [run for run in runs if run.get("distance_m")]
    return sum(run[name] for run in driven) / (sum(run["distance_m"] for run in driven) / 1000) if driven else None


def _injected_ms(runs: Sequence[Run]) -> dict[str, Any]:
    """Say what was asked of the network; the runs of a condition were all asked the same."""
    requested: Mapping[str, Any] = next((run["injected_ms"] for run in runs if run.get("injected_ms")), {})
    return {"video": requested.get("video"), "control": requested.get("control")}


def _latency(entries: Sequence[Mapping[str, Any]], *, bounded: bool = False) -> dict[str, Any]:
    """Median over runs of each run's percentiles; the largest bound, null as soon as one run has none."""
    known = [entry for entry in entries if entry["n"]]
    summary: dict[str, Any] = {
        name: float(np.median([entry[name] for entry in known])) if known else None for name in ("p5", "p50", "p95")
    }
    if bounded:
        bounds = [entry["bound"] for entry in known]
        summary["bound"] = max(bounds) if bounds and None not in bounds else None
    summary["n"] = sum(entry["n"] for entry in known)
    return summary


def _picture_age_ms(runs: Sequence[Run]) -> dict[str, float | None]:
    known = [run["picture_age_ms"] for run in runs if (run.get("picture_age_ms") or {}).get("mean") is not None]
    return {name: float(np.median([age[name] for age in known])) if known else None for name in ("mean", "p95")}


def _stages_ms(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Median over runs of each hop's median, in the order of a frame's life."""
    p50_ms: dict[tuple[str, str], list[float]] = {}
    for run in sorted(runs, key=lambda run: -len(run.get("stages_ms") or [])):  # the fullest tells the order
        for entry in run.get("stages_ms") or []:
            p50_ms.setdefault((entry["node"], entry["stage"]), []).append(entry["p50"])
    return [{"node": node, "stage": stage, "p50": float(np.median(each))} for (node, stage), each in p50_ms.items()]
