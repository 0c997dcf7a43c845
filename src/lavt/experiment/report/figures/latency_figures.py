"""Figures of latency: measured and injected latency, the effect of latency on driving, and the latency of stages.

No function reads a file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from lavt.experiment.report.figures.figure_style import (
    SMALL_TEXT_POINTS,
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
from lavt.experiment.report.figures.point_names import PointName, name_points, name_shared_places, place_names

NODE_COLOURS = {"camera": "Blues", "network": "Greys", "receiver": "Purples", "driver": "Greens", "actuator": "Oranges"}
OTHER_COLOURS = "Reds"

PAPER_MARKER: dict[str, Any] = {"marker": "^", "color": "0.55", "label": "the paper", "zorder": 1}

DIAMOND: dict[str, Any] = {"marker": "D", "markersize": 4, "markerfacecolor": "white"}
"""Marker of the error up to the common distance, which all compared runs reached."""

ERROR_LABEL = "P95 of cross-track error,\nmean of runs (m)"

LatencyKey = tuple[str, str]
"""Where the summary of a condition has a latency: the key of an entry, and the key in this entry."""

LOOP: LatencyKey = ("loop_ms", "p50")

LOOP_LABEL = "loop latency, median (ms)"
X_LATENCIES: Mapping[str, LatencyKey] = {LOOP_LABEL: LOOP, "frame age, mean (ms)": ("picture_age_ms", "mean")}
"""The latencies on the x axes of the degradation figures, by label."""


def known_latencies(kinds: Mapping[str, Conditions]) -> list[str]:
    """Return the labels of the latencies that any condition has."""
    return [label for label, latency in X_LATENCIES.items() if _is_known(kinds, latency)]


def degradation_figure(
    kinds: Mapping[str, Conditions], paper: Conditions, colours: Colours, label: str = LOOP_LABEL
) -> Figure:
    """Return the figure of completion and cross-track error over the latency with this label.

    Each condition is a point. The loop latency of the conditions in `paper` is the paper's tau_v + tau_c. Diamonds show
    the error of all runs up to the common distance.
    """
    latency = X_LATENCIES[label]
    named_points: list[tuple[Axes, str, list[FigurePoint]]] = []
    figure = new_figure(4.2)
    completion, error = figure.subplots(2, 1, sharex=True)
    for kind, conditions in {"paper": _with_totals(paper), **kinds}.items():
        shown = {
            completion: _points(conditions, latency, "completion_rate", "completion_interval", 100.0),
            error: _points(conditions, latency, "p95_m", "p95_interval"),
        }
        for axes, points in shown.items():
            for point in points:
                draw_point(axes, point, PAPER_MARKER if kind == "paper" else marker(kind, colours[point.name]))
            named_points.append((axes, kind, points))
        for point in _points(conditions, latency, "p95_common_m", "p95_common_interval"):
            draw_point(error, point, {**DIAMOND, "color": colours[point.name], "zorder": 4})
    completion.margins(x=0.1)
    tidy(completion, "", "runs completed (%)")
    tidy(error, label, ERROR_LABEL)
    completion.set_ylim(-9, 112)  # leaves room for the names below and above the points
    error.set_ylim(bottom=-0.09 * error.get_ylim()[1])
    handles: list[Any] = kind_handles(kinds)
    if any("p95_common_m" in entry for conditions in kinds.values() for entry in conditions.values()):
        label = "error up to the common distance"
        handles.append(Line2D([], [], label=label, color="0.4", linestyle="none", **DIAMOND))
    if any(kind == "paper" and points for _, kind, points in named_points):
        handles.append(Line2D([], [], linestyle="none", **PAPER_MARKER))
    legend_below(figure, handles)
    name_points(figure, named_points)
    return figure


def _is_known(kinds: Mapping[str, Conditions], latency: LatencyKey) -> bool:
    """Return whether any condition has this latency."""
    key, part = latency
    return any(
        (entry.get(key) or {}).get(part) is not None for conditions in kinds.values() for entry in conditions.values()
    )


def _points(
    conditions: Conditions, latency: LatencyKey, y_key: str, interval_key: str, scale: float = 1.0
) -> list[FigurePoint]:
    """Return the points of the conditions that have both the latency and the value `y_key`.

    The value and its interval are multiplied by `scale`.
    """
    key, part = latency
    points: list[FigurePoint] = []
    for name, entry in conditions.items():
        x, y, interval = (entry.get(key) or {}).get(part), entry.get(y_key), entry.get(interval_key)
        if x is not None and y is not None:
            points.append(FigurePoint(name, x, y * scale, shown_interval(entry, interval, scale)))
    return points


def _with_totals(paper: Conditions) -> Conditions:
    """Return the paper's conditions with the sum of both one-way latencies as loop latency."""
    return {name: {**entry, "loop_ms": {"p50": entry["tau_v_ms"] + entry["tau_c_ms"]}} for name, entry in paper.items()}


def presets_figure(groups: Mapping[str, Conditions], colours: Colours) -> Figure:
    """Return the figure of completion and error over loop latency: a line for each group, a colour for each condition.

    The names of conditions are written only where points of a group are at the same place.
    """
    figure = new_figure(4.6)
    completion, error = figure.subplots(2, 1)
    lines: list[tuple[Axes, list[FigurePoint]]] = []
    symbols = dict(zip(groups, "osD^vP", strict=False))
    for number, (title, conditions) in enumerate(groups.items()):
        dashes = (0, (1 + 2 * number, 1)) if number else "solid"  # each group has longer dashes than the last group
        for axes, key, scale in ((completion, "completion_rate", 100.0), (error, "p95_m", 1.0)):
            points = sorted(_points(conditions, LOOP, key, "", scale), key=lambda point: point.x)
            lines.append((axes, points))
            axes.plot([point.x for point in points], [point.y for point in points], color="0.6", linestyle=dashes)
            for point in points:
                axes.plot(point.x, point.y, marker=symbols[title], color=colours[point.name], linestyle="none")
    tidy(completion, "", "runs completed (%)", "Completion")
    completion.set_ylim(-5, 112)
    tidy(error, LOOP_LABEL, ERROR_LABEL, "Error of completed runs")
    error.set_ylim(0, 1.1 * error.get_ylim()[1])
    group_handles = [
        Line2D([], [], color="0.4", marker=symbols[title], label=title, linestyle="none") for title in groups
    ]
    names = dict.fromkeys(name for conditions in groups.values() for name in conditions)
    legend_below(figure, [*group_handles, *(Patch(color=colours[name], label=name) for name in names)])
    name_shared_places(figure, lines)
    return figure


def injected_figure(kinds: Mapping[str, Conditions], colours: Colours) -> Figure:
    """Return the figure of measured one-way latency over injected delay, for video and control.

    The upper panels show medians with bars from p5 to p95, and a line for the expected latency. This line begins at the
    median of the condition with the smallest injected delay, and rises with the injected delay. The lower panels show
    the deviations of the medians from the line; the bars are the bound of the clock error.
    """
    figure = new_figure(3.9)
    panels = figure.subplots(2, 2, sharex="col", height_ratios=[3, 2])
    names: list[tuple[Axes, list[PointName]]] = []
    for column, (direction, key) in enumerate((("video", "tau_v_ms"), ("control", "tau_c_ms"))):
        latency_axes, deviation_axes = panels[:, column]
        names_by_delay: dict[float, PointName] = {}
        for kind, conditions in kinds.items():
            points = _injected_points(conditions, direction, key)
            _draw_injected(panels[:, column], points, kind, colours)
            names_by_delay = {**_injected_names(points), **names_by_delay}
        names.append((latency_axes, list(names_by_delay.values())))
        tidy(latency_axes, "", "measured (ms)" if column == 0 else "", f"τ {direction}")
        latency_axes.set_ylim(bottom=-0.12 * latency_axes.get_ylim()[1])  # leaves room for the names below the points
        tidy(deviation_axes, "injected (ms)", "deviation (ms)" if column == 0 else "")
        low, high = deviation_axes.get_ylim()
        deviation_axes.set_ylim(min(low, -1.2), max(high, 1.2))
        deviation_axes.axhline(0, color="0.6", linewidth=0.8, zorder=0)
    legend_below(figure, list(kind_handles(kinds)))
    figure.draw_without_rendering()
    for axes, panel_names in names:
        place_names(axes, panel_names)
    return figure


def _injected_points(conditions: Conditions, direction: str, key: str) -> list[tuple[str, float, Mapping[str, Any]]]:
    """Return (name, injected delay, latency) of the conditions for which both are known, sorted by injected delay."""
    points = [
        (name, float(condition["injected_ms"][direction]), condition[key])
        for name, condition in conditions.items()
        if condition["injected_ms"][direction] is not None and condition[key]["p50"] is not None
    ]
    return sorted(points, key=lambda point: point[1])


def _draw_injected(
    panels: Sequence[Axes],
    points: Sequence[tuple[str, float, Mapping[str, Any]]],
    kind: str,
    colours: Colours,
) -> None:
    """Draw the points of one kind."""
    if not points:
        return
    latency_axes, deviation_axes = panels
    _, smallest_ms, smallest_latency = points[0]
    _, largest_ms, _ = points[-1]
    base_ms = smallest_latency["p50"] - smallest_ms
    latency_axes.plot([0, largest_ms], [base_ms, base_ms + largest_ms], color="0.6", linewidth=0.8, zorder=0)
    for name, injected_ms, latency in points:
        bar_lengths = [[latency["p50"] - latency["p5"]], [latency["p95"] - latency["p50"]]]
        style = {"capsize": 3, "linestyle": "none", **marker(kind, colours[name])}
        latency_axes.errorbar(injected_ms, latency["p50"], yerr=bar_lengths, **style)
        deviation_ms = latency["p50"] - injected_ms - base_ms
        deviation_axes.errorbar(injected_ms, deviation_ms, yerr=latency["bound"] or 0.0, **style)
    latency_axes.margins(x=0.25)


def _injected_names(points: Sequence[tuple[str, float, Mapping[str, Any]]]) -> dict[float, PointName]:
    """Return one name for all conditions with the same injected delay, by this delay, at the last of their medians."""
    names: dict[float, list[str]] = {}
    for name, injected_ms, _ in points:
        names.setdefault(injected_ms, []).append(name)
    medians_ms = {injected_ms: float(latency["p50"]) for _, injected_ms, latency in points}
    return {ms: PointName(", ".join(group), ms, medians_ms[ms]) for ms, group in names.items()}


def stages_figure(stages: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """Return the figure of stage latencies: a bar for each condition, with a shade for each stage."""
    figure = new_figure(0.3 * len(stages) + 1.5)
    axes = figure.subplots()
    colours = _stage_colours(stages)
    for row, entries in enumerate(stages.values()):
        left_ms = 0.0
        for entry in entries:
            colour = colours[entry["node"], entry["stage"]]
            axes.barh(row, entry["p50"] or 0.0, left=left_ms, color=colour, edgecolor="white", linewidth=0.3)
            left_ms += entry["p50"] or 0.0
        text: dict[str, Any] = {
            "xytext": (4, 0),
            "textcoords": "offset points",
            "va": "center",
            "fontsize": SMALL_TEXT_POINTS,
        }
        axes.annotate(f"{left_ms:.0f} ms", (left_ms, row), **text)
    axes.set_yticks(range(len(stages)), list(stages))
    axes.invert_yaxis()
    axes.margins(x=0.2)
    tidy(axes, "median latency of the stages, in order (ms)", "")
    axes.grid(visible=False, axis="y")
    legend = {stage if node == "network" else node: colour for (node, stage), colour in colours.items()}
    legend_below(figure, [Patch(color=colour, label=name) for name, colour in legend.items()])
    return figure


def _stage_colours(stages: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[tuple[str, str], Any]:
    """Return a colour for each stage: a shade of the colour of its node."""
    names = list(dict.fromkeys((entry["node"], entry["stage"]) for entries in stages.values() for entry in entries))
    colours = {}
    for node, stage in names:
        node_stages = [name for node_name, name in names if node_name == node]
        shades = colormaps[NODE_COLOURS.get(node, OTHER_COLOURS)]
        colours[node, stage] = shades(0.35 + 0.45 * node_stages.index(stage) / max(len(node_stages) - 1, 1))
    return colours
