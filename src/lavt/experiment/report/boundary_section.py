"""The section of a report on the maximum tolerable latency, from the contents of `boundary.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lavt.experiment.report import html_page
from lavt.experiment.report.figures.figure_style import legend_below, new_figure
from lavt.experiment.report.files import save_figure, save_table
from lavt.experiment.report.sections import Parts
from lavt.experiment.report.table_format import (
    LOW_HIGH,
    NOTHING,
    UNBROKEN,
    Column,
    TableData,
    format_number,
    number_column,
    text_column,
)
from lavt.experiment.statistics.boundary_summary import CRITERIA

STYLES = {"onset": ("#0072b2", "o"), "departure": ("#e69f00", "s"), "completion": ("#d55e00", "D")}
"""Colour (Okabe and Ito) and marker of each criterion."""
LABELS = {"onset": "oscillation begins to grow", "departure": "first leaves its lane", "completion": "not completed"}
ROW_OFFSETS = {"onset": 0.26, "departure": 0.0, "completion": -0.26}
"""Vertical offset of each criterion from the middle of its route's row; positive is upwards."""
ALL_ROUTES = "all routes"
DASHES = (
    f"In the table, {NOTHING} replaces a median, quartile or end of an interval that falls on a seed outside the "
    "searched range, an interval of fewer than six seeds, and the onset of a loop for which theory gives none."
)

Boundary = Mapping[str, Any]
"""The contents of `boundary.json`."""


def boundary_parts(boundaries: Sequence[Boundary], report_dir: Path) -> Parts:
    """Return the sentences, the figure and the table for the contents of each `boundary.json`."""
    parts = []
    for index, boundary in enumerate(boundaries, start=1):
        name = "boundary" if len(boundaries) == 1 else f"boundary_{index}"
        caption = (
            "Total delay, from the middle of a frame's exposure to the moment when its command is in force, at which "
            "an oscillation begins to grow, the vehicle first leaves its lane, and the route is no longer completed. "
            "Each small tick is one seed. A large point is the median, and its bar the 95 % interval of the median. "
            "The dashed line is the onset predicted by theory."
        )
        parts.append(html_page.bullets(boundary_sentences(boundary["groups"])))
        figure = boundary_figure(boundary)
        parts.append(save_figure(report_dir, name, figure, "maximum tolerable latency compared with theory", caption))
        parts.append(save_table(report_dir, name, boundary_table(boundary)))
    if parts:
        parts.append(
            html_page.paragraph(
                "Completion does not measure stability: a run can be completed although its oscillation grows. "
                + DASHES,
                is_note=True,
            )
        )
    return parts


def boundary_sentences(groups: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each preset: the onset by theory, and the median delay of each criterion.

    If there are several routes, the sentence is about all routes together.
    """
    shown = [group for group in groups if group["route"] is None] or groups
    return [_boundary_sentence(group) for group in shown]


def _boundary_sentence(group: Mapping[str, Any]) -> str:
    onset, departure, completion = (_format_median(group[f"{name}_ms"], group["n"]) for name in CRITERIA)
    route = ALL_ROUTES if group["route"] is None else f"route {group['route']}"
    theory = "theory gives no onset of oscillation"
    if group["theory_ms"] is not None:
        theory = f"theory predicts growing oscillation from a total delay of {group['theory_ms']:.0f} ms"
    return (
        f"{group['preset']}, {route}: {theory}. Medians of {group['n']} seed{'s' if group['n'] > 1 else ''}: "
        f"oscillation begins to grow: {onset}; the vehicle first leaves its lane: {departure}; "
        f"the route is no longer completed: {completion}."
    )


def _format_median(summary: Mapping[str, Any], seeds: int) -> str:
    if summary["p50"] is None:
        return f"{NOTHING} (in the searched range for only {summary['n']} of {seeds})"
    return f"{summary['p50']:.0f} ms"


def boundary_figure(boundary: Boundary) -> Figure:
    """Return the figure of the total delays at which each criterion is first met.

    The figure has a panel for each preset, with a row for each route. A tick is one seed, the large point the median,
    the bar the 95 % interval of the median, and the dashed line the onset by theory. The number at the right edge is
    the number of seeds that do not meet a criterion in the searched range. The number at the left edge is the number of
    seeds that already meet it at the shortest delay. If one end of an interval is unknown, the bar reaches to the edge
    of the searched range.
    """
    presets = list(dict.fromkeys(group["preset"] for group in boundary["groups"]))
    groups_of = {preset: [group for group in boundary["groups"] if group["preset"] == preset] for preset in presets}
    figure = new_figure(0.9 + sum(0.5 + 0.5 * len(groups) for groups in groups_of.values()))
    panels = figure.subplots(
        len(presets), 1, sharex=True, squeeze=False, height_ratios=[len(groups) for groups in groups_of.values()]
    )
    for axes, preset in zip(panels[:, 0], presets, strict=True):
        _draw_panel(axes, boundary["runs"], groups_of[preset])
        axes.set_title(preset, loc="left")
    panels[-1, 0].set_xlabel("total delay (ms)")
    handles = [
        Line2D([], [], linestyle="none", marker=marker, color=colour, label=LABELS[name])
        for name, (colour, marker) in STYLES.items()
    ]
    handles.append(Line2D([], [], linestyle="--", color="black", label="onset by theory"))
    legend_below(figure, handles)
    return figure


def _draw_panel(axes: Axes, runs: Sequence[Mapping[str, Any]], groups: Sequence[Mapping[str, Any]]) -> None:
    for row, group in enumerate(reversed(groups)):
        chosen = [run for run in runs if run["preset"] == group["preset"] and group["route"] in (None, run["route"])]
        for name in CRITERIA:
            _draw_criterion(axes, row + ROW_OFFSETS[name], name, chosen, group)
    if groups[0]["theory_ms"] is not None:
        axes.axvline(groups[0]["theory_ms"], color="black", linestyle="--", linewidth=1, zorder=1)
    axes.set_yticks(range(len(groups)), [group["route"] or ALL_ROUTES for group in reversed(groups)])
    axes.set_ylim(-0.6, len(groups) - 0.4)
    axes.set_xlim(0, 1.06 * max((run["searched_ms"][1] for run in runs), default=1.0))
    axes.grid(visible=True, axis="x", alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_criterion(
    axes: Axes, height: float, name: str, runs: Sequence[Mapping[str, Any]], group: Mapping[str, Any]
) -> None:
    """Draw one criterion of one row: ticks of the seeds, median and interval, and the numbers of seeds out of range."""
    colour, marker = STYLES[name]
    found_ms = [run[f"{name}_ms"] for run in runs if run[f"{name}_ms"] is not None]
    axes.plot(found_ms, [height] * len(found_ms), "|", color=colour, markersize=7, alpha=0.55)
    summary = group[f"{name}_ms"]
    lowest_ms = min(run["searched_ms"][0] for run in runs)
    highest_ms = max(run["searched_ms"][1] for run in runs)
    if summary["interval"] is not None:
        low_ms, high_ms = summary["interval"]
        low_ms, high_ms = lowest_ms if low_ms is None else low_ms, highest_ms if high_ms is None else high_ms
        axes.plot([low_ms, high_ms], [height] * 2, color=colour, linewidth=2.5, solid_capstyle="butt", alpha=0.9)
    if summary["p50"] is not None:
        axes.plot(summary["p50"], height, marker, color=colour, markersize=6, markeredgecolor="white", zorder=3)
    below_count = sum(name in run["below"] for run in runs)
    above_count = len(runs) - len(found_ms) - below_count
    for count, edge_ms, (offset_points, alignment, arrow) in (
        (below_count, lowest_ms, (-4, "right", "\N{LEFTWARDS ARROW}")),
        (above_count, highest_ms, (4, "left", "\N{RIGHTWARDS ARROW}")),
    ):
        if count:
            axes.annotate(
                f"{arrow}{count}",
                (edge_ms, height),
                xytext=(offset_points, 0),
                textcoords="offset points",
                color=colour,
                fontsize=8,
                ha=alignment,
                va="center",
            )


def boundary_table(boundary: Boundary) -> TableData:
    """Return the table of all groups: median, its interval, and quartiles of each criterion, in ms."""
    columns = [
        text_column("route"),
        text_column("preset"),
        number_column("seeds", 0),
        number_column("onset by theory (ms)", 0),
    ]
    for name in CRITERIA:
        columns += [
            number_column(f"{LABELS[name]}: median (ms)", 0),
            Column(f"{LABELS[name]}: 95 % interval (ms)", format_ends, LOW_HIGH),
            Column(f"{LABELS[name]}: quartiles (ms)", format_ends, LOW_HIGH),
            number_column(f"{LABELS[name]}: in range", 0),
        ]
    columns.append(number_column("not monotone", 0))
    return TableData(columns, [_row(group) for group in boundary["groups"]])


def _row(group: Mapping[str, Any]) -> list[Any]:
    cells = [group["route"] or ALL_ROUTES, group["preset"], group["n"], group["theory_ms"]]
    for name in CRITERIA:
        summary = group[f"{name}_ms"]
        cells += [summary["p50"], summary["interval"], [summary["p25"], summary["p75"]], summary["n"]]
    return [*cells, sum(group["not_monotone"].values())]


def format_ends(ends: Sequence[float | None] | None) -> str:
    """Format the two ends of an interval in whole milliseconds; an end outside the searched range becomes a dash."""
    if ends is None or all(end is None for end in ends):
        return NOTHING
    return " to ".join(format_number(end, 0) for end in ends).replace(" ", UNBROKEN)
