"""Figures of many runs: distance driven, endings, and results over an axis of the sweep. No function reads a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lavt.experiment.report.figures.figure_style import (
    Colours,
    Conditions,
    condition_handles,
    legend_below,
    new_figure,
    tidy,
)
from lavt.experiment.report.groups import Group, short_name

ENDING_DASHES: Mapping[str, Any] = {
    "collision": "solid",
    "off_road": (0, (4, 2)),
    "safe_stop": (0, (1, 1.5)),
    "timeout": (0, (6, 1.5, 1, 1.5)),
}

PANELS_PER_ROW = 2
"""The number of panels in a row of a figure."""
MAX_BANDS = 2
"""The intervals of survival are drawn for at most this many conditions, because more would overlap."""
MAX_TICKS = 8
"""If an axis has at most this many values, there is a tick for each value."""

AXIS_ROWS = (
    ("runs completed (%)", "completion_rate", 100.0),
    ("error, mean P95 (m)", "p95_m", 1.0),
    ("frame age (ms)", "picture_age_ms", 1.0),
)
"""The rows of panels: label, key of the value in a condition, and the factor by which the value is multiplied."""


def routes_with_survival(conditions: Conditions) -> list[str]:
    """Return the routes with a survival curve under any condition."""
    return sorted({route for entry in conditions.values() for route in entry.get("survival") or {}})


def survival_figure(conditions: Conditions, colours: Colours) -> Figure:
    """Return the figure of the runs that still drive at each distance: a panel for each route, a line per condition.

    The 95 % intervals are drawn for at most `MAX_BANDS` conditions.
    """
    routes = routes_with_survival(conditions)
    figure, panels = _new_panels(len(routes))
    for axes, route in zip(panels, routes, strict=True):
        for (name, entry), width in zip(conditions.items(), _line_widths(len(conditions)), strict=True):
            curve = (entry.get("survival") or {}).get(route)
            if not curve or not curve["distance_m"]:
                continue
            distance_m = curve["distance_m"]
            low, high, surviving = (np.array(curve[key], np.float64) * 100 for key in ("low", "high", "surviving"))
            if len(conditions) <= MAX_BANDS:
                axes.fill_between(distance_m, low, high, step="post", color=colours[name], alpha=0.15, linewidth=0)
            axes.step(distance_m, surviving, where="post", color=colours[name], linewidth=width)
        tidy(axes, "", "", f"Route {route}")
        axes.set_ylim(-4, 104)
    _label_distance(panels)
    figure.supylabel("runs still driving (%)")
    legend_below(figure, list(condition_handles(conditions, colours)))
    return figure


def incidence_figure(conditions: Conditions, colours: Colours) -> Figure:
    """Return the figure of the share of runs that ended in each way, over distance.

    The figure has a panel for each route, a line style for each ending, and a colour for each condition.
    """
    routes = routes_with_survival(conditions)
    figure, panels = _new_panels(len(routes))
    dashes: dict[str, Any] = {}
    for axes, route in zip(panels, routes, strict=True):
        for (name, entry), width in zip(conditions.items(), _line_widths(len(conditions)), strict=True):
            curve = (entry.get("survival") or {}).get(route) or {"incidence": {}}
            for ending, incidence in (curve.get("incidence") or {}).items():
                if any(incidence):
                    dashes[ending] = ENDING_DASHES.get(ending, "solid")
                    style = {"color": colours[name], "linestyle": dashes[ending], "linewidth": width}
                    axes.step(curve["distance_m"], np.array(incidence, np.float64) * 100, where="post", **style)
        tidy(axes, "", "", f"Route {route}")
        axes.set_ylim(-4, 104)
    _label_distance(panels)
    figure.supylabel("runs ended in this way (%)")
    endings = [Line2D([], [], color="0.3", linestyle=dash, label=ending) for ending, dash in dashes.items()]
    legend_below(figure, [*condition_handles(conditions, colours), *endings])
    return figure


def _line_widths(count: int) -> list[float]:
    """Return the width of each line: the first lines are wider, so that they are visible under the lines after them."""
    return [float(width) for width in np.linspace(4.0 if count > 1 else 1.2, 1.2, count)]


def _label_distance(panels: Sequence[Axes]) -> None:
    for axes in panels[-PANELS_PER_ROW:]:
        axes.set_xlabel("distance driven (m)")


def _new_panels(count: int) -> tuple[Figure, list[Axes]]:
    """Return a new figure with `count` small panels that share the scale of y, `PANELS_PER_ROW` in a row."""
    column_count = min(PANELS_PER_ROW, count)
    row_count = -(-count // column_count)
    figure = new_figure(1.6 * row_count + 0.7)
    panels = list(figure.subplots(row_count, column_count, squeeze=False, sharey=True).flat)
    for axes in panels[count:]:
        axes.axis("off")
    return figure, panels[:count]


def axis_figure(groups: Sequence[Group], x_axis: str, colours: Colours, compared: Sequence[Group]) -> Figure:
    """Return the figure of results over one axis of a sweep.

    Each line is a condition. The panels are completion, error and frame age, if they are known. Their scales include
    the groups in `compared`, so that the figures of several values of a second axis have the same scales.
    """
    positions, labels = _positions([group.get(x_axis) for group in groups])
    names = sorted({name for group in groups for name in group["conditions"]})
    entries = [entry for group in compared for entry in group["conditions"].values()]
    rows = [(label, key, scale) for label, key, scale in AXIS_ROWS if any(_has_value(entry, key) for entry in entries)]
    figure = new_figure(1.5 * len(rows) + 0.7)
    panels = figure.subplots(len(rows), 1, squeeze=False, sharex=True)[:, 0]
    for axes, (label, key, scale) in zip(panels, rows, strict=True):
        for name, width in zip(names, _line_widths(len(names)), strict=True):
            points = sorted(
                (positions[str(group.get(x_axis))], _value(group["conditions"][name], key) * scale)
                for group in groups
                if name in group["conditions"] and _has_value(group["conditions"][name], key)
            )
            if points:
                x, y = zip(*points, strict=True)
                axes.plot(x, y, marker="o", markersize=width + 2.5, linewidth=width, color=colours[name])
        tidy(axes, "", label)
        if labels or len(positions) <= MAX_TICKS:
            axes.set_xticks(list(positions.values()), labels or list(positions))
        most = max(_value(entry, key) * scale for entry in entries if _has_value(entry, key))
        axes.set_ylim(0, 1.05 * most or 1.0)
    panels[0].set_ylim(-5, 105)
    panels[-1].set_xlabel(short_name(x_axis))
    legend_below(figure, list(condition_handles(names, colours)))
    return figure


def _has_value(entry: Mapping[str, Any], key: str) -> bool:
    value = entry.get(key)
    return (value.get("mean") if isinstance(value, Mapping) else value) is not None


def _value(entry: Mapping[str, Any], key: str) -> float:
    value = entry[key]
    return float(value["mean"] if isinstance(value, Mapping) else value)


def _positions(values: Sequence[Any]) -> tuple[dict[str, float], list[str]]:
    """Return the position of each value on x, and tick labels if the values are not numbers."""
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return {str(value): float(value) for value in values}, []
    labels = list(dict.fromkeys(str(value) for value in values))
    return {label: float(index) for index, label in enumerate(labels)}, labels
