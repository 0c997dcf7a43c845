"""The comparison of conditions over the participants of a study: one value for each participant and condition."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from lavt.experiment.statistics.conditions import Run
from lavt.experiment.statistics.within_participants import compare_conditions

SCHEMA = 1
"""The version of `study.json`."""
WORKLOAD = "raw_tlx"

Answers = Mapping[str, Any]
"""The answers of a participant at the end of a block: keys `participant`, `condition`, `driver` and `raw_tlx`."""


def _known(key: str) -> Callable[[Run], float | None]:
    return lambda run: None if run.get(key) is None else float(run[key])


def _steering_reversals(run: Run) -> float | None:
    per_km = run.get("steering_reversals_per_km")
    return None if per_km is None else float(round(per_km * run["distance_m"] / 1000))


MEASURES: Mapping[str, Callable[[Run], float | None]] = {
    "p95_m": _known("p95_m"),
    "completed": lambda run: float(run["ending"] == "completed"),
    "completed_in_own_lane": _known("completed_in_own_lane"),
    "lane_invasions": _known("lane_invasions"),
    "steering_reversals": _steering_reversals,
}
"""The measures of a run that are compared. The first is the primary one, chosen before any study was driven. Others are
left out if nobody has a value, such as that of the own lane, which needs a driver that reports the lane it follows.
Events are counted per drive: with rates per km, drives with equal counts would differ by a few cm of distance, and
a test by ranks would find a difference."""
PRIMARY = next(iter(MEASURES))


def compare_studies(runs: Sequence[Run], answers: Sequence[Answers] = ()) -> list[dict[str, Any]]:
    """Return the comparison for each study and driver among the runs, without those that have a single condition.

    Runs without a participant, and invalid runs, do not enter.
    """
    groups: dict[tuple[Any, Any], list[Run]] = {}
    for run in runs:
        if run.get("participant") is not None:
            groups.setdefault((run.get("sweep"), run["driver"]), []).append(run)
    comparisons = []
    for (sweep, driver), group in groups.items():
        conditions = sorted({str(run["condition"]) for run in group})
        of_group = [entry for entry in answers if (entry.get("sweep"), entry["driver"]) == (sweep, driver)]
        if len(conditions) > 1:
            comparisons.append({"sweep": sweep, "driver": driver, **_compare(group, conditions, of_group)})
    return comparisons


def _compare(runs: Sequence[Run], conditions: Sequence[str], answers: Sequence[Answers]) -> dict[str, Any]:
    participants = sorted({str(run["participant"]) for run in runs}, key=lambda name: (len(name), name))
    by_measure = {
        name: {person: _run_values(runs, person, conditions, measure) for person in participants}
        for name, measure in MEASURES.items()
    }
    by_measure[WORKLOAD] = {person: _workload(answers, person, conditions) for person in participants}
    by_measure = {name: rows for name, rows in by_measure.items() if name == PRIMARY or any(rows.values())}
    return {
        "conditions": list(conditions),
        "measures": {name: _compare_measure(conditions, values) for name, values in by_measure.items()},
    }


def _compare_measure(conditions: Sequence[str], values: Mapping[str, Sequence[float] | None]) -> dict[str, Any]:
    complete = {person: row for person, row in values.items() if row is not None}
    return {
        "left_out": [person for person, row in values.items() if row is None],
        "values": complete,
        **compare_conditions(conditions, complete),
    }


def _run_values(
    runs: Sequence[Run], person: str, conditions: Sequence[str], measure: Callable[[Run], float | None]
) -> list[float] | None:
    """Return the participant's mean for each condition; None if a condition has no value.

    Only those drives (route and repetition) enter that have a value under every condition, so that all means are over
    the same drives.
    """
    values: dict[str, dict[tuple[Any, Any], float]] = {name: {} for name in conditions}
    for run in runs:
        value = measure(run)
        if run["valid"] and str(run["participant"]) == person and value is not None:
            values[str(run["condition"])][run["route"], run["repetition"]] = value
    common = set.intersection(*(set(by_drive) for by_drive in values.values()))
    if not common:
        return None
    return [sum(values[name][drive] for drive in sorted(common)) / len(common) for name in conditions]


def _workload(answers: Sequence[Answers], person: str, conditions: Sequence[str]) -> list[float] | None:
    by_condition = {
        str(entry["condition"]): float(entry["raw_tlx"])
        for entry in answers
        if str(entry["participant"]) == person and entry["raw_tlx"] is not None
    }
    if not by_condition.keys() >= set(conditions):
        return None
    return [by_condition[name] for name in conditions]
