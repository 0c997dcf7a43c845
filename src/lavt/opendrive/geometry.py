"""The geometry of reference lines: curves whose curvature is linear in the arc length, and cubic curves.

A local frame has its origin at the beginning of a curve; its first axis points ahead in the element's heading, the
second to the left. Curvature is left positive.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_SHARES_AND_WEIGHTS: tuple[tuple[float, float], ...] = tuple(
    zip(((_NODES + 1) / 2).tolist(), (_WEIGHTS / 2).tolist(), strict=True)
)
"""The nodes of the integration rule as shares of an interval, and their weights, whose sum is 1."""

_MAX_PIECE_TURN_RAD = 1.0
"""A clothoid is integrated over pieces that turn by at most this angle."""

_CELL_M = 2.0
_MIN_CELLS, _MAX_CELLS = 8, 512
"""A cubic curve is integrated over cells of this length; their number is limited."""

_ARC_LENGTH_TOLERANCE_M = 1e-9
_MAX_STEPS = 60


class LocalPoint(NamedTuple):
    """A point of a curve in its local frame."""

    ahead_m: float
    left_m: float
    turn_rad: float
    """The heading, relative to the local frame's."""
    curvature_per_m: float


@dataclass(frozen=True, slots=True)
class Cubic:
    """The polynomial a + b x + c x² + d x³."""

    a: float
    b: float = 0.0
    c: float = 0.0
    d: float = 0.0

    def value(self, x: float) -> float:
        """Return the value at `x`."""
        return self.a + x * (self.b + x * (self.c + x * self.d))

    def slope(self, x: float) -> float:
        """Return the first derivative at `x`."""
        return self.b + x * (2 * self.c + x * 3 * self.d)

    def second_derivative(self, x: float) -> float:
        """Return the second derivative at `x`."""
        return 2 * self.c + 6 * self.d * x


@dataclass(frozen=True, slots=True)
class Clothoid:
    """A line, an arc or a clothoid: the curvature is linear in the arc length."""

    length_m: float
    curvature_per_m: float = 0.0
    end_curvature_per_m: float = 0.0

    @property
    def max_turn_rad(self) -> float:
        """An upper bound of the angle by which the curve turns."""
        return self.length_m * max(abs(self.curvature_per_m), abs(self.end_curvature_per_m))

    def point(self, along_m: float) -> LocalPoint:
        """Return the point at the arc length `along_m`."""
        rate = (self.end_curvature_per_m - self.curvature_per_m) / self.length_m if self.length_m else 0.0
        curvature, turn_rad = self.curvature_per_m + rate * along_m, self._turn_rad(along_m, rate)
        if rate == 0.0:
            half_rad = turn_rad / 2
            chord_m = along_m * math.sin(half_rad) / half_rad if abs(half_rad) > 1e-9 else along_m
            return LocalPoint(chord_m * math.cos(half_rad), chord_m * math.sin(half_rad), turn_rad, curvature)
        pieces = max(1, math.ceil(self.max_turn_rad / _MAX_PIECE_TURN_RAD))
        piece_m = along_m / pieces
        ahead_m = left_m = 0.0
        for piece in range(pieces):
            for share, weight in _SHARES_AND_WEIGHTS:
                node_rad = self._turn_rad((piece + share) * piece_m, rate)
                ahead_m += weight * math.cos(node_rad)
                left_m += weight * math.sin(node_rad)
        return LocalPoint(ahead_m * piece_m, left_m * piece_m, turn_rad, curvature)

    def _turn_rad(self, along_m: float, rate_per_m2: float) -> float:
        return along_m * (self.curvature_per_m + rate_per_m2 * along_m / 2)


@dataclass(frozen=True)
class CubicCurve:
    """A curve (ahead(p), left(p)) of two cubic polynomials, for paramPoly3 and poly3.

    OpenDRIVE's s is the arc length, so a point is found by inverting the arc length of the curve, also where the
    parameter is said to be the arc length: it is so only approximately.
    """

    length_m: float
    ahead: Cubic
    left: Cubic
    end: float | None
    """The parameter at the end of the curve, or None if the arc length alone determines the end.

    With an end, the arc length is scaled such that it is `length_m` there: files round the length, and a curve that
    ended elsewhere would leave a gap.
    """

    def point(self, along_m: float) -> LocalPoint:
        """Return the point at the arc length `along_m`."""
        p = self._parameter(along_m)
        ahead, left = self.ahead.slope(p), self.left.slope(p)
        speed = math.hypot(ahead, left)
        turning = ahead * self.left.second_derivative(p) - left * self.ahead.second_derivative(p)
        curvature = turning / speed**3 if speed > 1e-12 else 0.0
        return LocalPoint(self.ahead.value(p), self.left.value(p), math.atan2(left, ahead), curvature)

    def _speed(self, p: float) -> float:
        """Return the metres of arc length per unit of the parameter."""
        return math.hypot(self.ahead.slope(p), self.left.slope(p))

    @cached_property
    def _cells(self) -> tuple[list[float], list[float]]:
        """The parameters at which cells begin or end, and the arc lengths there."""
        count = min(max(math.ceil(self.length_m / _CELL_M), _MIN_CELLS), _MAX_CELLS)
        last = self.length_m if self.end is None else self.end
        parameters = [last * index / count for index in range(count + 1)]
        arc_lengths_m = [0.0]
        for begin, end in itertools.pairwise(parameters):
            arc_lengths_m.append(arc_lengths_m[-1] + _integrate(self._speed, begin, end))
        return parameters, arc_lengths_m

    def _parameter(self, along_m: float) -> float:
        parameters, arc_lengths_m = self._cells
        target_m = along_m
        if self.end is not None:
            target_m *= arc_lengths_m[-1] / self.length_m
        index = min(max(bisect_right(arc_lengths_m, target_m) - 1, 0), len(parameters) - 2)
        begin, begin_m = parameters[index], arc_lengths_m[index]
        low, high = begin, parameters[index + 1]
        cell_m = arc_lengths_m[index + 1] - begin_m
        p = low + (high - low) * min(max((target_m - begin_m) / cell_m, 0.0), 1.0) if cell_m > 0.0 else low
        for _ in range(_MAX_STEPS):
            error_m = begin_m + _integrate(self._speed, begin, p) - target_m
            if abs(error_m) < _ARC_LENGTH_TOLERANCE_M:
                break
            low, high = (low, p) if error_m > 0.0 else (p, high)
            speed = self._speed(p)
            p = p - error_m / speed if speed > 1e-12 else high
            if not low <= p <= high:  # Newton's step leaves the bracket: halve it
                p = (low + high) / 2
        return p


@dataclass(frozen=True, slots=True)
class PlanElement:
    """A curve at its place in the plan view of a road, from the station `s_m` on."""

    s_m: float
    x_m: float
    y_m: float
    heading_rad: float
    curve: Clothoid | CubicCurve


class ReferencePoint(NamedTuple):
    """A point of a reference line."""

    x_m: float
    y_m: float
    heading_rad: float
    curvature_per_m: float


def element_point(element: PlanElement, s_m: float) -> ReferencePoint:
    """Return the point of an element at a station; beyond its ends, the point at the end."""
    point = element.curve.point(min(max(s_m - element.s_m, 0.0), element.curve.length_m))
    cosine, sine = math.cos(element.heading_rad), math.sin(element.heading_rad)
    return ReferencePoint(
        element.x_m + point.ahead_m * cosine - point.left_m * sine,
        element.y_m + point.ahead_m * sine + point.left_m * cosine,
        element.heading_rad + point.turn_rad,
        point.curvature_per_m,
    )


def _integrate(function: Callable[[float], float], begin: float, end: float) -> float:
    width = end - begin
    return width * sum(weight * function(begin + share * width) for share, weight in _SHARES_AND_WEIGHTS)
