"""The cross-section of a road: lanes, asphalt, marks, rails and barriers.

Offsets are lateral distances from the centre of the driven lane, left positive. Stations are distances along this
centre, 0 at the route's start.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from lavt.domain import FloatArray

DASH_M, GAP_M = 3.0, 6.0
"""Default lengths of a dash and a gap of broken marks: our choice, because the map of the six routes has none."""


@dataclass(frozen=True, slots=True)
class WidthChange:
    """A part of a road along which the widths of lanes change linearly."""

    from_m: float
    to_m: float
    widths_m: tuple[float, ...]
    """The widths at `to_m` and beyond, the leftmost lane first."""


@dataclass(frozen=True)
class Lanes:
    """The lanes of the driven direction."""

    widths_m: tuple[float, ...]
    """The widths of the lanes before any change, the leftmost first."""
    driven: int
    """The index of the driven lane."""
    changes: tuple[WidthChange, ...] = ()
    """Changes of the widths, in the order of stations."""

    @cached_property
    def knots_m(self) -> tuple[float, ...]:
        """The stations between which all widths are linear; before the first and after the last they are constant."""
        return tuple(station_m for change in self.changes for station_m in (change.from_m, change.to_m))

    @cached_property
    def _knot_edges_m(self) -> tuple[tuple[float, ...], ...]:
        """The edges at each knot; without changes, the only ones."""
        rows = [self.widths_m]
        for change in self.changes:
            rows += [rows[-1], change.widths_m]
        return tuple(_edges_m(widths_m, self.driven) for widths_m in rows[1:] or rows)

    def edges_at(self, s_m: float) -> tuple[float, ...]:
        """Return the lateral offsets of all lane edges at a station, the rightmost first."""
        knots_m, rows = self.knots_m, self._knot_edges_m
        if len(rows) == 1 or s_m <= knots_m[0]:
            return rows[0]
        index = bisect_right(knots_m, s_m)
        if index == len(knots_m):
            return rows[-1]
        share = (s_m - knots_m[index - 1]) / (knots_m[index] - knots_m[index - 1])
        return tuple([a_m + share * (b_m - a_m) for a_m, b_m in zip(rows[index - 1], rows[index], strict=True)])

    def edges_along(self, s_m: FloatArray) -> FloatArray:
        """Return the lateral offsets of all lane edges at stations (n,), the rightmost edge first: (edges, n)."""
        knots_m = self.knots_m or (0.0,)
        return np.stack([np.interp(s_m, knots_m, offsets_m) for offsets_m in zip(*self._knot_edges_m, strict=True)])

    def driven_width_at(self, s_m: float) -> float:
        """Return the width of the driven lane at a station."""
        if not self.changes:
            return self.widths_m[self.driven]
        edges_m = self.edges_at(s_m)
        return edges_m[-1 - self.driven] - edges_m[-2 - self.driven]

    @property
    def max_slope(self) -> float:
        """The largest change of an edge's offset per metre."""
        rows = self._knot_edges_m
        return max(
            (
                max(abs(b_m - a_m) for a_m, b_m in zip(rows[2 * index], rows[2 * index + 1], strict=True))
                / (change.to_m - change.from_m)
                for index, change in enumerate(self.changes)
            ),
            default=0.0,
        )

    def shifted(self, by_m: float) -> Lanes:
        """Return the lanes with stations that are counted from the station `by_m` instead of 0."""
        return replace(self, changes=tuple(shift_stations(change, by_m) for change in self.changes))


def _edges_m(widths_m: tuple[float, ...], driven: int) -> tuple[float, ...]:
    edges = [sum(widths_m[:driven]) + widths_m[driven] / 2]
    for width_m in widths_m:
        edges.append(edges[-1] - width_m)
    return tuple(reversed(edges))


@dataclass(frozen=True, slots=True)
class PavedArea:
    """A strip of asphalt, between two lateral offsets and two stations."""

    left_m: float
    right_m: float
    from_m: float = -math.inf
    to_m: float = math.inf
    to_left_m: float | None = None
    """The offset of the left edge at `to_m`, to which it changes linearly; None if it is constant."""
    to_right_m: float | None = None
    """The same of the right edge."""

    def left_at(self, s_m: ArrayLike) -> FloatArray:
        """Return the offsets of the left edge at stations; beyond the strip's ends, those of the ends."""
        return _linear(self, self.left_m, self.to_left_m, s_m)

    def right_at(self, s_m: ArrayLike) -> FloatArray:
        """Return the offsets of the right edge at stations; beyond the strip's ends, those of the ends."""
        return _linear(self, self.right_m, self.to_right_m, s_m)

    @property
    def is_tapered(self) -> bool:
        """Whether the offset of an edge changes."""
        return self.to_left_m is not None or self.to_right_m is not None

    def contains(self, s_m: float, offset_m: float) -> bool:
        """Return whether a point is on the strip."""
        if not self.from_m <= s_m <= self.to_m:
            return False
        if self.is_tapered:
            return float(self.right_at(s_m)) <= offset_m <= float(self.left_at(s_m))
        return self.right_m <= offset_m <= self.left_m

    @property
    def lefts_m(self) -> tuple[float, float]:
        """The offsets of the left edge at both ends."""
        return self.left_m, self.left_m if self.to_left_m is None else self.to_left_m

    @property
    def rights_m(self) -> tuple[float, float]:
        """The offsets of the right edge at both ends."""
        return self.right_m, self.right_m if self.to_right_m is None else self.to_right_m

    @property
    def max_slope(self) -> float:
        """The largest change of an edge's offset per metre."""
        change_m = max(abs(begin_m - end_m) for begin_m, end_m in (self.lefts_m, self.rights_m))
        return change_m / (self.to_m - self.from_m)


@dataclass(frozen=True, slots=True)
class RoadMark:
    """A painted line along the road between two stations; a broken mark has dashes and gaps."""

    offset_m: float
    kind: Literal["solid", "broken"]
    colour: Literal["white", "yellow"]
    width_m: float
    from_m: float = -math.inf
    to_m: float = math.inf
    dash_m: float = DASH_M
    gap_m: float = GAP_M
    dash_at_m: float = 0.0
    """A station where a dash begins, which fixes all other dashes."""
    to_offset_m: float | None = None
    """The offset at `to_m`, to which it changes linearly; None if it is constant."""

    def offset_at(self, s_m: ArrayLike) -> FloatArray:
        """Return the offsets at stations; beyond the mark's ends, those of the ends."""
        return _linear(self, self.offset_m, self.to_offset_m, s_m)

    @property
    def offsets_m(self) -> tuple[float, float]:
        """The offsets at both ends."""
        return self.offset_m, self.offset_m if self.to_offset_m is None else self.to_offset_m

    def dash_begins_m(self, first_m: float, last_m: float) -> FloatArray:
        """Return the stations where dashes begin, for dashes that lie wholly in the mark and between two stations."""
        first_m, last_m = max(self.from_m, first_m), min(self.to_m, last_m)
        period_m = self.dash_m + self.gap_m
        indices = np.arange(
            math.floor((first_m - self.dash_at_m) / period_m), math.ceil((last_m - self.dash_at_m) / period_m) + 1
        )
        begin_m = self.dash_at_m + indices * period_m
        return np.asarray(begin_m[(begin_m >= first_m) & (begin_m + self.dash_m <= last_m)], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Rail:
    """An obstacle along the road that stops a car: a steel guard rail or a concrete barrier."""

    offset_m: float
    kind: Literal["rail", "barrier"]
    from_m: float = -math.inf
    to_m: float = math.inf


def _linear(element: PavedArea | RoadMark, begin: float, end: float | None, s_m: ArrayLike) -> FloatArray:
    """Return values that change linearly between the ends of an element."""
    if end is None:
        return np.full(np.shape(s_m), begin)
    share = np.clip((np.asarray(s_m) - element.from_m) / (element.to_m - element.from_m), 0.0, 1.0)
    return np.asarray(begin + share * (end - begin), dtype=np.float64)


RoadElement = TypeVar("RoadElement", PavedArea, RoadMark, Rail, WidthChange)


def shift_stations(element: RoadElement, by_m: float) -> RoadElement:
    """Return `element` with stations that are counted from the station `by_m` instead of 0."""
    return replace(element, from_m=element.from_m - by_m, to_m=element.to_m - by_m)
