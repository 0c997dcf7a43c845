"""Figures of single drives: trajectories, steering and received frames. No function reads a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lavt.domain import NS_PER_S, FloatArray, Picture
from lavt.experiment.analysis.drive_data import DriveData
from lavt.experiment.analysis.lane_kept import LINE_MARGIN_M
from lavt.experiment.report.figures.figure_style import Colours, condition_handles, legend_below, new_figure, tidy

DRAWN_EVERY_M = 0.5
"""Distance between drawn points. Denser points cannot be distinguished and make the file of 90 drives too large."""

EARLY_END_MARKER: dict[str, Any] = {
    "color": "red",
    "marker": "x",
    "markersize": 6,
    "markeredgewidth": 1.5,
    "linestyle": "none",
    "zorder": 5,
}

OWN_LANE_LIMIT: dict[str, Any] = {
    "color": "0.5",
    "linewidth": 0.8,
    "linestyle": "--",
    "zorder": 1,
    "label": "own lane",
}


def drawn_indexes(progress_m: FloatArray) -> list[int]:
    """Return the indexes of a drive's samples to draw: one for each `DRAWN_EVERY_M` of progress, and the last one."""
    if not len(progress_m):
        return []
    bins = np.floor(progress_m / DRAWN_EVERY_M)
    changed = np.flatnonzero(np.diff(bins) != 0) + 1
    return sorted({0, *changed.tolist(), len(progress_m) - 1})


def trajectories_figure(routes: Mapping[str, Sequence[DriveData]], colours: Colours) -> Figure:
    """Return the figure of all trajectories from above, one panel for each route.

    The lane centre is a thick black line, each drive a thin line in the colour of its condition. A red cross marks the
    end of a drive that ended early.
    """
    references = {route: max((drive.reference_m for drive in drives), key=len) for route, drives in routes.items()}
    rotations = {route: _rotation_to_x(reference_m) for route, reference_m in references.items()}
    extents_m = {route: _extent(rotations[route](reference_m)) for route, reference_m in references.items()}
    heights = [min(max(height_m / width_m, 0.12), 0.7) for width_m, height_m in extents_m.values()]
    figure = new_figure(3.1 * sum(heights) + 0.55 * len(heights) + 0.7)
    panels = figure.subplots(len(routes), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axes, (route, drives) in zip(panels, routes.items(), strict=True):
        rotate, reference_m = rotations[route], rotations[route](references[route])
        axes.plot(reference_m[:, 0], reference_m[:, 1], color="black", linewidth=2.5, solid_capstyle="butt")
        early_ends = []
        for drive in drives:
            shown = drawn_indexes(drive.truth.floats("progress_m"))
            path_m = rotate(np.column_stack([drive.truth.floats("x_m")[shown], drive.truth.floats("y_m")[shown]]))
            axes.plot(path_m[:, 0], path_m[:, 1], color=colours[drive.condition], linewidth=0.7)
            if drive.result["ending"] != "completed":
                early_ends.append(path_m[-1])
        if early_ends:
            axes.plot(*np.transpose(early_ends), **EARLY_END_MARKER)
        tidy(axes, "", "m", f"Route {route}, {len(drives)} runs")
        axes.set_aspect("equal", adjustable="datalim")
    panels[-1].set_xlabel("m")
    _legend(figure, routes, colours)
    return figure


def _rotation_to_x(reference_m: FloatArray) -> Any:
    """Return a function that moves and rotates points, an array (n, 2) in m, so that the reference lies along x."""
    if len(reference_m) < 2:
        return lambda points_m: points_m
    middle_m = reference_m.mean(axis=0)
    axes = np.linalg.svd(reference_m - middle_m, full_matrices=False)[2]
    axes[0] *= np.sign(axes[0] @ (reference_m[-1] - reference_m[0])) or 1.0
    rotation = np.array([axes[0], [-axes[0, 1], axes[0, 0]]])
    first_m = reference_m[0]
    return lambda points_m: (points_m - first_m) @ rotation.T


def _extent(points_m: FloatArray) -> tuple[float, float]:
    """Return the width and the height in m of the area to draw, with a margin."""
    if len(points_m) < 2:
        return 1.0, 0.5
    width_m, height_m = np.ptp(points_m, axis=0) + 12.0
    return float(width_m), float(height_m)


def cross_track_figure(
    routes: Mapping[str, Sequence[DriveData]], colours: Colours, compared: Sequence[DriveData]
) -> Figure:
    """Return the figure of cross-track error over distance along the route, one panel for each route.

    The scale of the error includes the drives in `compared`, so that several figures have the same scale. Dashed lines
    show how far from the centre a car still counts as in its own lane.
    """
    figure = new_figure(1.15 * len(routes) + 0.7)
    panels = figure.subplots(len(routes), 1, squeeze=False, sharey=True)[:, 0]
    for axes, (route, drives) in zip(panels, routes.items(), strict=True):
        axes.axhline(0, color="black", linewidth=2)
        for limit_m in _own_lane_limits_m(drives):
            axes.axhline(limit_m, **OWN_LANE_LIMIT)
        early_ends = []
        for drive in drives:
            progress_m, error_m = drive.truth.floats("progress_m"), drive.truth.floats("cross_track_m")
            shown = drawn_indexes(progress_m)
            axes.plot(progress_m[shown], error_m[shown], color=colours[drive.condition], linewidth=0.7)
            if drive.result["ending"] != "completed":
                early_ends.append((progress_m[-1], error_m[-1]))
        if early_ends:
            axes.plot(*np.transpose(early_ends), **EARLY_END_MARKER)
        tidy(axes, "", "", f"Route {route}")
    limits_m = _own_lane_limits_m(compared)
    errors_m = [drive.truth.floats("cross_track_m") for drive in compared]
    panels[0].set_ylim(*_scale([*errors_m, np.array(limits_m)]))  # of all panels
    panels[-1].set_xlabel("distance along the route (m)")
    figure.supylabel("left of lane centre (m)")
    _legend(figure, routes, colours, [Line2D([], [], **OWN_LANE_LIMIT)] * bool(limits_m))
    return figure


def _own_lane_limits_m(drives: Sequence[DriveData]) -> list[float]:
    """Return the smallest and the largest distance to the left of the lane centre that is in the own lane, if known."""
    widths_m = [kept["lane_width_m"] for drive in drives if (kept := drive.result.get("lane_kept"))]
    if not widths_m:
        return []
    limit_m = float(np.median(widths_m)) / 2 + LINE_MARGIN_M
    return [-limit_m, limit_m]


def _legend(
    figure: Figure, routes: Mapping[str, Sequence[DriveData]], colours: Colours, limits: Sequence[Line2D] = ()
) -> None:
    names = sorted({drive.condition for drives in routes.values() for drive in drives})
    reference = Line2D([], [], color="black", linewidth=2.5, label="lane centre")
    early_end = Line2D([], [], label="ended early", **EARLY_END_MARKER)
    legend_below(figure, [*condition_handles(names, colours), reference, *limits, early_end])


def time_figure(drives: Sequence[DriveData], colours: Colours, compared: Sequence[DriveData]) -> Figure:
    """Return the figure of steering and cross-track error over time, one row for each drive.

    The scales include the drives in `compared`, so that several figures have the same scales.
    """
    figure = new_figure(1.1 * len(drives) + 0.4)
    panels = figure.subplots(len(drives), 2, sharex=True, sharey="col", squeeze=False)
    for (steering_axes, error_axes), drive in zip(panels, drives, strict=True):
        time_s = _time_s(drive)
        colour = colours[drive.condition]
        steering_axes.plot(time_s, np.degrees(drive.truth.floats("steering_rad")), color=colour, linewidth=1)
        error_axes.plot(time_s, drive.truth.floats("cross_track_m"), color=colour, linewidth=1)
        tidy(steering_axes, "", "steering (°)", f"{drive.condition}, {str(drive.result['ending']).replace('_', ' ')}")
        tidy(error_axes, "", "left (m)")
    for axes in panels[-1]:
        axes.set_xlabel("time (s)")
    panels[0, 0].set_xlim(*_scale([_time_s(drive) for drive in compared]))
    panels[0, 0].set_ylim(*_scale([np.degrees(drive.truth.floats("steering_rad")) for drive in compared]))
    panels[0, 1].set_ylim(*_scale([drive.truth.floats("cross_track_m") for drive in compared]))
    return figure


def _time_s(drive: DriveData) -> FloatArray:
    return (drive.truth.ints("mono_ns") - drive.began_ns) / NS_PER_S


def _scale(values: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the ends of an axis that shows all finite values with a margin."""
    known = np.concatenate([np.zeros(1), *values])
    low, high = np.nanmin(known), np.nanmax(known)
    margin = 0.06 * float(high - low) or 1.0
    return float(low) - margin, float(high) + margin


def frames_figure(pictures: Sequence[tuple[str, Picture]]) -> Figure:
    """Return the figure of received pictures, each with a line of text."""
    columns = min(2, len(pictures))
    rows = -(-len(pictures) // columns)
    figure = new_figure(1.45 * rows)
    for axes in figure.subplots(rows, columns, squeeze=False).flat:
        axes.axis("off")
    for axes, (text, picture) in zip(figure.axes, pictures, strict=False):
        axes.imshow(picture[:, :, ::-1])
        axes.set_title(text, loc="left")
    return figure
