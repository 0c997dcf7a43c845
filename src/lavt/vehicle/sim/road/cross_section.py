"""The cross-section of a road: lanes, asphalt, marks, rails and barriers.

Offsets are lateral distances from the centre of the driven lane, left positive. Stations are distances along this
centre, 0 at the route's start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np

from lavt.domain import FloatArray

DASH_M, GAP_M = 3.0, 6.0
"""Default lengths of a dash and a gap of broken marks: our choice, because the map of the six routes has none."""


@dataclass(frozen=True)
class Lanes:
    """The lanes of the driven direction."""

    widths_m: tuple[float, ...]
    """The widths of the lanes, the leftmost first."""
    driven: int
    """The index of the driven lane."""

    @property
    def left_edge_m(self) -> float:
        """The lateral offset of the leftmost lane's left edge."""
        return sum(self.widths_m[: self.driven]) + self.widths_m[self.driven] / 2

    @cached_property
    def edges_m(self) -> tuple[float, ...]:
        """The lateral offsets of all lane edges, the rightmost first."""
        edges = [self.left_edge_m]
        for width_m in self.widths_m:
            edges.append(edges[-1] - width_m)
        return tuple(reversed(edges))


@dataclass(frozen=True, slots=True)
class PavedArea:
    """A strip of asphalt, between two lateral offsets and two stations."""

    left_m: float
    right_m: float
    from_m: float = -math.inf
    to_m: float = math.inf


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


RoadElement = TypeVar("RoadElement", PavedArea, RoadMark, Rail)


def shift_stations(element: RoadElement, by_m: float) -> RoadElement:
    """Return `element` with stations that are counted from the station `by_m` instead of 0."""
    return replace(element, from_m=element.from_m - by_m, to_m=element.to_m - by_m)
