"""The tables of a report, as data."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lavt.experiment.analysis.stage_latency import AFTER_LOOP
from lavt.experiment.report.figure_style import Conditions
from lavt.experiment.report.groups import Group, short_name
from lavt.experiment.report.table_format import (
    NOTHING,
    UNBROKEN,
    Column,
    TableData,
    format_number,
    format_percent,
    format_with_bound,
    interval_column,
    latency_column,
    number_column,
    probability_column,
    share_column,
    share_interval_column,
    text_column,
)

FLOWS = ("video", "control")

COMPLETED_P95 = "p95 m, completed runs"
COMMON_P95 = "p95 m, up to common distance"

AFTER_LOOP_SUFFIX = ", after the loop"
"""Marks a stage that is not part of the loop, in the table of stages."""

ENDED_EARLY = "ended early"
"""The text of a quantile over all runs if the run with this rank was not completed."""

FIDELITY_DESCRIPTIONS = {
    "video": "modelled network and clocks, real images, codec and packets",
    "pixels": "modelled network, clocks and codec, real images",
    "geometry": "modelled network, clocks, codec, camera and perception, lane detection without errors",
}


def run_setup(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return a text on the runs' kind of time, the parts that were modelled, and the injection of the delay."""
    setups = {(run["time"], run.get("fidelity") or "video", run["injection"]) for run in runs}
    return "; ".join(
        f"virtual time, fidelity {fidelity}: {FIDELITY_DESCRIPTIONS[fidelity]}"
        if time == "virtual"
        else f"real time, {'nothing injected' if injection == 'none' else f'injected by {injection}'}"
        for time, fidelity, injection in sorted(setups, key=str)
    )


def matching_paper(conditions: Conditions, paper: Conditions) -> Conditions:
    """Return the paper's conditions with the same name and the same injected delay as one of `conditions`."""
    return {
        name: paper[name]
        for name, entry in conditions.items()
        if name in paper and all(entry["injected_ms"][flow] == paper[name]["injected_ms"][flow] for flow in FLOWS)
    }


def _table(entries: Iterable[Mapping[str, Any]], columns: Sequence[tuple[Column, str]]) -> TableData:
    """Return the table with a row for each entry, without empty columns.

    `columns` has each column with the key of its values in an entry; "a.b" is the key `b` of the nested entry `a`.
    """
    rows = [[_value(entry, key) for _, key in columns] for entry in entries]
    return TableData([column for column, _ in columns], rows).without_empty_columns()


def _value(entry: Mapping[str, Any], key: str) -> Any:
    value: Any = entry
    for name in key.split("."):
        value = (value or {}).get(name)
    return value


def _with_paper(conditions: Conditions, paper: Conditions) -> list[Mapping[str, Any]]:
    """Return an entry for each condition, with its name and the paper's entry."""
    return [{**entry, "condition": name, "paper": paper.get(name, {})} for name, entry in conditions.items()]


def latency_table(conditions: Conditions, paper: Conditions) -> TableData:
    """Return the table of injected and measured latency with the paper's values: one row for each condition."""
    totals = {name: {**entry, "total_ms": entry["tau_v_ms"] + entry["tau_c_ms"]} for name, entry in paper.items()}
    return _table(
        _with_paper(conditions, totals),
        [
            (text_column("condition"), "condition"),
            (number_column("injected video delay ms", 0), "injected_ms.video"),
            (number_column("injected control delay ms", 0), "injected_ms.control"),
            (latency_column("τ video ms", bounded=True), "tau_v_ms"),
            (number_column("the paper's τ video ms", 0), "paper.tau_v_ms"),
            (latency_column("τ control ms", bounded=True), "tau_c_ms"),
            (number_column("the paper's τ control ms", 0), "paper.tau_c_ms"),
            (latency_column("loop latency ms"), "loop_ms"),
            (number_column("the paper's τ video + τ control ms", 0), "paper.total_ms"),
            (number_column("frame age, mean ms", 0), "picture_age_ms.mean"),
            (number_column("frame age, p95 ms", 0), "picture_age_ms.p95"),
            (latency_column("frame age at actuation ms"), "age_at_actuation_ms"),
        ],
    )


def driving_table(conditions: Conditions, paper: Conditions) -> TableData:
    """Return the table of completion and endings with the paper's values: one row for each condition."""
    return _table(
        [{**entry, "endings": _endings(entry)} for entry in _with_paper(conditions, paper)],
        [
            (text_column("condition"), "condition"),
            (number_column("runs", 0), "runs"),
            (share_column("completed"), "completion_rate"),
            (share_interval_column("95 %, these routes"), "completion_interval"),
            (share_interval_column("range over roads"), "completion_interval_over_roads"),
            (share_column("the paper's completed"), "paper.completion_rate"),
            (share_interval_column("the paper's 95 %"), "paper.completion_interval"),
            (number_column("collisions / run", 2), "collisions_per_run"),
            (number_column("the paper's collisions / run", 2), "paper.collisions_per_run"),
            (number_column("collisions / km", 2), "collisions_per_km"),
            (number_column("lane invasions / run", 2), "lane_invasions_per_run"),
            (number_column("the paper's lane invasions / run", 2), "paper.lane_invasions_per_run"),
            (number_column("lane invasions / km", 1), "lane_invasions_per_km"),
            (text_column("endings"), "endings"),
        ],
    )


def _endings(entry: Mapping[str, Any]) -> str | None:
    return ", ".join(f"{count} {ending}" for ending, count in (entry.get("endings") or {}).items()) or None


def error_table(conditions: Conditions, paper: Conditions) -> TableData:
    """Return the table of lane-keeping errors with the paper's values: one row for each condition."""
    return _table(
        _with_paper(conditions, paper),
        [
            (text_column("condition"), "condition"),
            (number_column(f"{COMPLETED_P95}, mean of runs", 2), "p95_m"),
            (interval_column("95 % interval, completed runs m"), "p95_interval"),
            (number_column("the paper's p95 m", 2), "paper.p95_m"),
            (number_column(f"{COMMON_P95}, mean of runs", 2), "p95_common_m"),
            (interval_column("95 % interval, up to common distance m"), "p95_common_interval"),
            (Column("p95 m, all runs ranked", _format_quartiles, ("p25", "p50", "p75")), "p95_worst_rank_m"),
            (number_column("mean error m", 2), "mae_m"),
            (number_column("rms m, mean of runs", 2), "rms_m"),
            (number_column("maximum m, mean of runs", 2), "max_m"),
            (number_column("heading rms rad", 3), "heading_rms_rad"),
            (number_column("steering reversals / s", 2), "steering_reversals_per_s"),
            (number_column("oscillation Hz", 2), "oscillation_hz"),
        ],
    )


def _format_quartiles(quartiles: Mapping[str, float | None] | None) -> str:
    """Return the median and both quartiles."""
    if quartiles is None:
        return NOTHING
    low, middle, high = (
        ENDED_EARLY if quartiles[name] is None else format_number(quartiles[name], 2) for name in ("p25", "p50", "p75")
    )
    return middle if low == middle == high else f"{middle} ({low} to {high})".replace(" ", UNBROKEN)


def contrast_table(contrasts: Sequence[Mapping[str, Any]], paper: Sequence[Mapping[str, Any]]) -> TableData:
    """Return the table of planned contrasts with the paper's p values, from Fisher's test on its counts."""
    paper_contrasts = {(contrast["a"], contrast["b"]): contrast for contrast in paper}
    entries = [
        {
            **contrast,
            "contrast": f"{contrast['a']} – {contrast['b']}",
            "paper": paper_contrasts.get((contrast["a"], contrast["b"])),
        }
        for contrast in contrasts
    ]
    return _table(
        entries,
        [
            (text_column("contrast"), "contrast"),
            (number_column("pairs", 0), "pairs"),
            (number_column("completed under first only", 0), "only_a"),
            (number_column("completed under second only", 0), "only_b"),
            (probability_column("p"), "p"),
            (probability_column("p, Holm"), "p_holm"),
            (probability_column("the paper's p"), "paper.p"),
            (probability_column("the paper's p, Holm"), "paper.p_holm"),
        ],
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
    return _table(
        entries,
        [
            *((text_column(short_name(name)), str(index)) for index, name in enumerate(names)),
            (text_column("condition"), "condition"),
            (number_column("runs", 0), "runs"),
            (share_column("completed"), "completion_rate"),
            (share_interval_column("95 % interval"), "completion_interval"),
            (number_column("collisions / run", 2), "collisions_per_run"),
            (number_column("lane invasions / run", 2), "lane_invasions_per_run"),
            (number_column(f"{COMPLETED_P95}, mean of runs", 2), "p95_m"),
            (number_column(f"{COMMON_P95}, mean of runs", 2), "p95_common_m"),
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
        number_column(f"{COMPLETED_P95}, mean of runs", 2),
        number_column(f"{COMMON_P95}, mean of runs", 2),
    ]
    keys = ("runs", "completed", "completion_rate", "completion_interval", "p95_m", "p95_common_m")
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
            "validity": "valid"
            if run["valid"]
            else "invalid: " + "; ".join(reason["text"] for reason in run["invalid_reasons"]),
        }
        for run in runs
    ]
    return _table(
        entries,
        [
            (text_column("run"), "run"),
            (text_column("sweep"), "sweep"),
            (text_column("time, fidelity, injection"), "setup"),
            (text_column("route"), "route"),
            (text_column("condition"), "condition"),
            (text_column("preset"), "preset"),
            (text_column("ending"), "ending"),
            (number_column("distance m", 0), "distance_m"),
            (number_column("loop latency ms, median"), "loop_ms.p50"),
            (number_column("p95 error m", 2), "p95_m"),
            (number_column("frame age, mean ms", 0), "picture_age_ms.mean"),
            (text_column("validity", is_long=True), "validity"),
        ],
    )


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


def machine_table(annotations: Mapping[str, Mapping[str, str]]) -> TableData:
    """Return the table of versions and machines from a run's records."""
    columns = [text_column("category"), text_column("property", is_long=True), text_column("value", is_long=True)]
    rows = [
        [name, key, value]
        for name in sorted(annotations)
        for key, value in annotations[name].items()
        if key != "condition"  # not a property of the machine; other tables show it
    ]
    return TableData(columns, rows or [["not recorded", None, None]])
