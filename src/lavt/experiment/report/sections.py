"""The sections of a report that are made of a summary alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lavt.experiment.analysis.clocks import PROBE, SAME_KERNEL
from lavt.experiment.analysis.stage_latency import AFTER_LOOP
from lavt.experiment.report import html_page
from lavt.experiment.report.figure_style import Colours, Conditions
from lavt.experiment.report.files import link_table, save_figure, save_table
from lavt.experiment.report.groups import Group, axes_of, differing, in_order, short, title_of
from lavt.experiment.report.latency_figures import degradation_figure, injected_figure, presets_figure, stages_figure
from lavt.experiment.report.sentences import differences, equal_totals, headline, what_was_driven
from lavt.experiment.report.sweep_figures import axis_figure, incidence_figure, routes_with_survival, survival_figure
from lavt.experiment.report.tables import (
    clock_table,
    contrast_table,
    driving_table,
    error_table,
    group_table,
    how_it_was_driven,
    latency_table,
    paper_beside,
    route_overview,
    route_table,
    run_table,
    stage_table,
    survival_table,
)

Parts = list[str]

ONE_CLOCK = (None, SAME_KERNEL)
"""Sources of Delta that have no figure: unknown, as the run's own row says, or the same clock."""

LATENCIES_NOTE = (
    "Latencies in ms: median (p5 to p95) ± how wrong the offset between the clocks can make them. The loop latency, "
    "frame stamped to its command applied on the server's own clock, needs no offset."
)
PAPER_NOTE = " The paper measured no loop: the sum of its two medians stands beside ours."
PAPER_POINTS = (
    " The paper's points stand at the sum of its two one-way medians; the bar of its completion is that of its counts, "
    "and of its error it gives none."
)
ROUTES_NOTE = " Of the completion: these routes, the exact interval of what repeating just these routes would give."
ROADS_NOTE = (
    " Of the completion: such roads, how far the rates of the roads lie apart, a route and its key part being one "
    "road, and no interval of 95 %."
)
ERRORS_NOTE = (
    " Each error is the mean over runs of what each run has by itself, its P95 and its maximum, too. P95 of the "
    "cross-track error three ways: over completed runs, so read it beside the completion; of all runs up "
    "to the farthest place that all runs of a route and repetition reached; and of all runs in order, one that ended "
    "early being last: median (quartiles). docs/metrics.md defines every number."
)
STAGES_NOTE = (
    "The first row, from capture to stamp, is of one run of each condition, the others of all its runs; it is before "
    "the loop, and what the actuator reports is after it: both are in no bar."
)

LEAST_REST_MS = 0.5
"""Less than this is not told as a hop of its own."""

COMPARED_GROUPS = 6
"""More groups than these are not drawn as lines of one figure; their table and the figure of their axes are there."""


@dataclass(frozen=True, slots=True)
class ReportContext:
    """What all sections are made of: a summary, where files go, and what is the same in all of them."""

    summary: Mapping[str, Any]
    directory: Path
    colours: Colours

    @property
    def groups(self) -> Sequence[Group]:
        """Give the groups of the runs in virtual time."""
        return in_order(self.summary.get("groups") or [])

    @property
    def kinds(self) -> dict[str, Conditions]:
        """Give the conditions of both kinds of time, as far as there are any."""
        kinds = {"virtual": self.summary["conditions"], "real": self.summary["real"]}
        return {kind: conditions for kind, conditions in kinds.items() if conditions}

    @property
    def base(self) -> list[Group]:
        """Give the groups whose conditions are those of the base config: none where these are of several groups."""
        return [group for group in self.groups if group["conditions"] == self.summary["conditions"]]

    def paper(self, conditions: Conditions) -> Conditions:
        """Give the paper's conditions that are among these."""
        return paper_beside(conditions, (self.summary.get("paper") or {}).get("conditions") or {})

    def how(self, kind: str) -> str:
        """Say how the runs of a kind of time were driven, and which of several groups its conditions are of."""
        driven = how_it_was_driven([run for run in self.summary["runs"] if run["time"] == kind])
        return f"{driven[0].upper()}{driven[1:]}{self.which(kind)}"

    def which(self, kind: str = "virtual") -> str:
        """Say in brackets which group the conditions in virtual time are of."""
        names = differing(self.groups) or ["preset"]
        return f" ({title_of(self.base[0], names)})" if kind == "virtual" and self.base else ""


def head(report: ReportContext) -> Parts:
    """Say in plain words what was driven and what came out."""
    runs, speed, failed = report.summary["runs"], report.summary["speed"], report.summary.get("failed")
    parts = [html_page.paragraph(what_was_driven(runs))]
    names = differing(report.groups)
    compared = report.groups if 1 < len(report.groups) <= COMPARED_GROUPS else []
    said = {f"Virtual time, {title_of(group, names)}": group["conditions"] for group in compared}
    if "virtual" in report.kinds and not said:
        said = {f"Virtual time{report.which()}": report.kinds["virtual"]}
    if "real" in report.kinds:
        said["Real time"] = report.kinds["real"]
    sentences = [headline(name, conditions) for name, conditions in said.items()]
    parts.append(html_page.bullets([sentence for sentence in sentences if sentence]))
    if speed["wall_s"]:
        factor = speed["simulated_s"] / speed["wall_s"]
        text = f"{speed['simulated_s']:.0f} s were simulated in {speed['wall_s']:.0f} s with {speed['jobs']} jobs: "
        parts.append(html_page.paragraph(f"{text}{factor:.1f} times as fast as real time.", note=True))
    if failed:
        parts.append(
            html_page.paragraph(f"{len(failed)} of the runs asked for failed and are in no number of this page:")
        )
        parts.append(html_page.bullets([f"{each['run']}: {each['reason']}" for each in failed]))
    return parts


def conditions_parts(report: ReportContext) -> Parts:
    """Show the paper's table, with the paper's own figures where the conditions are the same; a kind of time each."""
    if not report.kinds:
        return [html_page.paragraph("No run has the values of the sweep's own config: see the groups.", note=True)]
    parts = []
    for kind, conditions in report.kinds.items():
        paper = report.paper(conditions)
        parts.append(html_page.heading(report.how(kind)))
        for name, make in (("driving", driving_table), ("latency", latency_table), ("error", error_table)):
            parts.append(save_table(report.directory, f"conditions_{kind}_{name}", make(conditions, paper)))
    roads = any(entry.get("completion_such_roads") for of in report.kinds.values() for entry in of.values())
    beside = any(report.paper(conditions) for conditions in report.kinds.values())
    return [
        *parts,
        html_page.paragraph(
            "".join((LATENCIES_NOTE, PAPER_NOTE * beside, ROUTES_NOTE, ROADS_NOTE * roads, ERRORS_NOTE)), note=True
        ),
    ]


def contrast_parts(report: ReportContext) -> Parts:
    """Show the planned contrasts, and why conditions of equal total delay are not told apart."""
    summary, paper = report.summary, (report.summary.get("paper") or {}).get("contrasts") or []
    contrasts = summary.get("contrasts") or []
    if not contrasts:
        return []
    shown = paper if report.paper(summary["conditions"]) else []
    names = differing(report.groups)
    base = title_of(report.base[0], names) if report.groups[1:] and report.base else ""
    several = report.groups[1:] and len(report.groups) <= COMPARED_GROUPS
    parts = [html_page.heading(base)] if base else []
    parts += [save_table(report.directory, "contrasts", contrast_table(contrasts, shown))]
    for group in report.groups if several else []:
        if group not in report.base[:1] and group.get("contrasts"):
            title = title_of(group, names)
            parts.append(html_page.heading(title))
            name = f"contrasts_{html_page.slug(title)}"
            parts.append(save_table(report.directory, name, contrast_table(group["contrasts"], shown)))
    note = (
        "Completion under two conditions. Ours: McNemar's exact test on pairs with the same route, repetition and "
        "seed; Holm's correction over the contrasts, which were planned before any run was driven."
    )
    parts.append(
        html_page.paragraph(note + (" The paper's: Fisher's exact test on its counts." if shown else ""), note=True)
    )
    changed = any(run.get("changes") for run in summary["runs"])
    said = [] if changed else equal_totals(contrasts, summary["conditions"], shown)
    return [*parts, *(html_page.paragraph(f"{base}: {each}" if base else each) for each in said)]


def difference_parts(report: ReportContext) -> Parts:
    """Say where the results differ from the paper's, where all its conditions were driven."""
    conditions = report.summary["conditions"]
    paper = (report.summary.get("paper") or {}).get("conditions") or {}
    said = differences(conditions, paper) if len(report.paper(conditions)) == len(paper) else []
    return [html_page.bullets(said)] if said else []


def of_base(report: ReportContext) -> str:
    """Say below a figure of both kinds of time which group the virtual runs in it are of, where there are several."""
    return f" Virtual runs are of one group{report.which()}." if len(report.groups) > 1 and report.base else ""


def injected_parts(report: ReportContext) -> Parts:
    """Show injected against measured latency."""
    if not report.kinds:
        return []
    caption = (
        "Injected against measured one-way latency: median, p5 to p95. The grey line is the latency of the least "
        "delayed condition, plus the injected delay; below, how far each median is from it, with the bound."
        f"{of_base(report)}"
    )
    figure = injected_figure(report.kinds, report.colours)
    return [save_figure(report.directory, "injected", figure, "injected against measured latency", caption)]


def degradation_parts(report: ReportContext) -> Parts:
    """Show what latency does to driving."""
    if not any(entry["loop_ms"]["p50"] is not None for of in report.kinds.values() for entry in of.values()):
        return []
    paper = report.paper(report.summary["conditions"])
    caption = (
        "Completion and error over the median loop latency (frame stamped to its command applied) and over the mean "
        "age of the picture that the vehicle acts on. Bars are 95 % intervals; where names stand together, the upper "
        "is the upper point's." + (PAPER_POINTS if paper else "") + of_base(report)
    )
    figure = degradation_figure(report.kinds, paper, report.colours)
    return [save_figure(report.directory, "degradation", figure, "completion and error over latency", caption)]


def survival_parts(report: ReportContext) -> Parts:
    """Show how far the runs came and how they ended, a kind of time each."""
    parts = []
    for kind, conditions in report.kinds.items():
        if not routes_with_survival(conditions):
            continue
        many = {
            "survival": (
                survival_figure,
                "Runs that are still driving after each distance (Kaplan-Meier): any ending but completed "
                "counts, and a completed run leaves at the route's end. The files have the 95 % intervals.",
            ),
            "incidence": (incidence_figure, "Cumulative incidence: the share of the runs that has ended in each way."),
        }
        for name, (make, caption) in many.items():
            figure = make(conditions, report.colours)
            alternative = f"{name} by distance, {kind} time"
            parts.append(
                save_figure(
                    report.directory,
                    f"{name}_{kind}",
                    figure,
                    alternative,
                    f"{caption} {kind.capitalize()} time{report.which(kind)}.",
                )
            )
        parts.append(link_table(report.directory, f"survival_{kind}", survival_table(conditions)))
    return parts


def stage_parts(report: ReportContext, captured_ms: Mapping[str, Mapping[str, float | None]]) -> Parts:
    """Show where the loop's time goes; `captured_ms` is by kind of time and condition."""
    parts = []
    for kind, conditions in report.kinds.items():
        known = {name: entry for name, entry in conditions.items() if entry.get("stages_ms")}
        if not known:
            continue
        loops = {name: _loop_of(entry) for name, entry in known.items()}
        stages = {name: [*loops[name], *filter(_is_after_loop, entry["stages_ms"])] for name, entry in known.items()}
        caption = (
            "Where the median loop goes, in the order of a frame's life: of each hop the median over all runs. The "
            "number is the sum of these medians, which need not be the median loop exactly. "
            f"{kind.capitalize()} time{report.which(kind)}."
        )
        parts.append(
            save_figure(report.directory, f"hops_{kind}", stages_figure(loops), "latency of each hop", caption)
        )
        parts.append(save_table(report.directory, f"hops_{kind}", stage_table(stages, captured_ms.get(kind))))
        parts.append(html_page.paragraph(STAGES_NOTE, note=True))
    return parts


def _is_after_loop(stage: Mapping[str, Any]) -> bool:
    return (stage["node"], stage["stage"]) in AFTER_LOOP


def _loop_of(entry: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Give the hops that make a condition's loop, and what is left of its median: every wait for a next tick."""
    stages, loop_ms = [stage for stage in entry["stages_ms"] if not _is_after_loop(stage)], entry["loop_ms"]["p50"]
    rest_ms = 0.0 if loop_ms is None else loop_ms - sum(stage["p50"] or 0.0 for stage in stages)
    rest = {"node": "rest", "stage": "waiting, and what medians do not add up to", "p50": rest_ms}
    return [*stages, rest] if rest_ms > LEAST_REST_MS else stages


def group_parts(report: ReportContext) -> Parts:
    """Compare the groups: presets, sweeps, fidelities, further axes."""
    groups, names = report.groups, differing(report.groups)
    if len(groups) < 2:
        return []
    parts = []
    if len(groups) <= COMPARED_GROUPS:
        figure = presets_figure({title_of(group, names): group["conditions"] for group in groups}, report.colours)
        caption = (
            "The groups beside each other, virtual time; what makes them differ is in the legend. "
            "Conditions that hide one another are named, the upper above."
        )
        parts.append(save_figure(report.directory, "groups", figure, "groups compared", caption))
    return [*parts, save_table(report.directory, "groups", group_table(groups, names))]


def axis_parts(report: ReportContext) -> Parts:
    """Show what the further axes of a sweep do, one figure for each set of runs that else are alike."""
    axes = axes_of(report.groups)
    if not axes:
        return []
    if len(axes) > 2:
        return [html_page.paragraph(f"{len(axes)} axes are too many for a figure: see the table of groups.", note=True)]
    along = sorted(axes, key=lambda axis: -_numeric_values(report.groups, axis))
    others = [name for name in differing(report.groups) if name not in axes]
    alike: dict[str, list[Group]] = {}
    for group in report.groups:
        alike.setdefault(title_of(group, others), []).append(group)
    parts = []
    for title, groups in alike.items():
        figure = axis_figure(groups, along, report.colours)
        what = " and ".join(short(axis) for axis in along)
        caption = f"Driving over {what}, virtual time{f', {title}' if title else ''}."
        name = "_".join(["axes", *(html_page.slug(title),)]) if title else "axes"
        parts.append(save_figure(report.directory, name, figure, f"driving over {short(along[0])}", caption))
    return parts


def _numeric_values(groups: Sequence[Group], axis: str) -> int:
    values = {group.get(axis) for group in groups if isinstance(group.get(axis), int | float)}
    return len(values)


def route_parts(report: ReportContext) -> Parts:
    """Show the headline route by route."""
    parts = []
    for kind, conditions in report.kinds.items():
        if any(entry.get("routes") for entry in conditions.values()):
            parts.append(html_page.heading(f"{kind.capitalize()} time{report.which(kind)}"))
            parts.append(save_table(report.directory, f"routes_{kind}_overview", route_overview(conditions)))
            parts.append(save_table(report.directory, f"routes_{kind}", route_table(conditions)))
    return parts


def run_parts(report: ReportContext) -> Parts:
    """Show every run with its validity."""
    return [save_table(report.directory, "runs", run_table(report.summary["runs"]))]


def clock_parts(report: ReportContext) -> Parts:
    """Say how far the clocks of two machines were apart; in virtual time they are modelled."""
    runs = report.summary["runs"]
    apart = [run for run in runs if run["time"] == "real" and (run.get("delta") or {}).get("source") not in ONE_CLOCK]
    if not apart:
        return []
    parts = [
        save_table(report.directory, "clocks", clock_table(apart)),
        html_page.paragraph(
            "Delta is the server's clock less the client's in the middle of the drive; ± is the largest bound during "
            "it, that of every one-way latency of the run. The hosts' sources of time and the probe are two opinions: "
            "a run in which they contradict each other does not count.",
            note=True,
        ),
    ]
    if any(run["delta"]["source"] == PROBE for run in apart):
        parts.append(
            html_page.paragraph(
                "By the probe: no other source of time said how the clocks were. Its bound is half the round trip "
                "and the drift since; if one way is slower than the other, that is hidden inside it.",
                note=True,
            )
        )
    return parts
