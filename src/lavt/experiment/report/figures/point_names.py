"""The names of points in a figure, each at a place where it covers neither another name nor a point."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from lavt.experiment.report.figures.figure_style import SMALL_TEXT_POINTS, FigurePoint

COLOURS = {"paper": "0.45"}
"""The colour of the names of a kind of points; other names are black."""

CHARACTER_POINTS = 0.6 * SMALL_TEXT_POINTS
LINE_POINTS = 1.25 * SMALL_TEXT_POINTS
"""Width of a character and height of a line, in typographic points, with a margin for other fonts."""
MARKER_POINTS = 4.0
"""Half the size of a marker."""
SAME_PLACE_POINTS = 5.0
"""Points of one kind that are not farther apart share a name."""
NEAR_POINTS = 20.0
"""A point is not named if a point with its name, of another kind, is not farther away."""

DISTANCES_POINTS = (6.0, 10.0, 16.0, 24.0, 34.0, 46.0)
"""The tried distances of a name from its point; a line leads from the point to a name that is farther than the second.
"""
DIRECTIONS = 16

OUTSIDE, ON_NAME, ON_MARKER, ON_BAR, NEARER_TO_OTHER, ON_LINE = 1e6, 1e5, 1e3, 100.0, 40.0, 8.0
"""The costs of a place; besides, each typographic point of distance costs 1."""


class PointName(NamedTuple):
    """A name and the point that it belongs to, in the units of the axes."""

    text: str
    x: float
    y: float
    colour: str = "black"


class _Box(NamedTuple):
    """A rectangle in typographic points."""

    left: float
    bottom: float
    right: float
    top: float

    def overlaps(self, other: _Box) -> bool:
        return (
            self.left < other.right and other.left < self.right and self.bottom < other.top and other.bottom < self.top
        )

    def distance_to(self, x: float, y: float) -> float:
        return math.hypot(max(self.left - x, x - self.right, 0.0), max(self.bottom - y, y - self.top, 0.0))


def name_points(figure: Figure, named_points: Iterable[tuple[Axes, str, Sequence[FigurePoint]]]) -> None:
    """Write the names of the points of each kind in each panel.

    Everything else must be drawn, because names are placed around it. Points of one kind at the same place share a
    name, and a point near a point of LAVT with its name is not named again.
    """
    figure.draw_without_rendering()  # the layout is known from then on
    names: dict[Axes, list[PointName]] = {}
    named: list[tuple[Axes, FigurePoint]] = []
    for axes, kind, points in sorted(named_points, key=lambda entry: entry[1] == "paper"):  # the paper's names last
        others = [] if kind == "paper" else [other for panel, other in named if panel is axes]
        new = [point for point in points if not any(_is_named_by(point, other, axes) for other in others)]
        named += [(axes, point) for point in new if kind != "paper"]
        names.setdefault(axes, []).extend(_joined(new, axes, COLOURS.get(kind, "black")))
    for axes, panel_names in names.items():
        place_names(axes, panel_names)


def name_shared_places(figure: Figure, panels: Iterable[tuple[Axes, Sequence[FigurePoint]]]) -> None:
    """Write names only where several of the points that a panel is listed with are at the same place."""
    figure.draw_without_rendering()
    names: dict[Axes, list[PointName]] = {}
    for axes, points in panels:
        single_names = {point.name for point in points}
        shared = [name for name in _joined(points, axes, "black") if name.text not in single_names]
        names.setdefault(axes, []).extend(shared)
    for axes, panel_names in names.items():
        place_names(axes, panel_names)


def _is_named_by(point: FigurePoint, other: FigurePoint, axes: Axes) -> bool:
    return point.name == other.name and _distance(point, other, axes) <= NEAR_POINTS


def _joined(points: Sequence[FigurePoint], axes: Axes, colour: str) -> list[PointName]:
    """Return a name for each set of points at the same place."""
    groups: list[list[FigurePoint]] = []
    for point in sorted(points, key=lambda point: point.name):
        group = next((group for group in groups if _distance(group[0], point, axes) <= SAME_PLACE_POINTS), None)
        if group is None:
            groups.append([point])
        else:
            group.append(point)
    return [PointName(", ".join(p.name for p in group), group[0].x, group[0].y, colour) for group in groups]


def _distance(a: FigurePoint, b: FigurePoint, axes: Axes) -> float:
    (x, y), (other_x, other_y) = _positions(axes, [(a.x, a.y), (b.x, b.y)])
    return math.hypot(x - other_x, y - other_y)


def _positions(axes: Axes, points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return points of the axes in typographic points of the figure."""
    pixels = axes.transData.transform(np.array(list(points), np.float64).reshape(-1, 2))
    return [(float(x), float(y)) for x, y in pixels * 72 / _dpi(axes)]


def _dpi(axes: Axes) -> float:
    return float(axes.get_figure(root=True).dpi)  # type: ignore[union-attr]  # axes of a figure have one


def place_names(axes: Axes, names: Sequence[PointName]) -> None:
    """Write names in a panel whose layout is known, each at the place with the lowest cost.

    A name is inside its panel, and it covers no other name. As far as there is room, it also covers no marker, bar or
    line, and is nearer to its own point than to others.
    """
    window = axes.get_window_extent()
    panel = _Box(*(edge * 72 / _dpi(axes) for edge in (window.x0, window.y0, window.x1, window.y1)))
    obstacles = list(_obstacles(axes))
    positions = _positions(axes, [(name.x, name.y) for name in names])
    placed: list[_Box] = []
    for name, (x, y) in zip(names, positions, strict=True):
        others = [other for other in positions if other != (x, y)]
        _, shift_x, shift_y, box = min(
            (
                (_cost(box, panel, placed, obstacles) + distance + _nearness(box, (x, y), others), dx, dy, box)
                for distance, dx, dy, box in _candidates(name.text, x, y)
            ),
            key=lambda place: place[0],
        )
        placed.append(box)
        is_far = box.distance_to(x, y) > DISTANCES_POINTS[1]
        axes.annotate(
            name.text,
            (name.x, name.y),
            xytext=(shift_x, shift_y),
            textcoords="offset points",
            ha="center",
            va="center",
            color=name.colour,
            fontsize=SMALL_TEXT_POINTS,
            arrowprops={"arrowstyle": "-", "color": "0.5", "linewidth": 0.6, "shrinkA": 1, "shrinkB": 4}
            if is_far
            else None,
        ).set_in_layout(False)


def _candidates(text: str, x: float, y: float) -> Iterator[tuple[float, float, float, _Box]]:
    """Return the places of a name: distance from its point, shift of its middle, and its box."""
    half_width, half_height = len(text) * CHARACTER_POINTS / 2, LINE_POINTS / 2
    for distance, step in itertools.product(DISTANCES_POINTS, range(DIRECTIONS)):
        angle = 2 * math.pi * step / DIRECTIONS
        dx = (distance + half_width) * math.cos(angle)
        dy = (distance + half_height) * math.sin(angle)
        yield (
            distance,
            dx,
            dy,
            _Box(x + dx - half_width, y + dy - half_height, x + dx + half_width, y + dy + half_height),
        )


def _cost(box: _Box, panel: _Box, placed: Sequence[_Box], obstacles: Sequence[tuple[_Box, float]]) -> float:
    is_inside = (
        panel.left <= box.left and box.right <= panel.right and panel.bottom <= box.bottom and box.top <= panel.top
    )
    on_names = sum(box.overlaps(other) for other in placed)
    return (
        OUTSIDE * (not is_inside) + ON_NAME * on_names + sum(cost for other, cost in obstacles if box.overlaps(other))
    )


def _nearness(box: _Box, own: tuple[float, float], others: Sequence[tuple[float, float]]) -> float:
    own_distance = box.distance_to(*own)
    return NEARER_TO_OTHER * sum(box.distance_to(*other) < own_distance + 1 for other in others)


def _obstacles(axes: Axes) -> Iterator[tuple[_Box, float]]:
    """Return the boxes of markers, bars and lines of a panel, with the cost of a name on them."""
    for line in axes.lines:
        points = _positions(axes, line.get_xydata())  # type: ignore[arg-type]  # rows of two numbers
        if line.get_marker() not in {None, "None", "none", ""}:
            for x, y in points:
                yield _Box(x - MARKER_POINTS, y - MARKER_POINTS, x + MARKER_POINTS, y + MARKER_POINTS), ON_MARKER
        if line.get_linestyle() != "None":
            for start, end in itertools.pairwise(points):
                yield from _along(start, end, ON_LINE)
    for bars in axes.collections:
        if isinstance(bars, LineCollection):
            for (x, low), (_, high) in (_positions(axes, segment[[0, -1]]) for segment in bars.get_segments()):
                yield _Box(x - 2, low, x + 2, high), ON_BAR


def _along(start: tuple[float, float], end: tuple[float, float], cost: float) -> Iterator[tuple[_Box, float]]:
    """Return small boxes along a line."""
    count = max(math.ceil(math.dist(start, end) / 4), 1)
    for index in range(count + 1):
        x, y = (a + (b - a) * index / count for a, b in zip(start, end, strict=True))
        yield _Box(x - 1, y - 1, x + 1, y + 1), cost
