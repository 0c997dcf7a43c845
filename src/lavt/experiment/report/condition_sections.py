"""The sections of a report on conditions and on contrasts between them."""

from __future__ import annotations

from lavt.experiment.report import html_page
from lavt.experiment.report.condition_tables import (
    contrast_table,
    driving_table,
    error_table,
    headline_table,
    latency_table,
)
from lavt.experiment.report.files import save_table
from lavt.experiment.report.groups import differing_settings, title_of
from lavt.experiment.report.sections import MAX_COMPARED_GROUPS, Parts, ReportContext

LATENCIES_NOTE = (
    "Each latency is given in ms as median ± bound of the clock error (p5 to p95). The loop latency, from a frame's "
    "stamp to the application of its command, is measured on the server's clock alone, so it has no such bound."
)
PAPER_NOTE = " The paper did not measure the loop latency; the table shows the sum of its median τ video and τ control."
OWN_LANE_NOTE = (
    " A run is completed in its own lane if the driver followed the lane of the route, and the middle of the rear axle "
    "was in it, all the time. P95 of the cross-track error is against the lane of the route and, in a column of its "
    "own, against the lane that the driver followed."
)
ROUTES_NOTE = " “95 %, these routes” is the exact confidence interval of completion for repeated runs of these routes."
ROADS_NOTE = (
    " “Range over roads” shows how much completion differs between roads; a route and its key part count as one road. "
    "It is not a 95 % interval."
)
ERRORS_NOTE = (
    " Each error is computed for each run and then averaged over the runs. P95 of the cross-track error is given in "
    "three ways. The first is the mean over the completed runs only, to be read together with the completion. The "
    "second is the mean over all runs, each up to the common distance, which all runs of its route and repetition "
    "reached. The third is the median (quartiles) of all runs, where a run that ended early ranks last. "
    "docs/metrics.md defines each number."
)


def conditions_parts(report: ReportContext) -> Parts:
    """Return the tables of the conditions for each kind of time, with the paper's values of the same conditions."""
    if not report.kinds:
        return [
            html_page.paragraph("No run has the settings of the base config. See the table of groups.", is_note=True)
        ]
    parts = []
    for kind, conditions in report.kinds.items():
        paper = report.paper(conditions)
        parts.append(html_page.heading(report.setup(kind)))
        tables = {
            "headline": headline_table,
            "driving": driving_table,
            "latency": latency_table,
            "error": error_table,
        }
        for name, make in tables.items():
            parts.append(save_table(report.directory, f"conditions_{kind}_{name}", make(conditions, paper)))
    has_roads = any(
        entry.get("completion_interval_over_roads")
        for conditions in report.kinds.values()
        for entry in conditions.values()
    )
    has_paper = any(report.paper(conditions) for conditions in report.kinds.values())
    return [
        *parts,
        html_page.paragraph(
            "".join(
                (
                    LATENCIES_NOTE,
                    PAPER_NOTE * has_paper,
                    OWN_LANE_NOTE,
                    ROUTES_NOTE,
                    ROADS_NOTE * has_roads,
                    ERRORS_NOTE,
                )
            ),
            is_note=True,
        ),
    ]


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
    note = (
        "Each contrast compares completion under two conditions by McNemar's exact test on pairs of runs with the "
        "same route, repetition and seed. All contrasts were planned before the first run, and Holm's correction "
        f"covers all of them.{fisher}"
    )
    parts.append(html_page.paragraph(note, is_note=True))
    return parts
