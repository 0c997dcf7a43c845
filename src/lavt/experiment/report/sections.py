"""The sections of a report that need only the summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from lavt.experiment.analysis.clocks import PROBE, SAME_KERNEL
from lavt.experiment.analysis.stage_latency import AFTER_LOOP
from lavt.experiment.report import html_page
from lavt.experiment.report.condition_tables import matching_paper
from lavt.experiment.report.figures.figure_style import Colours, Conditions
from lavt.experiment.report.figures.latency_figures import (
    LOOP_LABEL,
    degradation_figure,
    injected_figure,
    known_latencies,
    presets_figure,
    stages_figure,
)
from lavt.experiment.report.figures.sweep_figures import (
    axis_figure,
    incidence_figure,
    routes_with_survival,
    survival_figure,
)
from lavt.experiment.report.files import link_table, save_figure, save_table
from lavt.experiment.report.groups import Group, axes_of, differing_settings, short_name, sort_groups, title_of
from lavt.experiment.report.tables import (
    check_table,
    clock_table,
    group_table,
    lane_change_table,
    route_overview,
    route_table,
    run_setup,
    run_table,
    stage_table,
    survival_table,
)

Parts = list[Markup]

SOURCES_WITHOUT_OFFSET = (None, SAME_KERNEL)
"""The sources of a clock offset that the report does not show. None: the offset is unknown. `SAME_KERNEL`: it is 0."""

PAPER_POINTS = (
    " The paper's points are drawn at the sum of its two median one-way latencies. The intervals of its completion "
    "are computed from its counts. The paper gives no interval of the error."
)
AGE_NOTE = " The paper does not give it."
STAGES_NOTE = (
    "The first row, from capture to stamp, is from one run of each condition. The other rows are from all runs of "
    "the condition. The bars contain neither the first row, which is before the loop, nor the stages after the loop."
)
CHECKS_NOTE = (
    "The table has the worst value of each check over all runs, valid or not. A value over its limit makes its run "
    "invalid. Other checks have no number, for example whether the records are complete. docs/metrics.md explains all."
)

SMALLEST_REST_MS = 0.5
"""The part of the loop latency that belongs to no stage is shown as a stage if it is larger than this."""

BUSY_CODES = {"physics_late", "frames_missed", "loop_jitter", "injection_differs"}
"""The reasons of invalid runs that a busy machine explains (docs/metrics.md)."""

MAX_LISTED_INVALID = 20

MAX_COMPARED_GROUPS = 6
"""If there are more groups, only their table and the figures of their axes show them."""


@dataclass(frozen=True, slots=True)
class ReportContext:
    """The input of all sections: the summary, the directory for files, and the colour of each condition."""

    summary: Mapping[str, Any]
    directory: Path
    colours: Colours

    @property
    def groups(self) -> Sequence[Group]:
        """Return the groups of the runs in virtual time."""
        return sort_groups(self.summary.get("groups") or [])

    @property
    def kinds(self) -> dict[str, Conditions]:
        """Return the conditions by kind of time; a kind of time without conditions is left out."""
        kinds = {"virtual": self.summary["conditions"], "real": self.summary["real"]}
        return {kind: conditions for kind, conditions in kinds.items() if conditions}

    @property
    def base(self) -> list[Group]:
        """Return the groups of the base config; none if the runs of the base config are in several groups."""
        return [group for group in self.groups if group["conditions"] == self.summary["conditions"]]

    def paper(self, conditions: Conditions) -> Conditions:
        """Return the paper's conditions that match `conditions`."""
        return matching_paper(conditions, (self.summary.get("paper") or {}).get("conditions") or {})

    def setup(self, kind: str) -> str:
        """Return a text on how the runs of a kind of time were made, and their group if there are several groups."""
        text = run_setup([run for run in self.summary["runs"] if run["time"] == kind])
        return f"{text[0].upper()}{text[1:]}{self.base_title(kind)}"

    def base_title(self, kind: str = "virtual") -> str:
        """Return the title of the base config's group in brackets; "" for real time or without such a group."""
        names = differing_settings(self.groups) or ["preset"]
        return f" ({title_of(self.base[0], names)})" if kind == "virtual" and self.base else ""


def validity_parts(report: ReportContext) -> Parts:
    """Return the reasons of invalid and failed runs, and the speed of the simulation."""
    runs, speed, failed = report.summary["runs"], report.summary["speed"], report.summary.get("failed")
    invalid = [run for run in runs if not run["valid"]]
    parts = (
        []
        if invalid
        else [html_page.paragraph(f"All {len(runs)} runs are valid." if runs[1:] else "The run is valid.")]
    )
    if invalid:
        parts.append(
            html_page.paragraph(f"{len(invalid)} of {len(runs)} runs are invalid and in no statistic.{_busy(invalid)}")
        )
        texts = [
            f"{run['run']} ({run['time']} time): " + "; ".join(str(reason["text"]) for reason in run["invalid_reasons"])
            for run in invalid[:MAX_LISTED_INVALID]
        ]
        more = len(invalid) - len(texts)
        parts.append(html_page.bullets([*texts, *([f"{more} more: see the table of every run."] if more else [])]))
    if failed:
        runs_failed = "1 run" if len(failed) == 1 else f"{len(failed)} runs"
        parts.append(html_page.paragraph(f"{runs_failed} failed and {'is' if len(failed) == 1 else 'are'} left out:"))
        parts.append(html_page.bullets([f"{run['run']}: {run['reason']}" for run in failed]))
    table = check_table(runs)
    if table.rows:
        parts += [save_table(report.directory, "checks", table), html_page.paragraph(CHECKS_NOTE, is_note=True)]
    if speed["wall_s"]:
        factor = speed["simulated_s"] / speed["wall_s"]
        jobs = f"{speed['jobs']} parallel job{'s' if speed['jobs'] != 1 else ''}"
        text = f"{speed['simulated_s']:.0f} s of driving were simulated in {speed['wall_s']:.1f} s with {jobs}. "
        parts.append(html_page.paragraph(f"{text}This is {factor:.1f} times as fast as real time.", is_note=True))
    return parts


def _busy(invalid: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on busy machines if they can be the reason of every one of these invalid runs."""
    codes = {str(reason["code"]) for run in invalid for reason in run["invalid_reasons"]}
    if not codes or not codes <= BUSY_CODES:
        return ""
    return " The machine was too busy to drive in real time; the same run on an idle machine can be valid."


def _base_note(report: ReportContext) -> str:
    """Return a sentence for a caption on the group of the virtual runs; "" if there is only one group."""
    if len(report.groups) < 2 or not report.base:
        return ""
    return f" Runs in virtual time are from one group{report.base_title()}."


def injected_parts(report: ReportContext) -> Parts:
    """Return the figure of measured latency over injected delay."""
    if not report.kinds:
        return []
    caption = (
        "Measured one-way latency over injected delay. Points are medians; bars in the upper panels reach from p5 to "
        "p95. The grey line shows the expected latency: the median of the condition with the smallest delay, plus the "
        "additional injected delay. The lower panels show the deviation of each median from this line, with the "
        f"bound of the clock error as bars.{_base_note(report)}"
    )
    figure = injected_figure(report.kinds, report.colours)
    return [save_figure(report.directory, "injected", figure, "measured latency over injected delay", caption)]


def degradation_parts(report: ReportContext) -> Parts:
    """Return the figure of completion and error over latency."""
    all_entries = [entry for conditions in report.kinds.values() for entry in conditions.values()]
    if all(entry["loop_ms"]["p50"] is None for entry in all_entries):
        return []
    paper = report.paper(report.summary["conditions"])
    caption = (
        "Completion in any lane, and error of the completed runs, over the median loop latency. Bars are 95 % "
        "intervals for these routes; a single run has none." + (PAPER_POINTS if paper else "") + _base_note(report)
    )
    figures = [
        save_figure(
            report.directory,
            "degradation" if label == LOOP_LABEL else "degradation_age",
            degradation_figure(report.kinds, paper, report.colours, label),
            f"completion and error over {label}",
            caption if label == LOOP_LABEL else f"The same, over the mean frame age.{AGE_NOTE * bool(paper)}",
        )
        for label in known_latencies(report.kinds)
    ]
    return [html_page.figures(figures)]


def _is_repeated(conditions: Conditions) -> bool:
    """Return whether any route was driven more than once under a condition: only then is there a share of its runs."""
    return any(route["runs"] > 1 for entry in conditions.values() for route in (entry.get("routes") or {}).values())


def survival_parts(report: ReportContext) -> Parts:
    """Return the figures of distance driven and of endings for each kind of time with repeated runs."""
    parts = []
    for kind, conditions in report.kinds.items():
        if not (routes_with_survival(conditions) and _is_repeated(conditions)):
            continue
        figures = {
            "survival": (
                survival_figure,
                "Share of runs still driving at each distance (Kaplan-Meier). Each ending except completion is an "
                "event, and a completed run is censored at the end of its route. The files contain the 95 % intervals.",
            ),
            "incidence": (
                incidence_figure,
                "Cumulative incidence: the share of runs that ended in each way up to each distance.",
            ),
        }
        saved = [
            save_figure(
                report.directory,
                f"{name}_{kind}",
                make(conditions, report.colours),
                f"{name} by distance, {kind} time",
                f"{caption} {kind.capitalize()} time{report.base_title(kind)}.",
            )
            for name, (make, caption) in figures.items()
        ]
        parts.append(html_page.figures(saved))
        parts.append(link_table(report.directory, f"survival_{kind}", survival_table(conditions)))
    return parts


def stage_parts(report: ReportContext, capture_to_stamp_ms: Mapping[str, Mapping[str, float | None]]) -> Parts:
    """Return the latency of each stage; `capture_to_stamp_ms` is by kind of time and condition."""
    parts = []
    for kind, conditions in report.kinds.items():
        known = {name: entry for name, entry in conditions.items() if entry.get("stages_ms")}
        if not known:
            continue
        loops = {name: _loop_of(entry) for name, entry in known.items()}
        stages = {name: [*loops[name], *filter(_is_after_loop, entry["stages_ms"])] for name, entry in known.items()}
        caption = (
            "Median latency of each stage over all runs, in the order in which a frame passes the stages. The number "
            "at each bar is the sum of these medians, which can differ slightly from the median loop latency. "
            f"{kind.capitalize()} time{report.base_title(kind)}."
        )
        parts.append(
            save_figure(report.directory, f"stages_{kind}", stages_figure(loops), "latency of each stage", caption)
        )
        parts.append(save_table(report.directory, f"stages_{kind}", stage_table(stages, capture_to_stamp_ms.get(kind))))
        parts.append(html_page.paragraph(STAGES_NOTE, is_note=True))
    return parts


def _is_after_loop(stage: Mapping[str, Any]) -> bool:
    return (stage["node"], stage["stage"]) in AFTER_LOOP


def _loop_of(entry: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the stages of a condition's loop, and the rest of its median loop latency, which belongs to no stage.

    In the rest of the time, a command that is repeated waits until it is due.
    """
    stages, loop_ms = [stage for stage in entry["stages_ms"] if not _is_after_loop(stage)], entry["loop_ms"]["p50"]
    rest_ms = 0.0 if loop_ms is None else loop_ms - sum(stage["p50"] or 0.0 for stage in stages)
    rest = {"node": "rest", "stage": "waiting (median loop minus the sum of stages)", "p50": rest_ms}
    return [*stages, rest] if rest_ms > SMALLEST_REST_MS else stages


def group_parts(report: ReportContext) -> Parts:
    """Return the comparison of the groups: presets, sweeps, fidelities, further axes."""
    groups, names = report.groups, differing_settings(report.groups)
    if len(groups) < 2:
        return []
    parts = []
    if len(groups) <= MAX_COMPARED_GROUPS:
        figure = presets_figure({title_of(group, names): group["conditions"] for group in groups}, report.colours)
        caption = (
            "Comparison of the groups in virtual time. The legend names the settings that differ. Names are written "
            "where the points of several conditions are at the same place."
        )
        parts.append(save_figure(report.directory, "groups", figure, "comparison of the groups", caption))
    return [*parts, save_table(report.directory, "groups", group_table(groups, names))]


def axis_parts(report: ReportContext) -> Parts:
    """Return a figure of the sweep's further axis for each set of groups that differ in this axis only.

    Of two axes, the one with more numbers is on x, and each value of the other has a figure with the same scales.
    """
    axes = axes_of(report.groups)
    if not axes:
        return []
    if len(axes) > 2:
        return [
            html_page.paragraph(
                f"The figures show at most two axes, but this sweep has {len(axes)}. See the table of groups.",
                is_note=True,
            )
        ]
    x_axis = max(axes, key=lambda axis: _numeric_values(report.groups, axis))
    other_settings = [name for name in differing_settings(report.groups) if name != x_axis]
    groups_by_title: dict[str, list[Group]] = {}
    for group in report.groups:
        groups_by_title.setdefault(title_of(group, other_settings), []).append(group)
    parts = []
    for title, groups in groups_by_title.items():
        figure = axis_figure(groups, x_axis, report.colours, report.groups)
        caption = f"Driving results by {short_name(x_axis)}, virtual time{f', {title}' if title else ''}."
        name = "_".join(["axes", *(html_page.slug(title),)]) if title else "axes"
        alternative = f"driving results by {short_name(x_axis)}"
        parts.append(save_figure(report.directory, name, figure, alternative, caption))
    return [html_page.figures(parts)]


def _numeric_values(groups: Sequence[Group], axis: str) -> int:
    """Return how many different numbers an axis has as values; 0 for an axis of texts."""
    values = {group.get(axis) for group in groups if isinstance(group.get(axis), int | float)}
    return len(values)


def route_parts(report: ReportContext) -> Parts:
    """Return the tables of completion by route."""
    parts = []
    for kind, conditions in report.kinds.items():
        if any(entry.get("routes") for entry in conditions.values()):
            parts.append(html_page.heading(f"{kind.capitalize()} time{report.base_title(kind)}"))
            parts.append(save_table(report.directory, f"routes_{kind}_overview", route_overview(conditions)))
            if _is_repeated(conditions):
                parts.append(save_table(report.directory, f"routes_{kind}", route_table(conditions)))
    return parts


def run_parts(report: ReportContext) -> Parts:
    """Return the table of all runs with their validity."""
    return [save_table(report.directory, "runs", run_table(report.summary["runs"]))]


def lane_change_parts(report: ReportContext) -> Parts:
    """Return links to the table of all lane changes, which is too long for the page, with a sentence on it."""
    table = lane_change_table(report.summary["runs"])
    if not table.rows:
        return []
    text = (
        "Every change of the lane that the driver followed, or of the lane that the car was in, is in the file "
        "tables/lane_changes.csv."
    )
    return [html_page.paragraph(text), link_table(report.directory, "lane_changes", table)]


def clock_parts(report: ReportContext) -> Parts:
    """Return the clock offset of the runs in real time whose sides have separate clocks."""
    runs = report.summary["runs"]
    two_clock_runs = [
        run
        for run in runs
        if run["time"] == "real" and (run.get("delta") or {}).get("source") not in SOURCES_WITHOUT_OFFSET
    ]
    if not two_clock_runs:
        return []
    parts = [
        save_table(report.directory, "clocks", clock_table(two_clock_runs)),
        html_page.paragraph(
            "The clock offset is the server's clock minus the client's clock, in the middle of the drive. The value "
            "after ± is the largest error bound during the drive, and it applies to each one-way latency. The time "
            "sources of the hosts and the probe give two independent estimates; a run in which they contradict each "
            "other is invalid.",
            is_note=True,
        ),
    ]
    if any(run["delta"]["source"] == PROBE for run in two_clock_runs):
        parts.append(
            html_page.paragraph(
                "Source “probe” means that no other time source reported the clock error. The probe's bound is half "
                "the round trip plus the possible drift since then. The probe cannot measure how the round trip "
                "divides into the two directions, but the bound is valid for any division.",
                is_note=True,
            )
        )
    return parts
