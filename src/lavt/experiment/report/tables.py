"""The tables of a report, as data, without those of conditions and contrasts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from lavt.experiment.analysis.stage_latency import AFTER_LOOP
from lavt.experiment.report.condition_tables import COMMON_P95, COMPLETED_P95, JERK, STEERING_RATE
from lavt.experiment.report.figures.figure_style import Conditions
from lavt.experiment.report.groups import Group, short_name
from lavt.experiment.report.table_format import (
    NOTHING,
    UNBROKEN,
    Column,
    TableData,
    extra,
    format_percent,
    format_with_bound,
    number_column,
    share_column,
    share_interval_column,
    table_of_entries,
    text_column,
)

AFTER_LOOP_SUFFIX = ", after the loop"
"""Marks a stage that is not part of the loop, in the table of stages."""

FIDELITY_DESCRIPTIONS = {
    "video": "modelled network and clocks, real images, codec and packets",
    "pixels": "modelled network, clocks and codec, real images",
    "geometry": "modelled network, clocks, codec, camera and perception, lane detection without errors",
}

CHECKS: Mapping[str, tuple[str, float]] = {
    "loop_jitter": ("loop jitter, ms", 1.0),
    "physics_late": ("physics late, % of the drive", 100.0),
    "frames_missed": ("frames that the camera missed, %", 100.0),
    "injection_differs": ("delay in the relay against the request, ms", 1.0),
    "injection_not_on_path": ("injected delay that the latency lacks, %", 100.0),
    "closure": ("sum of the loop's parts against the loop latency, p95, ms", 1.0),
    "clock_step": ("step of a clock, ms", 1.0),
    "clock_not_sampled": ("time without a sample of a clock, s", 1.0),
    "clock_bound": ("error bound of the clock offset, ms", 1.0),
    "clock_disagreement": ("clock offset against the probe's, ms", 1.0),
}
"""The label of each check with a number, by its code, and the factor by which its value is multiplied."""


def run_setup(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return a text on the runs' kind of time, the parts that were modelled, and the injection of the delay."""
    setups = {(run["time"], run.get("fidelity") or "video", run["injection"]) for run in runs}
    return "; ".join(
        f"virtual time, fidelity {fidelity}: {FIDELITY_DESCRIPTIONS[fidelity]}"
        if time == "virtual"
        else f"real time, {'nothing injected' if injection == 'none' else f'injected by {injection}'}"
        for time, fidelity, injection in sorted(setups, key=str)
    )


def group_table(groups: Sequence[Group], names: Sequence[str]) -> TableData:
    """Return the table of groups: one row for each condition of each group.

    `names` are the settings that distinguish the groups.
    """
    entries = [  # the keys of the settings are numbers, because dots in a key mean nested entries
        {**entry, "condition": name, **{str(index): group.get(key) for index, key in enumerate(names)}}
        for group in groups
        for name, entry in group["conditions"].items()
    ]
    return table_of_entries(
        entries,
        [
            *((text_column(short_name(name)), str(index)) for index, name in enumerate(names)),
            (text_column("condition"), "condition"),
            (number_column("runs", 0), "runs"),
            (share_column("completed"), "completion_rate"),
            (extra(share_interval_column("95 % interval")), "completion_interval"),
            (share_column("completed in own lane"), "own_lane_completion_rate"),
            (extra(number_column("collisions / run", 2)), "collisions_per_run"),
            (extra(number_column("lane invasions / run", 2)), "lane_invasions_per_run"),
            (number_column(f"{COMPLETED_P95}, mean of runs", 2), "p95_m"),
            (extra(number_column(f"{COMMON_P95}, mean of runs", 2)), "p95_common_m"),
            (number_column(f"{JERK}, mean of runs", 2), "lateral_jerk_rms_mps3"),
            (number_column(f"{STEERING_RATE}, mean of runs", 3), "steering_rate_rms_radps"),
            (number_column("loop latency ms, median"), "loop_ms.p50"),
            (number_column("frame age, mean ms", 0), "picture_age_ms.mean"),
        ],
    )


def route_table(conditions: Conditions) -> TableData:
    """Return the table of routes: one row for each condition on each route."""
    columns = [
        text_column("route"),
        text_column("condition"),
        number_column("runs", 0),
        number_column("completed", 0),
        share_column("share"),
        share_interval_column("95 % interval"),
        number_column("completed in own lane", 0),
        number_column(f"{COMPLETED_P95}, mean of runs", 2),
        number_column("p95 m against the lane followed", 2),
        number_column(f"{COMMON_P95}, mean of runs", 2),
    ]
    keys = (
        "runs",
        "completed",
        "completion_rate",
        "completion_interval",
        "completed_in_own_lane",
        "p95_m",
        "followed_p95_m",
        "p95_common_m",
    )
    routes = sorted({route for entry in conditions.values() for route in entry.get("routes") or {}})
    rows = [
        [route, name, *(entry["routes"][route].get(key) for key in keys)]
        for route in routes
        for name, entry in conditions.items()
        if route in (entry.get("routes") or {})
    ]
    return TableData(columns, rows)


def route_overview(conditions: Conditions) -> TableData:
    """Return the table of completed runs: one row for each route, one column for each condition."""
    routes = sorted({route for entry in conditions.values() for route in entry.get("routes") or {}})
    columns = [text_column("completed"), *(Column(name, lambda cell: cell or NOTHING) for name in conditions)]
    rows = [
        [route, *(_completed((entry.get("routes") or {}).get(route)) for entry in conditions.values())]
        for route in routes
    ]
    return TableData(columns, rows)


def _completed(entry: Mapping[str, Any] | None) -> str | None:
    return None if entry is None else f"{entry['completed']} of {entry['runs']}"


def survival_table(conditions: Conditions) -> TableData:
    """Return the table of all steps of the survival curves, for use in other programs."""
    columns = [
        text_column("route"),
        text_column("condition"),
        number_column("distance m", 1),
        share_column("still driving"),
        share_interval_column("95 % interval"),
        text_column("ended so far"),
    ]
    rows = []
    for name, entry in conditions.items():
        for route, curve in (entry.get("survival") or {}).items():
            steps = zip(curve["distance_m"], curve["surviving"], curve["low"], curve["high"], strict=True)
            for index, (distance_m, surviving, low, high) in enumerate(steps):
                ended = ", ".join(
                    f"{ending} {format_percent(shares[index])}" for ending, shares in curve["incidence"].items()
                )
                rows.append([route, name, distance_m, surviving, (low, high), ended or None])
    return TableData(columns, rows)


def run_table(runs: Sequence[Mapping[str, Any]]) -> TableData:
    """Return the table of runs: identity, ending, main results and validity."""
    entries = [
        {
            **run,
            "setup": f"{run['time']}, {run.get('fidelity') or 'video'}, {run['injection']}",
            "kept": None
            if run.get("completed_in_own_lane") is None
            else "yes"
            if run["completed_in_own_lane"]
            else "no",
            "validity": "valid"
            if run["valid"]
            else "invalid: " + "; ".join(reason["text"] for reason in run["invalid_reasons"]),
        }
        for run in runs
    ]
    return table_of_entries(
        entries,
        [
            (text_column("run"), "run"),
            (extra(text_column("sweep")), "sweep"),
            (extra(text_column("time, fidelity, injection")), "setup"),
            (text_column("route"), "route"),
            (text_column("condition"), "condition"),
            (extra(text_column("preset")), "preset"),
            (text_column("ending"), "ending"),
            (number_column("distance m", 0), "distance_m"),
            (number_column("loop latency ms, median"), "loop_ms.p50"),
            (text_column("in own lane"), "kept"),
            (extra(share_column("time in own lane")), "lane_kept.own_lane_share"),
            (number_column("p95 error m", 2), "p95_m"),
            (extra(number_column("p95 error against the lane followed m", 2)), "followed_p95_m"),
            (number_column(JERK, 2), "lateral_jerk_rms_mps3"),
            (number_column(STEERING_RATE, 3), "steering_rate_rms_radps"),
            (extra(number_column("frame age, mean ms", 0)), "picture_age_ms.mean"),
            (text_column("validity", is_long=True), "validity"),
        ],
    )


def lane_change_table(runs: Sequence[Mapping[str, Any]]) -> TableData:
    """Return the table of all lane changes, for use in other programs."""
    entries = [
        {**change, "run": run["run"], "sweep": run.get("sweep")}
        for run in runs
        for change in (run.get("lane_kept") or {}).get("changes") or []
    ]
    return table_of_entries(
        entries,
        [
            (text_column("run"), "run"),
            (text_column("sweep"), "sweep"),
            (text_column("lane"), "lane"),
            (number_column("server's monotonic clock ns", 0), "mono_ns"),
            (number_column("distance m", 1), "progress_m"),
            (number_column("from lane", 0), "from"),
            (number_column("to lane", 0), "to"),
        ],
    )


def check_table(runs: Sequence[Mapping[str, Any]]) -> TableData:
    """Return the table of validity checks with a number: the limit, and the worst value in each kind of time."""
    worst: dict[str, dict[str, tuple[Mapping[str, Any], Mapping[str, Any]]]] = {}
    for run in runs:
        for check in run.get("checks") or []:
            by_time = worst.setdefault(str(check["code"]), {})
            if run["time"] not in by_time or _severity(check) > _severity(by_time[run["time"]][0]):
                by_time[run["time"]] = check, run
    rows = []
    for code, (label, scale) in CHECKS.items():
        row: list[Any] = [label]
        for time in ("real", "virtual"):
            check, run = worst.get(code, {}).get(time, (None, {}))
            row += [(check["value"] * scale, check["limit"] * scale), run["run"]] if check else [None, None]
        if code in worst:
            rows.append(row)
    columns = [
        text_column("check"),
        *(
            column
            for time in ("real", "virtual")
            for column in (
                Column(f"worst in {time} time (limit)", _format_check, ("value", "limit")),
                text_column(f"run in {time} time"),
            )
        ),
    ]
    return TableData(columns, rows).without_empty_columns()


def _format_check(value_and_limit: tuple[float, float] | None) -> str:
    if value_and_limit is None:
        return NOTHING
    value, limit = value_and_limit
    return f"{value:.2f} ({limit:.2f})".replace(" ", UNBROKEN)


def _severity(check: Mapping[str, Any]) -> float:
    return float(check["value"]) / float(check["limit"]) if check["limit"] else 0.0


def clock_table(runs: Sequence[Mapping[str, Any]]) -> TableData:
    """Return the table of clock offsets, from the source in use and from the probe: one row for each run."""
    parts = ("", "bound")
    columns = [
        text_column("run"),
        text_column("source"),
        Column("clock offset ms", lambda cell: format_with_bound(*cell, digits=3), parts),
        number_column("drift ppm", 2),
        Column("clock offset by probe ms", lambda cell: format_with_bound(*cell, digits=3), parts),
    ]
    rows = [
        [
            run["run"],
            run["delta"]["source"],
            (run["delta"]["ms"], run["delta"]["bound_ms"]),
            run["delta"]["drift_ppm"],
            (run["delta"]["probe_ms"], run["delta"]["probe_bound_ms"]),
        ]
        for run in runs
    ]
    return TableData(columns, rows)


def stage_table(
    stages: Mapping[str, Sequence[Mapping[str, Any]]], capture_to_stamp_ms: Mapping[str, float | None] | None = None
) -> TableData:
    """Return the median latency of each stage in ms: one row for each stage, one column for each condition.

    `capture_to_stamp_ms` is by condition. It becomes the first row, because this time is before the loop.
    """
    names = list(dict.fromkeys((stage["node"], stage["stage"]) for entries in stages.values() for stage in entries))
    medians_ms = [{(stage["node"], stage["stage"]): stage["p50"] for stage in entries} for entries in stages.values()]
    before_loop: list[Any] = [(capture_to_stamp_ms or {}).get(name) for name in stages]
    show = number_column("", 2).show
    columns = [text_column("stage, median ms"), *(Column(name, show) for name in stages)]
    rows = [
        [
            f"{node}: {stage}{AFTER_LOOP_SUFFIX if (node, stage) in AFTER_LOOP else ''}",
            *(condition_medians_ms.get((node, stage)) for condition_medians_ms in medians_ms),
        ]
        for node, stage in names
    ]
    return TableData(columns, [["camera: capture to stamp, before the loop", *before_loop], *rows])


def _measured_on(costs: str) -> str:
    """Return where recorded costs were measured; "unknown" if a record of another version does not say it."""
    try:
        return str(json.loads(costs)["measured_on"])
    except (ValueError, KeyError, TypeError):
        return "unknown"


def machine_table(annotations: Mapping[str, Mapping[str, str]]) -> TableData:
    """Return the table of versions and machines from a run's records; of the costs, only where they were measured."""
    columns = [text_column("category"), text_column("property", is_long=True), text_column("value", is_long=True)]
    rows = [
        [name, "costs measured on", _measured_on(value)] if key == "costs" else [name, key, value]
        for name in sorted(annotations)
        for key, value in annotations[name].items()
        # The condition is not a property of the machine; other tables show it. Most runs have no traces.
        if key != "condition" and value != "{}"
    ]
    return TableData(columns, rows or [["not recorded", None, None]])
