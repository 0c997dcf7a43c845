"""The centreline of a road: straight segments, arcs and clothoids joined end to end with continuous heading.

A station `s_m` is a distance along the centreline. Positions on straight segments and arcs are computed in closed form.
Positions on clothoids are integrated by the Gauss-Legendre rule, over pieces that turn by at most a radian. The error
is less than a nanometre.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lavt.domain import FloatArray

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_NODE_SHARES = (_NODES + 1) / 2
"""The nodes of the integration rule as shares of a piece's length."""

_NODE_SHARES_AND_WEIGHTS = tuple(zip(_NODE_SHARES.tolist(), (_WEIGHTS / 2).tolist(), strict=True))
"""The node shares and their weights, whose sum is 1, as plain numbers."""

_MAX_PIECE_TURN_RAD = 1.0
"""A clothoid is split into pieces that turn by at most this angle, so that the integration rule is exact enough."""

_STRAIGHT_PER_M = 1e-12
"""A line with a smaller curvature is treated as straight. Over 20 km the difference is 0.2 mm, and the radius of such a
line is too large for the computations."""

_FOOT_TOLERANCE_M = 1e-9
_MAX_FOOT_STEPS = 12
"""The foot of a point on a line is the nearest point of the line. The search for a foot on a clothoid ends with a step
shorter than the tolerance, or after `_MAX_FOOT_STEPS` steps."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A straight segment, arc or clothoid, whose curvature (left positive) is linear in the arc length."""

    length_m: float
    curvature_per_m: float
    """The curvature at the beginning."""
    end_curvature_per_m: float

    def split(self) -> list[Segment]:
        """Split a clothoid into pieces that turn by at most a radian; other segments stay whole."""
        if self.end_curvature_per_m == self.curvature_per_m:
            return [self]
        max_curvature_per_m = max(abs(self.curvature_per_m), abs(self.end_curvature_per_m))
        count = max(1, math.ceil(self.length_m * max_curvature_per_m / _MAX_PIECE_TURN_RAD))
        curvatures_per_m = np.linspace(self.curvature_per_m, self.end_curvature_per_m, count + 1).tolist()
        return [Segment(self.length_m / count, begin, end) for begin, end in itertools.pairwise(curvatures_per_m)]


class CentrelinePoints(NamedTuple):
    """Points of a centreline; each array has the shape of the array of stations."""

    x_m: FloatArray
    y_m: FloatArray
    heading_rad: FloatArray
    curvature_per_m: FloatArray


@dataclass(frozen=True, slots=True)
class _Piece:
    """A segment, or a part of a clothoid, at its place on the centreline."""

    s_m: float
    """The station of the beginning. The next four values are those at the beginning, too."""
    x_m: float
    y_m: float
    heading_rad: float
    curvature_per_m: float
    rate_per_m2: float
    """The change of curvature per metre."""

    def turn_rad(self, along_m: float) -> float:
        """Return the change of heading over the first `along_m` metres of the piece."""
        return along_m * (self.curvature_per_m + self.rate_per_m2 * along_m / 2)

    def displacement(self, along_m: float) -> tuple[float, float]:
        """Return the position at `along_m` metres of the piece, as metres ahead and to the left of its beginning."""
        if self.rate_per_m2 == 0.0:
            half_rad = self.curvature_per_m * along_m / 2
            chord_m = along_m if abs(half_rad) < 1e-9 else along_m * math.sin(half_rad) / half_rad
            return chord_m * math.cos(half_rad), chord_m * math.sin(half_rad)
        ahead_m = left_m = 0.0
        for share, weight in _NODE_SHARES_AND_WEIGHTS:
            turn_rad = self.turn_rad(share * along_m)
            ahead_m += weight * math.cos(turn_rad)
            left_m += weight * math.sin(turn_rad)
        return ahead_m * along_m, left_m * along_m


_SearchRow = tuple[float, float, float, float, float, float, float, float, float, "_Piece | None"]
"""The stations between which a piece is searched; station, x, y, heading and curvature at the piece's beginning; cosine
and sine of this heading; and the piece itself if it is a clothoid. A plain tuple is unpacked faster than a named one.
"""


class Centreline:
    """Segments joined end to end. The first one begins at station `first_m` with `pose` (x, y in m, heading in rad).

    Before the first and after the last segment the centreline is straight.
    """

    def __init__(self, first_m: float, pose: tuple[float, float, float], segments: Sequence[Segment]) -> None:
        x_m, y_m, heading_rad = pose
        self._pieces: list[_Piece] = []
        s_m = first_m
        # The straight parts beyond both ends are pieces of length 0; `sample` and `project` extend them to infinity.
        extension = Segment(0.0, 0.0, 0.0)
        for segment in (extension, *(part for whole in segments for part in whole.split()), extension):
            length_m, curvature_per_m = segment.length_m, segment.curvature_per_m
            if abs(curvature_per_m) < _STRAIGHT_PER_M:
                curvature_per_m = 0.0
            rate = (segment.end_curvature_per_m - curvature_per_m) / length_m if length_m else 0.0
            piece = _Piece(s_m, x_m, y_m, heading_rad, curvature_per_m, rate)
            self._pieces.append(piece)
            ahead_m, left_m = _rotate(*piece.displacement(length_m), -heading_rad)
            s_m += length_m
            x_m += ahead_m
            y_m += left_m
            heading_rad += piece.turn_rad(length_m)
        self.last_m = s_m
        self._begin_stations_m = [-math.inf, *(piece.s_m for piece in self._pieces[1:])]

    def sample(self, s_m: ArrayLike) -> CentrelinePoints:
        """Return the points at the stations `s_m`, an array of any shape."""
        station = np.asarray(s_m, dtype=np.float64)
        piece = self._piece_table[np.searchsorted(np.array(self._begin_stations_m), station, side="right") - 1]
        begin_m, x0_m, y0_m, heading0_rad, curvature0, rate = (piece[..., column] for column in range(6))
        along = station - begin_m
        half_turn = curvature0 * along / 2
        chord = along * np.sinc(half_turn / np.pi)
        ahead, left = chord * np.cos(half_turn), chord * np.sin(half_turn)
        clothoid = rate != 0.0
        if clothoid.any():
            node_along = along[..., None] * _NODE_SHARES
            turn = node_along * (curvature0[..., None] + rate[..., None] * node_along / 2)
            ahead = np.where(clothoid, np.cos(turn) @ _WEIGHTS / 2 * along, ahead)
            left = np.where(clothoid, np.sin(turn) @ _WEIGHTS / 2 * along, left)
        cosine, sine = np.cos(heading0_rad), np.sin(heading0_rad)
        return CentrelinePoints(
            x0_m + ahead * cosine - left * sine,
            y0_m + ahead * sine + left * cosine,
            heading0_rad + along * (curvature0 + rate * along / 2),
            curvature0 + rate * along,
        )

    def project(self, x_m: float, y_m: float, first_m: float, last_m: float) -> tuple[float, float, float, float]:
        """Project a position onto the centreline between the stations `first_m` and `last_m`.

        Returns the station (m) of the nearest point on the centreline, the position's lateral offset (m, left
        positive), and the centreline's heading (rad) and curvature (1/m) at the nearest point.
        """
        nearest = (first_m, math.inf, 0.0, 0.0)
        nearest_m = math.inf
        search_table = self._search_table
        for index in range(bisect_right(self._begin_stations_m, first_m) - 1, len(search_table)):
            begin_m, end_m, s_m, x0_m, y0_m, heading_rad, curvature_per_m, cosine, sine, piece = search_table[index]
            if begin_m > last_m:
                break
            low_m = max(first_m, begin_m) - s_m
            high_m = min(last_m, end_m) - s_m
            dx_m, dy_m = x_m - x0_m, y_m - y0_m
            ahead_m, left_m = dx_m * cosine + dy_m * sine, dy_m * cosine - dx_m * sine
            turn_rad = 0.0
            if piece is not None:
                along_m = _foot_m(piece, ahead_m, left_m, low_m, high_m)
                (foot_ahead_m, foot_left_m), turn_rad = piece.displacement(along_m), piece.turn_rad(along_m)
                ahead_m, left_m = _rotate(ahead_m - foot_ahead_m, left_m - foot_left_m, turn_rad)
                curvature_per_m += piece.rate_per_m2 * along_m
            elif curvature_per_m == 0.0:
                along_m = low_m if ahead_m < low_m else min(ahead_m, high_m)
                ahead_m -= along_m
            else:
                along_m = _arc_foot_m(ahead_m, left_m, curvature_per_m, (low_m + high_m) / 2)
                along_m = low_m if along_m < low_m else min(along_m, high_m)
                turn_rad = curvature_per_m * along_m
                turned_cosine, turned_sine = math.cos(turn_rad), math.sin(turn_rad)
                ahead_m -= turned_sine / curvature_per_m
                left_m -= (1.0 - turned_cosine) / curvature_per_m
                ahead_m, left_m = (
                    ahead_m * turned_cosine + left_m * turned_sine,
                    left_m * turned_cosine - ahead_m * turned_sine,
                )
            distance_m = math.hypot(ahead_m, left_m)
            if distance_m < nearest_m:
                nearest_m = distance_m
                nearest = (s_m + along_m, left_m, heading_rad + turn_rad, curvature_per_m)
        return nearest

    @cached_property
    def _search_table(self) -> list[_SearchRow]:
        """The values that a projection needs for each piece."""
        rows: list[_SearchRow] = []
        for begin_m, end_m, piece in zip(
            self._begin_stations_m, [*self._begin_stations_m[1:], math.inf], self._pieces, strict=True
        ):
            place = (piece.s_m, piece.x_m, piece.y_m, piece.heading_rad, piece.curvature_per_m)
            clothoid = piece if piece.rate_per_m2 else None
            rows.append((begin_m, end_m, *place, math.cos(piece.heading_rad), math.sin(piece.heading_rad), clothoid))
        return rows

    @cached_property
    def _piece_table(self) -> FloatArray:
        """A row of the six fields for each piece, (n, 6)."""
        return np.array(
            [
                (piece.s_m, piece.x_m, piece.y_m, piece.heading_rad, piece.curvature_per_m, piece.rate_per_m2)
                for piece in self._pieces
            ]
        )


def _foot_m(piece: _Piece, ahead_m: float, left_m: float, low_m: float, high_m: float) -> float:
    """Return the arc length between `low_m` and `high_m` at which a clothoid is nearest to a point.

    The point is given ahead and to the left of the clothoid's beginning.
    """
    along_m = (low_m + high_m) / 2
    for _ in range(_MAX_FOOT_STEPS):
        # Step to the foot on the clothoid's osculating circle at `along_m`; the error falls with the step's cube.
        reached_ahead_m, reached_left_m = piece.displacement(along_m)
        offset = _rotate(ahead_m - reached_ahead_m, left_m - reached_left_m, piece.turn_rad(along_m))
        step_m = _arc_foot_m(*offset, piece.curvature_per_m + piece.rate_per_m2 * along_m, 0.0)
        previous_m, along_m = along_m, min(max(along_m + step_m, low_m), high_m)
        if abs(along_m - previous_m) < _FOOT_TOLERANCE_M:
            break
    return along_m


def _arc_foot_m(ahead_m: float, left_m: float, curvature_per_m: float, middle_m: float) -> float:
    """Return the arc length at which a circle is nearest to a point.

    The point is given ahead and to the left of the arc's beginning. A further turn of the circle gives another arc
    length for the same place; the arc length nearest to `middle_m` is returned.
    """
    if abs(curvature_per_m) < _STRAIGHT_PER_M:
        return ahead_m
    sign = math.copysign(1.0, curvature_per_m)
    turn_rad = math.atan2(sign * ahead_m, sign * (1.0 / curvature_per_m - left_m))
    middle_rad = curvature_per_m * middle_m
    return (middle_rad + math.remainder(turn_rad - middle_rad, 2 * math.pi)) / curvature_per_m


def _rotate(ahead_m: float, left_m: float, turn_rad: float) -> tuple[float, float]:
    """Return the components of a vector in a frame that is turned to the left by `turn_rad`."""
    cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
    return ahead_m * cosine + left_m * sine, left_m * cosine - ahead_m * sine
