"""The sections of a report on conditions and on contrasts between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from markupsafe import Markup

from lavt.experiment.analysis.lane_kept import LINE_MARGIN_M
from lavt.experiment.report import html_page
from lavt.experiment.report.condition_tables import (
    contrast_table,
    driving_table,
    error_table,
    latency_table,
)
from lavt.experiment.report.figures.figure_style import Conditions
from lavt.experiment.report.files import save_table
from lavt.experiment.report.groups import differing_settings, title_of
from lavt.experiment.report.sections import MAX_COMPARED_GROUPS, Parts, ReportContext
from lavt.experiment.report.table_format import TableData
from lavt.experiment.statistics.intervals import FEWEST_CLUSTERS, has_enough_clusters

LATENCIES_NOTE = (
    "Each latency is given in ms as median ± bound of the clock error (p5 to p95). The loop latency, from a frame's "
    "stamp to the application of its command, is measured on the server's clock alone, so it has no such bound."
)
PAGE_NOTE = (
    " The page is the one from which a person drives. A picture is shown when the browser begins to make the picture "
    "of the screen with it; the screen itself comes later. The bound includes that of the page's clock."
)
PAPER_NOTE = "The paper did not measure the loop latency; the table shows the sum of its median τ video and τ control."
OWN_LANE_NOTE = (
    " A run is completed in its own lane if the middle of the rear axle was in the lane of the route all the time, or "
    f"at most {LINE_MARGIN_M:g} m beyond its line, and the driver followed no other lane. P95 of the cross-track error "
    "is against the lane of the route."
)
ROUTES_NOTE = (
    "After three pictures without a lane, the lane followed is unknown. The intervals “these routes” show only how "
    "repeated runs of these routes vary: those of completion and of collisions are exact, that of P95 is Student's t, "
    "from the spread within each route."
)
BY_ROAD_NOTE = (
    " Quote the columns “by road”: they have the mean over roads and its 95 % interval for other roads of this kind. "
    "Repeated runs on one road are no evidence on other roads, so the other columns look more certain than they are."
)
FEW_ROADS_NOTE = (
    " These runs are on {roads}. No statement about other roads of this kind is possible: that takes at least "
    f"{FEWEST_CLUSTERS} roads. So the columns “by road” have no interval, and all other intervals are for these routes "
    "only."
)
ERRORS_NOTE = (
    " Each error is computed for each run and then averaged over the runs. P95 of the cross-track error is given in "
    "three ways. The first is the mean over the runs that completed, to be read together with the completion. The "
    "second is the mean over all runs, each up to the common distance: the largest multiple of 10 m that all runs of "
    "its route and repetition reached. The third is the median (quartiles) of all runs, where a run that ended early "
    "ranks last. docs/metrics.md defines each number."
)
ERROR_INTERVAL_NOTE = (
    " The intervals “these routes” show only how repeated runs of these routes vary: they are Student's t, from the "
    "spread within each route."
)
MORE_ERRORS_NOTE = (
    "The mean over routes, or over roads, is that of the means of each route or road. An error against the lane "
    "followed is against the lane that the driver followed, where it is known."
)


def conditions_parts(report: ReportContext) -> Parts:
    """Return the main table of the conditions for each kind of time, with the paper's values."""
    if not report.kinds:
        return [
            html_page.paragraph("No run has the settings of the base config. See the table of groups.", is_note=True)
        ]
    roads = max(_roads(entry) for conditions in report.kinds.values() for entry in conditions.values())
    note = OWN_LANE_NOTE + (_by_road_note(roads) if roads else "")
    return [*_tables(report, "driving", driving_table, ROUTES_NOTE), _note(note)]


def latency_table_parts(report: ReportContext) -> Parts:
    """Return the tables of injected and measured latency for each kind of time."""
    if not report.kinds:
        return []
    has_paper = any(report.paper(conditions) for conditions in report.kinds.values())
    entries = [entry for conditions in report.kinds.values() for entry in conditions.values()]
    page = PAGE_NOTE * any((entry.get("page_shown_ms") or {}).get("n") for entry in entries)
    return [*_tables(report, "latency", latency_table, PAPER_NOTE * has_paper), _note(LATENCIES_NOTE + page)]


def error_table_parts(report: ReportContext) -> Parts:
    """Return the tables of lane-keeping errors for each kind of time."""
    if not report.kinds:
        return []
    entries = [entry for conditions in report.kinds.values() for entry in conditions.values()]
    intervals = ERROR_INTERVAL_NOTE * any(entry.get("p95_interval") for entry in entries)
    return [*_tables(report, "error", error_table, MORE_ERRORS_NOTE), _note(ERRORS_NOTE + intervals)]


def _tables(
    report: ReportContext, name: str, make: Callable[[Conditions, Conditions], TableData], extra_note: str
) -> Parts:
    """Return a table for each kind of time, below a heading that says how its runs were made.

    `extra_note` explains the columns that are hidden at first.
    """
    parts = []
    for kind, conditions in report.kinds.items():
        table = make(conditions, report.paper(conditions))
        parts.append(html_page.heading(report.setup(kind)))
        parts.append(save_table(report.directory, f"conditions_{kind}_{name}", table, extra_note))
    return parts


def _note(text: str) -> Markup:
    return html_page.paragraph(text.strip(), is_note=True)


def _roads(entry: Mapping[str, Any]) -> int:
    """Return the number of roads of a condition's valid runs; 0 if a summary of an older version lacks it."""
    return int(entry["by_road"]["completion_rate"]["roads"]) if "by_road" in entry else 0


def _by_road_note(roads: int) -> str:
    if has_enough_clusters(roads):
        return BY_ROAD_NOTE
    return FEW_ROADS_NOTE.format(roads="one road" if roads == 1 else f"{roads} roads")


def contrast_parts(report: ReportContext) -> Parts:
    """Return the planned contrasts of completion between conditions."""
    summary, paper = report.summary, (report.summary.get("paper") or {}).get("contrasts") or []
    contrasts = summary.get("contrasts") or []
    if not contrasts:
        return []
    paper_contrasts = paper if report.paper(summary["conditions"]) else []
    names = differing_settings(report.groups)
    base = title_of(report.base[0], names) if report.groups[1:] and report.base else ""
    shows_all_groups = report.groups[1:] and len(report.groups) <= MAX_COMPARED_GROUPS
    parts = [html_page.heading(base)] if base else []
    parts += [save_table(report.directory, "contrasts", contrast_table(contrasts, paper_contrasts))]
    for group in report.groups if shows_all_groups else []:
        if group not in report.base[:1] and group.get("contrasts"):
            title = title_of(group, names)
            parts.append(html_page.heading(title))
            name = f"contrasts_{html_page.slug(title)}"
            parts.append(save_table(report.directory, name, contrast_table(group["contrasts"], paper_contrasts)))
    fisher = " The paper's p values are from Fisher's exact test on its counts." if paper_contrasts else ""
    most_roads = max(contrast.get("roads", 0) for contrast in contrasts)
    by_road = (
        " Quote “p by road”, of the exact sign test with the road as the unit: a road counts for the condition under "
        "which more of its paired runs were completed. The other p values take all pairs for independent, although the "
        "runs of one road are alike, so they are too small."
    )
    if not has_enough_clusters(most_roads):
        by_road += (
            f" With {most_roads} road{'s' * (most_roads != 1)} it cannot be below {2 * 0.5**most_roads:.2g}, so no "
            "difference can be shown for roads of this kind."
        )
    note = (
        "Each contrast compares completion under two conditions by McNemar's exact test on pairs of runs with the "
        "same route, repetition and seed. All contrasts were planned before the first run, and Holm's correction "
        f"covers all of them.{by_road}{fisher}"
    )
    parts.append(html_page.paragraph(note, is_note=True))
    return parts
