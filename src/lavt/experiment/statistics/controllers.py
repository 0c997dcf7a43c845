"""Controllers of one sweep side by side: completion, tracking and comfort, and tests against the best baseline."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from lavt.experiment.statistics.by_road import road_of
from lavt.experiment.statistics.conditions import own_lane_completion
from lavt.experiment.statistics.contrasts import PAIRED_BY, mcnemar
from lavt.experiment.statistics.intervals import holm
from lavt.experiment.statistics.within_participants import signed_rank

Run = Mapping[str, Any]
"""An entry of `runs` in `summary.json`."""

AXIS: Final = "controller.kind"
SUBJECT: Final = "predictive"
"""The controller that is tested against the best of the others."""
PLACE: Final = ("sweep", "time", "fidelity", "inherent", "changes", "condition")
"""Keys that are equal in the runs that are compared with each other, besides the sweep's further axes."""
MEDIANS: Final = ("p95_m", "lateral_jerk_rms_mps3", "steering_rate_rms_radps")
"""The measures of which an entry has the median over all valid runs, completed or not."""
TESTS: Final = ("p_completion", "p_error")


def compare_controllers(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return an entry for each controller at each place; none unless a sweep has varied the controller.

    A place is a condition with the values of the further axes. The entry of `SUBJECT` has the key `test`, with Holm's
    correction over all places; it is None for the other controllers, and without a baseline.
    """
    places: dict[str, list[Run]] = {}  # by the JSON of their settings
    for run in runs:
        if run["valid"] and AXIS in (run.get("axes") or {}):
            places.setdefault(json.dumps(_place(run), sort_keys=True, default=str), []).append(run)
    entries = [entry for place in places.values() for entry in _compare_place(place)]
    tests = [entry["test"] for entry in entries if entry["test"] is not None]
    for name in TESTS:
        known = [test for test in tests if test[name] is not None]
        for test, p in zip(known, holm([test[name] for test in known]), strict=True):
            test[f"{name}_holm"] = p
    return entries


def _place(run: Run) -> dict[str, Any]:
    axes = {name: value for name, value in run["axes"].items() if name != AXIS}
    return {**{name: run[name] for name in PLACE if run.get(name) is not None}, "axes": axes}


def _compare_place(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the entries of one place, that of `SUBJECT` first."""
    by_kind: dict[str, list[Run]] = {}
    for run in runs:
        by_kind.setdefault(str(run["axes"][AXIS]), []).append(run)
    if len(by_kind) < 2:
        return []
    kinds = sorted(by_kind, key=lambda kind: (kind != SUBJECT, kind))
    best = best_of({kind: by_kind[kind] for kind in kinds if kind != SUBJECT})
    return [
        {
            **_place(runs[0]),
            "controller": kind,
            "runs": len(by_kind[kind]),
            **own_lane_completion(by_kind[kind]),
            **{name: _median([run.get(name) for run in by_kind[kind]]) for name in MEDIANS},
            "mean_speed_mps": _median([_mean_speed_mps(run) for run in by_kind[kind]]),
            "test": {"baseline": best, **compare_pairs(by_kind[kind], by_kind[best])} if kind == SUBJECT else None,
        }
        for kind in kinds
    ]


def best_of(by_kind: Mapping[str, Sequence[Run]]) -> str:
    """Return the controller with the most runs completed in their own lane, and of these the one with the least error.

    The error is the median P95 of the cross-track error over all runs.
    """

    def rank(kind: str) -> tuple[int, float]:
        completed = sum(bool(run.get("completed_in_own_lane")) for run in by_kind[kind])
        error_m = _median([run.get("p95_m") for run in by_kind[kind]])
        return -completed, np.inf if error_m is None else error_m

    return min(by_kind, key=rank)


def compare_pairs(subject: Sequence[Run], baseline: Sequence[Run]) -> dict[str, Any]:
    """Test the runs of two controllers against each other; a pair has equal `PAIRED_BY` keys.

    Completion in the own lane: McNemar's exact test, which takes the pairs as independent. Error: Wilcoxon's exact
    signed-rank test with the route as the unit; the value of a route is the mean difference (subject - baseline) of the
    P95 of its pairs in which both runs were completed in their own lane. `smallest_p_error` is the p value if all
    routes differed in the same direction. The routes of one road are alike, and `roads` says how many roads there are.
    """
    others = {_pair_key(run): run for run in baseline}
    pairs = [(run, others[_pair_key(run)]) for run in subject if _pair_key(run) in others]
    completions = [(run.get("completed_in_own_lane"), other.get("completed_in_own_lane")) for run, other in pairs]
    only_subject, only_baseline = completions.count((True, False)), completions.count((False, True))
    differences_m: dict[str, list[float]] = {}
    for (run, other), both in zip(pairs, completions, strict=True):
        if both == (True, True) and run.get("p95_m") is not None and other.get("p95_m") is not None:
            differences_m.setdefault(str(run["route"]), []).append(run["p95_m"] - other["p95_m"])
    of_routes = signed_rank(np.array([np.mean(values) for values in differences_m.values()])) if differences_m else None
    return {
        "pairs": len(pairs),
        "only_subject": only_subject,
        "only_baseline": only_baseline,
        "p_completion": mcnemar(only_subject, only_baseline) if pairs else None,
        "error_pairs": sum(map(len, differences_m.values())),
        "routes": len(differences_m),
        "roads": len({road_of(route) for route in differences_m}),
        "p95_difference_m": None if of_routes is None else of_routes["median_difference"],
        "p_error": None if of_routes is None else of_routes["p"],
        "smallest_p_error": None if of_routes is None else of_routes["smallest_p"],
    }


def _pair_key(run: Run) -> tuple[Any, ...]:
    return tuple(run.get(name) for name in PAIRED_BY)


def _mean_speed_mps(run: Run) -> float | None:
    return run["distance_m"] / run["duration_s"] if run.get("distance_m") and run.get("duration_s") else None


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
