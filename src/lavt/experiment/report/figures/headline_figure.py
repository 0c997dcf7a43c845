"""The figure at the top of a report: completion in the own lane, and the error, over the loop latency."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lavt.experiment.report.figures.figure_style import (
    Colours,
    Conditions,
    FigurePoint,
    draw_point,
    kind_handles,
    legend_below,
    marker,
    new_figure,
    shown_interval,
    tidy,
)
from lavt.experiment.report.figures.latency_figures import PAPER_MARKER
from lavt.experiment.report.figures.point_names import name_points


def has_own_lane(kinds: Mapping[str, Conditions]) -> bool:
    """Return whether it is known for any condition how many runs were completed in their own lane."""
    return any(
        entry.get("own_lane_completion_rate") is not None
        for conditions in kinds.values()
        for entry in conditions.values()
    )


def headline_figure(kinds: Mapping[str, Conditions], paper: Conditions, colours: Colours) -> Figure:
    """Return the figure: one panel for completion, one for P95 of the cross-track error, each condition is a point.

    If no run says whether it was in its own lane, the figure shows all completed runs.
    """
    figure = new_figure(3.5)
    completion, error = figure.subplots(2, 1, sharex=True)
    own_lane = has_own_lane(kinds)
    named_points: list[tuple[Axes, str, list[FigurePoint]]] = []
    for kind, conditions in {"paper": paper, **kinds}.items():
        for axes, points in ((completion, _completions(conditions, own_lane)), (error, _errors(conditions))):
            if kind != "real":
                path = sorted(points, key=lambda point: point.x)
                style = {"color": "0.7", "linewidth": 1, "zorder": 0, "linestyle": ":" if kind == "paper" else "-"}
                axes.plot([point.x for point in path], [point.y for point in path], **style)
            for point in points:
                draw_point(axes, point, PAPER_MARKER if kind == "paper" else marker(kind, colours[point.name]))
            named_points.append((axes, kind, points))
    tidy(completion, "", "completed\nin own lane (%)" if own_lane else "completed (%)")
    tidy(error, "loop latency, median (ms)", "P95 of cross-track\nerror (m)")
    completion.set_ylim(-14, 109)
    completion.margins(x=0.1)
    error.set_ylim(bottom=-0.14 * error.get_ylim()[1])
    handles: list[Any] = kind_handles(kinds)
    if paper:
        handles.append(Line2D([], [], linestyle="none", **PAPER_MARKER))
    legend_below(figure, handles)
    name_points(figure, named_points)
    return figure


def _completions(conditions: Conditions, own_lane: bool) -> list[FigurePoint]:
    points = []
    for name, entry in conditions.items():
        prefix = "own_lane_" if own_lane and "own_lane_completion_rate" in entry else ""
        rate, interval = entry[f"{prefix}completion_rate"], entry[f"{prefix}completion_interval"]
        if rate is not None and _loop_ms(entry) is not None:
            points.append(FigurePoint(name, _loop_ms(entry) or 0.0, 100 * rate, shown_interval(entry, interval, 100.0)))
    return points


def _errors(conditions: Conditions) -> list[FigurePoint]:
    """Return the points of the error of all runs, each up to its own end, or else that of the completed runs."""
    points = []
    for name, entry in conditions.items():
        all_runs = (entry.get("by_road") or {}).get("p95_all_runs_m") or {}
        value_m, interval = entry.get("p95_m"), entry.get("p95_interval")
        if all_runs.get("mean") is not None:
            value_m = all_runs["mean"]
            interval = None if all_runs["low"] is None else (all_runs["low"], all_runs["high"])
        if value_m is not None and _loop_ms(entry) is not None:
            points.append(FigurePoint(name, _loop_ms(entry) or 0.0, value_m, shown_interval(entry, interval, 1.0)))
    return points


def _loop_ms(entry: Mapping[str, Any]) -> float | None:
    """Return the median loop latency; of the paper, the sum of its two one-way latencies."""
    if "loop_ms" not in entry:
        return float(entry["tau_v_ms"] + entry["tau_c_ms"])
    median_ms: float | None = entry["loop_ms"]["p50"]
    return median_ms
