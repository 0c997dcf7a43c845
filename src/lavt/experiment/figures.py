"""The figures of a report. Each function makes one figure of plain data; nothing here reads a file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from lavt.domain import NS_PER_S, Picture
from lavt.experiment.breakdown import Share
from lavt.experiment.drives import Drive

Conditions = Mapping[str, Mapping[str, Any]]
"""A summary's `conditions` or `real`."""

Colours = Mapping[str, Any]
"""The colour of each condition."""

KINDS = {"virtual": ("o", "virtual time"), "real": ("s", "real time")}
"""Marker and name of the two ways a run can be driven; real runs are hollow, so that nobody takes one for the other."""

COLOURS = ("#0072b2", "#56b4e9", "#009e73", "#e69f00", "#d55e00", "#cc79a7")
"""Told apart with any colour vision, on white and on black (Okabe and Ito, "Color universal design")."""

NODE_COLOURS = {"camera": "Blues", "network": "Greys", "receiver": "Purples", "driver": "Greens", "actuator": "Oranges"}

RESOLUTION_DPI = 130


def condition_colours(names: Iterable[str]) -> dict[str, Any]:
    """Give each condition a colour of its own, to be used in every figure of a report."""
    ordered = sorted(set(names))
    if len(ordered) <= len(COLOURS):
        return dict(zip(ordered, COLOURS, strict=False))
    places = np.linspace(0.05, 0.95, len(ordered))
    return {name: colormaps["turbo"](place) for name, place in zip(ordered, places, strict=True)}


def _figure(width_in: float, height_in: float) -> Figure:
    return Figure(figsize=(width_in, height_in), dpi=RESOLUTION_DPI, layout="constrained")


def _tidy(axes: Axes, x_label: str, y_label: str, title: str = "") -> None:
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.set_title(title, loc="left", fontsize=10)
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _marker(kind: str, colour: Any) -> dict[str, Any]:
    marker, label = KINDS[kind]
    face = colour if kind == "virtual" else "white"
    return {"marker": marker, "markerfacecolor": face, "markeredgecolor": colour, "color": colour, "label": label}


def _beside(kind: str) -> dict[str, Any]:
    """Where a point's name goes: right of virtual runs, left of real ones, so that two at one place can be read."""
    offset, side = ((7, -9), "left") if kind == "virtual" else ((-7, 4), "right")
    return {"xytext": offset, "ha": side, "textcoords": "offset points", "fontsize": 8}


def loop_figure(kinds: Mapping[str, Conditions], colours: Colours) -> Figure:
    """Completion and cross-track error over the median loop latency, with 95 % intervals: one point a condition."""
    figure = _figure(8, 3.6)
    completion, error = figure.subplots(1, 2)
    for kind, conditions in kinds.items():
        names: dict[tuple[Axes, tuple[int, int]], tuple[tuple[float, float], list[str]]] = {}
        for name, condition in conditions.items():
            loop_ms = condition["loop_ms"]["p50"]
            for axes, value, interval, unit in (
                (completion, condition["completion_rate"], condition["completion_interval"], 100.0),
                (error, condition["p95_m"], condition["p95_interval"], 1.0),
            ):
                if loop_ms is not None and value is not None:
                    place = (loop_ms, value * unit)
                    _point(axes, place, interval=interval, unit=unit, marker=_marker(kind, colours[name]))
                    about = (round(place[0] / 8), round(place[1] / unit / 0.1))
                    names.setdefault((axes, about), (place, []))[1].append(name)
        for (axes, _), (place, together) in names.items():
            axes.annotate(", ".join(together), place, **_beside(kind))
    _tidy(completion, "loop latency, median (ms)", "runs completed (%)", "Completion, exact interval")
    completion.set_ylim(-5, 105)
    _tidy(
        error, "loop latency, median (ms)", "cross-track error, p95 (m)", "Error of completed runs, bootstrap interval"
    )
    error.set_ylim(bottom=0)
    _legend_of_kinds(figure, kinds)
    return figure


def _point(
    axes: Axes, place: tuple[float, float], *, interval: Sequence[float] | None, unit: float, marker: dict[str, Any]
) -> None:
    low, high = (bound * unit for bound in interval) if interval else (place[1], place[1])
    reach = [[max(place[1] - low, 0)], [max(high - place[1], 0)]]
    axes.errorbar(*place, yerr=reach, capsize=3, linestyle="none", elinewidth=1, **marker)
    axes.margins(x=0.12)


def _legend_of_kinds(figure: Figure, kinds: Mapping[str, Conditions]) -> None:
    """Say which marker is which kind of time, in grey, because colours are for conditions."""
    handles = [Line2D([], [], linestyle="none", **_marker(kind, "0.4")) for kind in kinds]
    figure.legend(handles=handles, fontsize=8, ncols=2, loc="outside lower center", frameon=False)


def injected_figure(kinds: Mapping[str, Conditions], colours: Colours) -> Figure:
    """Injected against measured delay of video and of control.

    Above: medians, bars from p5 to p95, and lines for the injected delay on top of the latency without any. Below: how
    far the medians are from those lines; bars are the bound of the clocks.
    """
    figure = _figure(8, 5.6)
    panels = figure.subplots(2, 2, sharex="col", height_ratios=[3, 2])
    for column, (direction, key) in enumerate((("video", "tau_v_ms"), ("control", "tau_c_ms"))):
        above, below = panels[:, column]
        for kind, conditions in kinds.items():
            points = _injected_points(conditions, direction, key)
            _draw_injected(above, below, points, kind, colours)
        symbol = "τ video" if direction == "video" else "τ control"
        _tidy(above, "", f"{symbol}, measured (ms)", direction.capitalize())
        above.set_ylim(bottom=min(0.0, above.get_ylim()[0]))
        _tidy(below, f"injected {direction} delay (ms)", "off the line (ms)")
        low, high = below.get_ylim()
        below.set_ylim(min(low, -1.2), max(high, 1.2))
        below.axhline(0, color="0.6", linewidth=0.8, zorder=0)
    _legend_of_kinds(figure, kinds)
    return figure


def _injected_points(conditions: Conditions, direction: str, key: str) -> list[tuple[str, float, Mapping[str, Any]]]:
    """Conditions of which both are known, least injected first."""
    points = [
        (name, float(condition["injected_ms"][direction]), condition[key])
        for name, condition in conditions.items()
        if condition["injected_ms"][direction] is not None and condition[key]["p50"] is not None
    ]
    return sorted(points, key=lambda point: point[1])


def _draw_injected(
    above: Axes,
    below: Axes,
    points: Sequence[tuple[str, float, Mapping[str, Any]]],
    kind: str,
    colours: Colours,
) -> None:
    if not points:
        return
    base_ms = points[0][2]["p50"] - points[0][1]
    farthest_ms = points[-1][1]
    above.plot([0, farthest_ms], [base_ms, base_ms + farthest_ms], color="0.6", linewidth=0.8, zorder=0)
    together: dict[float, list[str]] = {}
    for name, injected_ms, latency in points:
        together.setdefault(injected_ms, []).append(name)
        reach = [[latency["p50"] - latency["p5"]], [latency["p95"] - latency["p50"]]]
        style = {"capsize": 3, "linestyle": "none", **_marker(kind, colours[name])}
        above.errorbar(injected_ms, latency["p50"], yerr=reach, **style)
        below.errorbar(injected_ms, latency["p50"] - injected_ms - base_ms, yerr=latency["bound"] or 0.0, **style)
    medians_ms = {injected_ms: latency["p50"] for _, injected_ms, latency in points}
    for injected_ms, names in together.items():
        above.annotate(", ".join(names), (injected_ms, medians_ms[injected_ms]), **_beside(kind))
    above.margins(x=0.15)


def route_figure(drives: Sequence[Drive], colours: Colours) -> Figure:
    """All drives of one route: from above, and the distance from the lane's centre over the way.

    The reference is thick and black, a red cross is where a drive ended early.
    """
    figure = _figure(8, 6.4)
    above, along = figure.subplots(2, 1, height_ratios=[3, 2])
    reference_m = max((drive.reference_m for drive in drives), key=len)
    above.plot(reference_m[:, 0], reference_m[:, 1], color="black", linewidth=4, label="lane centre")
    along.axhline(0, color="black", linewidth=2)
    for drive in drives:
        label = None if drive.condition in above.get_legend_handles_labels()[1] else drive.condition
        style = {"color": colours[drive.condition], "linewidth": 0.9, "alpha": 0.9}
        x_m, y_m = drive.truth.floats("x_m"), drive.truth.floats("y_m")
        progress_m, error_m = drive.truth.floats("progress_m"), drive.truth.floats("cross_track_m")
        above.plot(x_m, y_m, label=label, **style)
        along.plot(progress_m, error_m, **style)
        if drive.result["ending"] != "completed" and len(drive.truth):
            cross = {"color": "red", "marker": "x", "markersize": 7, "markeredgewidth": 1.8, "zorder": 5}
            above.plot(x_m[-1], y_m[-1], **cross)
            along.plot(progress_m[-1], error_m[-1], **cross)
    _tidy(above, "x (m)", "y (m)", "From above")
    above.set_aspect("equal", adjustable="datalim")
    above.legend(fontsize=8, ncols=2)
    _tidy(along, "distance along the route (m)", "left of lane centre (m)", "Cross-track error")
    return figure


def time_figure(drives: Sequence[Drive], colours: Colours) -> Figure:
    """Steering and cross-track error over time, one row a drive."""
    figure = _figure(8, 1.6 * len(drives) + 0.8)
    rows = figure.subplots(len(drives), 2, sharex=True, sharey="col", squeeze=False)
    for row, drive in zip(rows, drives, strict=True):
        time_s = (drive.truth.ints("mono_ns") - drive.began_ns) / NS_PER_S
        colour = colours[drive.condition]
        row[0].plot(time_s, np.degrees(drive.truth.floats("steering_rad")), color=colour, linewidth=1)
        row[1].plot(time_s, drive.truth.floats("cross_track_m"), color=colour, linewidth=1)
        name = f"{drive.condition}, {drive.result['ending']}"
        _tidy(row[0], "", "steering (°)", name)
        _tidy(row[1], "", "left of centre (m)")
    for axes in rows[-1]:
        axes.set_xlabel("time (s)")
    return figure


def breakdown_figure(shares: Mapping[str, Sequence[Share]]) -> Figure:
    """Where the time of the median loop goes: a bar a condition, a colour a node, a shade a hop."""
    figure = _figure(8, 0.5 * len(shares) + 1.8)
    axes = figure.subplots()
    colours = _hop_colours(shares)
    for row, every in enumerate(shares.values()):
        left_ms = 0.0
        for node, hop, duration_ms in every:
            axes.barh(row, duration_ms, left=left_ms, color=colours[node, hop], edgecolor="white", linewidth=0.3)
            left_ms += duration_ms
        beside: dict[str, Any] = {"xytext": (4, 0), "textcoords": "offset points", "va": "center", "fontsize": 8}
        axes.annotate(f"{left_ms:.0f} ms", (left_ms, row), **beside)
    axes.set_yticks(range(len(shares)), list(shares))
    axes.invert_yaxis()
    axes.margins(x=0.1)
    _tidy(axes, "median loop latency (ms)", "")
    axes.grid(visible=False, axis="y")
    legend = {hop if node == "network" else node: colour for (node, hop), colour in colours.items()}
    handles = [Patch(color=colour, label=name) for name, colour in legend.items()]
    figure.legend(handles=handles, fontsize=8, ncols=len(handles), loc="outside lower center", frameon=False)
    return figure


def _hop_colours(shares: Mapping[str, Sequence[Share]]) -> dict[tuple[str, str], Any]:
    """Give each hop a shade of its node's colour."""
    names = list(dict.fromkeys((node, hop) for every in shares.values() for node, hop, _ in every))
    colours = {}
    for node, hop in names:
        hops = [name for of, name in names if of == node]
        colours[node, hop] = colormaps[NODE_COLOURS[node]](0.35 + 0.45 * hops.index(hop) / max(len(hops) - 1, 1))
    return colours


def frames_figure(pictures: Sequence[tuple[str, Picture]]) -> Figure:
    """Received pictures side by side, each with a line of text."""
    columns = min(2, len(pictures))
    rows = -(-len(pictures) // columns)
    figure = _figure(8, 3.1 * rows)
    for axes in figure.subplots(rows, columns, squeeze=False).flat:
        axes.axis("off")
    for axes, (text, picture) in zip(figure.axes, pictures, strict=False):
        axes.imshow(picture[:, :, ::-1])
        axes.set_title(text, fontsize=9, loc="left")
    return figure
