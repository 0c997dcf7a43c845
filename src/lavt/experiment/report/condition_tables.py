"""The tables of conditions and contrasts, as data: one row for each condition or contrast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lavt.experiment.report.figures.figure_style import Conditions
from lavt.experiment.report.table_format import (
    NOTHING,
    UNBROKEN,
    Column,
    TableData,
    by_road_column,
    extra,
    format_number,
    interval_column,
    latency_column,
    number_column,
    probability_column,
    share_column,
    share_interval_column,
    table_of_entries,
    text_column,
)

FLOWS = ("video", "control")

COMPLETED_P95 = "p95 m of the runs that completed"
ALL_RUNS_P95 = "p95 m of all runs up to their end"
FOLLOWED_P95 = "p95 m against the lane followed, of the runs that completed"
COMMON_P95 = "p95 m, up to common distance"

JERK = "lateral jerk m/s³, rms"
STEERING_RATE = "steering rate rad/s, rms"

ENDED_EARLY = "ended early"
"""The text of a quantile over all runs if the run with this rank was not completed."""

ENDINGS_WITH_PLURAL = {"collision", "safe_stop", "timeout"}
"""The endings that are nouns, so that a number of them has a plural."""


def matching_paper(conditions: Conditions, paper: Conditions) -> Conditions:
    """Return the paper's conditions with the same name and the same injected delay as one of `conditions`."""
    return {
        name: paper[name]
        for name, entry in conditions.items()
        if name in paper and all(entry["injected_ms"][flow] == paper[name]["injected_ms"][flow] for flow in FLOWS)
    }


def _with_paper(conditions: Conditions, paper: Conditions) -> list[Mapping[str, Any]]:
    """Return an entry for each condition, with its name and the paper's entry."""
    return [{**entry, "condition": name, "paper": paper.get(name, {})} for name, entry in conditions.items()]


def latency_table(conditions: Conditions, paper: Conditions) -> TableData:
    """Return the table of injected and measured latency with the paper's values: one row for each condition."""
    totals = {name: {**entry, "total_ms": entry["tau_v_ms"] + entry["tau_c_ms"]} for name, entry in paper.items()}
    return table_of_entries(
        _with_paper(conditions, totals),
        [
            (text_column("condition"), "condition"),
            (number_column("injected video delay ms", 0), "injected_ms.video"),
            (number_column("injected control delay ms", 0), "injected_ms.control"),
            (latency_column("τ video ms", bounded=True), "tau_v_ms"),
            (extra(number_column("the paper's τ video ms", 0)), "paper.tau_v_ms"),
            (latency_column("τ control ms", bounded=True), "tau_c_ms"),
            (extra(number_column("the paper's τ control ms", 0)), "paper.tau_c_ms"),
            (latency_column("stamp to decoded in the page ms", bounded=True), "page_decoded_ms"),
            (extra(number_column("stamp to decoded in the page ms, maximum")), "page_decoded_ms.max"),
            (latency_column("stamp to shown in the page ms", bounded=True), "page_shown_ms"),
            (extra(number_column("stamp to shown in the page ms, maximum")), "page_shown_ms.max"),
            (latency_column("loop latency ms"), "loop_ms"),
            (extra(number_column("the paper's τ video + τ control ms", 0)), "paper.total_ms"),
            (number_column("frame age, mean ms", 0), "picture_age_ms.mean"),
            (extra(number_column("frame age, p95 ms", 0)), "picture_age_ms.p95"),
            (extra(latency_column("frame age at actuation ms")), "age_at_actuation_ms"),
        ],
    )


def driving_table(conditions: Conditions, paper: Conditions) -> TableData:
    """Return the table of the main results with the paper's values: one row for each condition."""
    return table_of_entries(
        [{**entry, "endings": _endings(entry)} for entry in _with_paper(conditions, paper)],
        [
            (text_column("condition"), "condition"),
            (number_column("runs", 0), "runs"),
            (extra(share_column("completed in own lane")), "own_lane_completion_rate"),
            (extra(share_interval_column("95 %, these routes, own lane")), "own_lane_completion_interval"),
            (by_road_column("completed in own lane, by road", is_share=True), "by_road.own_lane_completion_rate"),
            (share_column("completed without touching a line"), "invasion_free_completion_rate"),
            (share_column("completed"), "completion_rate"),
            (extra(share_interval_column("95 %, these routes")), "completion_interval"),
            (extra(by_road_column("completed, by road", is_share=True)), "by_road.completion_rate"),
            (share_column("the paper's completed"), "paper.completion_rate"),
            (extra(share_interval_column("the paper's 95 %")), "paper.completion_interval"),
            (extra(share_column("time in own lane")), "own_lane_share"),
            (extra(share_column("time with lane followed unknown")), "followed_unknown_share"),
            (extra(number_column("changes of the lane followed / run", 2)), "followed_changes_per_run"),
            (extra(number_column("changes of the lane occupied / run", 2)), "occupied_changes_per_run"),
            (number_column("collisions / run", 2), "collisions_per_run"),
            (extra(interval_column("95 %, these routes, collisions / run")), "collisions_per_run_interval"),
            (extra(by_road_column("collisions / run, by road")), "by_road.collisions_per_run"),
            (extra(number_column("the paper's collisions / run", 2)), "paper.collisions_per_run"),
            (extra(number_column("collisions / km", 2)), "collisions_per_km"),
            (extra(number_column("lane invasions / run", 2)), "lane_invasions_per_run"),
            (extra(number_column("the paper's lane invasions / run", 2)), "paper.lane_invasions_per_run"),
            (extra(number_column("lane invasions / km", 1)), "lane_invasions_per_km"),
            (by_road_column(f"{ALL_RUNS_P95}, by road"), "by_road.p95_all_runs_m"),
            (number_column("the paper's p95 m", 2), "paper.p95_m"),
            (text_column("endings"), "endings"),
        ],
    )


def _endings(entry: Mapping[str, Any]) -> str | None:
    return ", ".join(_counted(count, ending) for ending, count in (entry.get("endings") or {}).items()) or None


def _counted(count: int, ending: str) -> str:
    """Return a number of runs with their ending in words; an ending that is a noun has a plural."""
    plural = "s" * (count != 1 and ending in ENDINGS_WITH_PLURAL)
    return f"{count} {ending.replace('_', ' ')}{plural}"


def error_table(conditions: Conditions, paper: Conditions) -> TableData:
    """Return the table of lane-keeping errors with the paper's values: one row for each condition."""
    return table_of_entries(
        _with_paper(conditions, paper),
        [
            (text_column("condition"), "condition"),
            (number_column(f"{COMPLETED_P95}, mean of runs", 2), "p95_m"),
            (interval_column("95 %, these routes, of the runs that completed m"), "p95_interval"),
            (extra(number_column(f"{COMPLETED_P95}, mean of routes", 2)), "p95_route_balanced_m"),
            (extra(number_column("routes with completed runs", 0)), "p95_routes"),
            (extra(by_road_column(f"{COMPLETED_P95}, by road")), "by_road.p95_m"),
            (extra(number_column(f"{FOLLOWED_P95}, mean of routes", 2)), "followed_p95_route_balanced_m"),
            (extra(by_road_column(f"{FOLLOWED_P95}, by road")), "by_road.followed_p95_m"),
            (number_column(f"{COMMON_P95}, mean of runs", 2), "p95_common_m"),
            (extra(interval_column("95 %, these routes, up to common distance m")), "p95_common_interval"),
            (extra(by_road_column(f"{COMMON_P95}, by road")), "by_road.p95_common_m"),
            (Column("p95 m, all runs ranked", _format_quartiles, ("p25", "p50", "p75")), "p95_worst_rank_m"),
            (extra(number_column("mean error m", 2)), "mae_m"),
            (extra(number_column("rms m, mean of runs", 2)), "rms_m"),
            (number_column("maximum m, mean of runs", 2), "max_m"),
            (extra(number_column("heading rms rad", 3)), "heading_rms_rad"),
            (number_column(f"{JERK}, mean of runs", 2), "lateral_jerk_rms_mps3"),
            (number_column(f"{STEERING_RATE}, mean of runs", 3), "steering_rate_rms_radps"),
            (extra(number_column("steering reversals / s", 2)), "steering_reversals_per_s"),
            (extra(number_column("oscillation Hz", 2)), "oscillation_hz"),
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
    return table_of_entries(
        entries,
        [
            (text_column("contrast"), "contrast"),
            (number_column("pairs", 0), "pairs"),
            (number_column("completed under first only", 0), "only_a"),
            (number_column("completed under second only", 0), "only_b"),
            (extra(probability_column("p")), "p"),
            (probability_column("p, Holm"), "p_holm"),
            (number_column("roads", 0), "roads"),
            (extra(number_column("roads with more completed under first", 0)), "roads_for_a"),
            (extra(number_column("roads with more completed under second", 0)), "roads_for_b"),
            (extra(probability_column("p by road")), "p_by_road"),
            (probability_column("p by road, Holm"), "p_by_road_holm"),
            (extra(probability_column("the paper's p")), "paper.p"),
            (probability_column("the paper's p, Holm"), "paper.p_holm"),
        ],
    )
