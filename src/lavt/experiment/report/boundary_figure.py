"""The maximum tolerable latency as a figure and as a table, from the contents of `boundary.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lavt.experiment.report.table_format import LOW_HIGH, NOTHING, UNBROKEN, Column, TableData, number, numbers, texts
from lavt.experiment.statistics.boundary_summary import CRITERIA

STYLES = {"onset": ("#0072b2", "o"), "departure": ("#e69f00", "s"), "completion": ("#d55e00", "D")}
"""Colour (Okabe and Ito) and marker of each criterion; the markers differ, too."""
LABELS = {"onset": "oscillation begins to grow", "departure": "first leaves its lane", "completion": "not completed"}
ROW_OFFSETS = {"onset": 0.26, "departure": 0.0, "completion": -0.26}
"""Upward offset of each criterion from the middle of its route's row."""
ALL_ROUTES = "all routes"

Boundary = Mapping[str, Any]
"""The contents of `boundary.json`."""


def boundary_figure(boundary: Boundary) -> Figure:
    """Return the figure of total delays at which each criterion is first met: a panel for each preset, a row a route.

    A tick is a seed, the large point the median, the bar its 95 % interval, and the dashed line the onset by theory.
    Seeds that do not meet a criterion in the searched range are counted at the right edge, seeds that meet it from the
    beginning at the left edge. An interval that ends out of range is drawn to its edge.
    """
    presets = list(dict.fromkeys(group["preset"] for group in boundary["groups"]))
    rows = {preset: [each for each in boundary["groups"] if each["preset"] == preset] for preset in presets}
    height_in = 1.0 + sum(0.75 + 0.5 * len(groups) for groups in rows.values())
    figure = Figure(figsize=(8, height_in), dpi=130, layout="constrained")
    panels = figure.subplots(
        len(presets), 1, sharex=True, squeeze=False, height_ratios=[len(rows[each]) for each in rows]
    )
    for axes, preset in zip(panels[:, 0], presets, strict=True):
        _panel(axes, boundary["runs"], rows[preset])
        axes.set_title(preset, loc="left", fontsize=10)
    panels[-1, 0].set_xlabel("total delay, from the middle of the exposure to the wheel's command (ms)")
    handles = [
        Line2D([], [], linestyle="none", marker=marker, color=colour, label=LABELS[name])
        for name, (colour, marker) in STYLES.items()
    ]
    handles.append(Line2D([], [], linestyle="--", color="black", label="onset by theory"))
    figure.legend(handles=handles, fontsize=8, ncols=4, loc="outside lower center", frameon=False)
    return figure


def _panel(axes: Axes, runs: Sequence[Mapping[str, Any]], groups: Sequence[Mapping[str, Any]]) -> None:
    for row, group in enumerate(reversed(groups)):
        chosen = [run for run in runs if run["preset"] == group["preset"] and group["route"] in (None, run["route"])]
        for name in CRITERIA:
            _criterion(axes, row + ROW_OFFSETS[name], name, chosen, group)
    if groups[0]["theory_ms"] is not None:
        axes.axvline(groups[0]["theory_ms"], color="black", linestyle="--", linewidth=1, zorder=1)
    axes.set_yticks(range(len(groups)), [group["route"] or ALL_ROUTES for group in reversed(groups)])
    axes.set_ylim(-0.6, len(groups) - 0.4)
    axes.set_xlim(0, 1.06 * max((run["searched_ms"][1] for run in runs), default=1.0))
    axes.grid(visible=True, axis="x", alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _criterion(
    axes: Axes, height: float, name: str, runs: Sequence[Mapping[str, Any]], group: Mapping[str, Any]
) -> None:
    """Draw one criterion of one row: a tick for each seed, the median with its interval, and seeds out of range."""
    colour, marker = STYLES[name]
    found_ms = [run[f"{name}_ms"] for run in runs if run[f"{name}_ms"] is not None]
    axes.plot(found_ms, [height] * len(found_ms), "|", color=colour, markersize=7, alpha=0.55)
    summary = group[f"{name}_ms"]
    lowest_ms, highest_ms = (f(run["searched_ms"][end] for run in runs) for end, f in ((0, min), (1, max)))
    if summary["interval"] is not None:
        low_ms, high_ms = summary["interval"]
        low_ms, high_ms = lowest_ms if low_ms is None else low_ms, highest_ms if high_ms is None else high_ms
        axes.plot([low_ms, high_ms], [height] * 2, color=colour, linewidth=2.5, solid_capstyle="butt", alpha=0.9)
    if summary["p50"] is not None:
        axes.plot(summary["p50"], height, marker, color=colour, markersize=6, markeredgecolor="white", zorder=3)
    below = sum(name in run["below"] for run in runs)
    above = len(runs) - len(found_ms) - below
    for count, place_ms, (aside, side, sign) in (
        (below, lowest_ms, (-4, "right", "\N{LEFTWARDS ARROW}")),
        (above, highest_ms, (4, "left", "\N{RIGHTWARDS ARROW}")),
    ):
        if count:
            axes.annotate(
                f"{sign}{count}",
                (place_ms, height),
                xytext=(aside, 0),
                textcoords="offset points",
                color=colour,
                fontsize=8,
                ha=side,
                va="center",
            )


def boundary_table(boundary: Boundary) -> TableData:
    """Return the table of all groups: median, its interval, and quartiles of each criterion, in ms."""
    columns = [texts("route"), texts("preset"), numbers("seeds", 0), numbers("onset by theory (ms)", 0)]
    for name in CRITERIA:
        columns += [
            numbers(f"{LABELS[name]}: median (ms)", 0),
            Column(f"{LABELS[name]}: 95 % interval (ms)", span, LOW_HIGH),
            Column(f"{LABELS[name]}: quartiles (ms)", span, LOW_HIGH),
            numbers(f"{LABELS[name]}: in range", 0),
        ]
    columns.append(numbers("not monotone", 0))
    return TableData(columns, [_row(group) for group in boundary["groups"]])


def _row(group: Mapping[str, Any]) -> list[Any]:
    cells = [group["route"] or ALL_ROUTES, group["preset"], group["n"], group["theory_ms"]]
    for name in CRITERIA:
        of_criterion = group[f"{name}_ms"]
        quartiles = [of_criterion["p25"], of_criterion["p75"]]
        cells += [of_criterion["p50"], of_criterion["interval"], quartiles, of_criterion["n"]]
    return [*cells, sum(group["not_monotone"].values())]


def span(ends: Sequence[float | None] | None) -> str:
    """Return two ends in whole milliseconds; an end out of range is a dash."""
    if ends is None or ends[0] is ends[1] is None:
        return NOTHING
    return " to ".join(number(end, 0) for end in ends).replace(" ", UNBROKEN)
