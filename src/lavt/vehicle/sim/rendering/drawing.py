"""A drawing of a road: a plan to scale, and views from the driver's seat."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from lavt.domain import CameraModel, FloatArray, Pose
from lavt.vehicle.sim.rendering.renderer import Renderer, SceneryKind
from lavt.vehicle.sim.road.cross_section import PavedArea, Rail, RoadElement, RoadMark
from lavt.vehicle.sim.road.road import Road

VIEWS = 4
"""The number of views from the driver's seat, at evenly spaced stations between the route's start and its end."""

DETAIL_M = 40.0
"""The length of road in the detail, which shows single marks."""

_SAMPLE_SPACING_M = 1.0
_LABEL_SPACINGS_M = (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0)
_MAX_LABELS = 12
"""The plan's stations are labelled at the smallest spacing of `_LABEL_SPACINGS_M` with at most `_MAX_LABELS` labels."""

_LABEL_DISTANCE_PT = 24.0
"""The distance of a station's label from the edge of the asphalt."""

_ASPHALT, _LANE, _GRASS = "#8d9096", "#7f9fc4", "#dfe8d5"
_PAINT = {"white": "#ffffff", "yellow": "#f2c14e"}
_RAILS = {"rail": "#b5541c", "barrier": "#222222"}
_PLAN_MARK_WIDTH_PT = 0.3
"""The line width of marks in the plan, where they are too thin to draw to scale."""


def draw_road(road: Road, *, model: CameraModel, scenery: SceneryKind = "full") -> Figure:
    """Draw a plan of `road`, a detail of its start, its curvature, and views of the camera `model`."""
    figure = Figure(figsize=(14.0, 11.5), dpi=110, layout="constrained")
    figure.suptitle(f"{road.title}: {road.route_length_m:.1f} m", fontsize=14, fontweight="bold")
    grid = figure.add_gridspec(3, VIEWS, height_ratios=[3.4, 0.8, 1.6])
    _draw_plan(figure.add_subplot(grid[0, :3]), road)
    _draw_detail(figure.add_subplot(grid[0, 3]), road)
    _draw_curvature(figure.add_subplot(grid[1, :]), road)
    renderer = Renderer(road, model, seed=1, scenery=scenery)
    for column, s_m in enumerate(np.linspace(0.0, road.route_length_m, VIEWS).tolist()):
        x_m, y_m, heading_rad, _ = (float(value) for value in road.centre_at(s_m))
        axes = figure.add_subplot(grid[2, column])
        axes.imshow(renderer.render(Pose(0, x_m, y_m, heading_rad), column)[..., ::-1])
        axes.set_title(f"from the driver's seat at {s_m:.0f} m", fontsize=9, loc="left")
        axes.set_axis_off()
    return figure


def _draw_plan(axes: Axes, road: Road) -> None:
    """Draw the road from above, to scale, with labelled stations."""
    first_m, last_m = max(road.first_m, -60.0), min(road.last_m, road.route_length_m + 120.0)
    _draw_ground(axes, road, first_m, last_m)
    spacings_m = (spacing_m for spacing_m in _LABEL_SPACINGS_M if road.route_length_m / spacing_m <= _MAX_LABELS)
    right_edge_m = min(min(strip.rights_m) for strip in road.paved)
    for s_m in np.arange(0.0, road.route_length_m, next(spacings_m, _LABEL_SPACINGS_M[-1])).tolist():
        edge, beyond = road.point_at(s_m, [right_edge_m, right_edge_m - 1.0])
        label: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8, "ha": "center", "va": "center"}
        line = {"arrowstyle": "-", "linewidth": 0.8, "shrinkB": 0.0}
        axes.annotate(f"{s_m:.0f} m", edge, xytext=(beyond - edge) * _LABEL_DISTANCE_PT, arrowprops=line, **label)
    for s_m, colour, name in ((0.0, "#1a7f37", "start"), (road.route_length_m, "#c1121f", "end")):
        edges_m = road.lanes.edges_at(s_m)
        axes.plot(*road.point_at(s_m, [edges_m[0], edges_m[-1]]).T, color=colour, linewidth=2.5, label=name)
    axes.legend(fontsize=8, loc="best")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title("from above", fontsize=10, loc="left")
    axes.set_xlabel("x / m")
    axes.set_ylabel("y / m")


def _draw_detail(axes: Axes, road: Road) -> None:
    """Draw the first metres of the road as if it were straight; stations increase upwards, and offsets to the left."""
    last_m = min(DETAIL_M, road.route_length_m)
    for strip in _overlapping(road.paved, 0.0, last_m):
        stations_m = _sample_stations(_first_station(strip, 0.0), _last_station(strip, last_m))
        axes.fill_betweenx(stations_m, strip.right_at(stations_m), strip.left_at(stations_m), color=_ASPHALT)
    stations_m = _sample_stations(0.0, last_m)
    half_m = _half_widths_m(road, stations_m)
    axes.fill_betweenx(stations_m, -half_m, half_m, color=_LANE, alpha=0.5)
    for mark in _overlapping(road.marks, 0.0, last_m):
        for begin_m, end_m in _painted_pieces(mark, 0.0, last_m):
            stations_m = np.array([begin_m, end_m])
            right_m = mark.offset_at(stations_m) - mark.width_m / 2
            axes.fill_betweenx(stations_m, right_m, right_m + mark.width_m, color=_PAINT[mark.colour])
    for rail in _overlapping(road.rails, 0.0, last_m):
        axes.vlines(
            rail.offset_m,
            _first_station(rail, 0.0),
            _last_station(rail, last_m),
            color=_RAILS[rail.kind],
            linewidth=2.0,
        )
    axes.set_facecolor(_GRASS)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(f"the first {last_m:.0f} m, unrolled", fontsize=10, loc="left")
    axes.invert_xaxis()
    axes.set_xlabel("offset / m, left positive")
    axes.set_ylabel("station / m")


def _draw_curvature(axes: Axes, road: Road) -> None:
    stations_m = np.linspace(0.0, road.route_length_m, 2001)
    axes.plot(stations_m, road.centre_at(stations_m).curvature_per_m, color="#1f4e79")
    axes.set_xlim(0.0, road.route_length_m)
    axes.grid(visible=True, alpha=0.25)
    axes.set_xlabel("station / m")
    axes.set_ylabel("curvature / (1/m)\nleft positive")


def _draw_ground(axes: Axes, road: Road, first_m: float, last_m: float) -> None:
    axes.set_facecolor(_GRASS)
    for strip in _overlapping(road.paved, first_m, last_m):
        stations_m = _sample_stations(_first_station(strip, first_m), _last_station(strip, last_m))
        _fill(axes, road, stations_m, (strip.left_at(stations_m), strip.right_at(stations_m)), _ASPHALT)
    stations_m = _sample_stations(0.0, road.route_length_m)
    half_m = _half_widths_m(road, stations_m)
    _fill(axes, road, stations_m, (half_m, -half_m), _LANE)
    # A line of fixed width, which stays visible at any scale.
    axes.plot(*road.point_at(_sample_stations(0.0, road.route_length_m), 0.0).T, color=_LANE, linewidth=1.0)
    for colour, paint in _PAINT.items():
        lines = [
            road.point_at(_sample_stations(*piece), mark.offset_at(_sample_stations(*piece)))
            for mark in _overlapping(road.marks, first_m, last_m)
            if mark.colour == colour
            for piece in _painted_pieces(mark, first_m, last_m)
        ]
        axes.add_collection(LineCollection(lines, colors=paint, linewidths=_PLAN_MARK_WIDTH_PT))
    for rail in _overlapping(road.rails, first_m, last_m):
        stations_m = _sample_stations(_first_station(rail, first_m), _last_station(rail, last_m))
        axes.plot(*road.point_at(stations_m, rail.offset_m).T, color=_RAILS[rail.kind], linewidth=0.9)
    axes.margins(0.12)  # room for the stations' labels
    axes.autoscale_view()


def _fill(axes: Axes, road: Road, stations_m: FloatArray, edges_m: tuple[FloatArray, FloatArray], colour: str) -> None:
    left, right = (road.point_at(stations_m, edge_m) for edge_m in edges_m)
    axes.add_collection(PolyCollection([np.concatenate([left, right[::-1]])], facecolors=colour, edgecolors="none"))


def _half_widths_m(road: Road, stations_m: FloatArray) -> FloatArray:
    """Return half the width of the driven lane at stations (n,)."""
    return np.array([road.lanes.driven_width_at(s_m) for s_m in stations_m.tolist()]) / 2


def _overlapping(elements: tuple[RoadElement, ...], first_m: float, last_m: float) -> list[RoadElement]:
    return [element for element in elements if element.from_m < last_m and element.to_m > first_m]


def _painted_pieces(mark: RoadMark, first_m: float, last_m: float) -> list[tuple[float, float]]:
    if mark.kind == "solid":
        return [(_first_station(mark, first_m), _last_station(mark, last_m))]
    return [(begin_m, begin_m + mark.dash_m) for begin_m in mark.dash_begins_m(first_m, last_m).tolist()]


def _first_station(element: PavedArea | RoadMark | Rail, first_m: float) -> float:
    return max(element.from_m, first_m)


def _last_station(element: PavedArea | RoadMark | Rail, last_m: float) -> float:
    return min(element.to_m, last_m)


def _sample_stations(begin_m: float, end_m: float) -> FloatArray:
    return np.linspace(begin_m, end_m, max(2, round((end_m - begin_m) / _SAMPLE_SPACING_M) + 1))
