"""What lies across a road: lanes, asphalt, marks, and what stops a car.

Offsets are across, from the centre of the driven lane, left positive; stations are along it, 0 at the route's start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np

from lavt.domain import FloatArray

DASH_M, GAP_M = 3.0, 6.0
"""Broken marks where a road does not say; the map of the six routes does not either, so this is our choice."""


@dataclass(frozen=True)
class Lanes:
    """The lanes of the driven direction, from the left; `driven` is the index of the one the reference runs in."""

    widths_m: tuple[float, ...]
    driven: int

    @property
    def left_edge_m(self) -> float:
        """Lateral offset of the leftmost edge."""
        return sum(self.widths_m[: self.driven]) + self.widths_m[self.driven] / 2

    @cached_property
    def edges_m(self) -> tuple[float, ...]:
        """Lateral offsets of all edges of lanes, from the right to the left."""
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
    """A painted line along the road, from one station to another; broken ones have dashes and gaps."""

    offset_m: float
    kind: Literal["solid", "broken"]
    colour: Literal["white", "yellow"]
    width_m: float
    from_m: float = -math.inf
    to_m: float = math.inf
    dash_m: float = DASH_M
    gap_m: float = GAP_M
    dash_at_m: float = 0.0
    """Where a dash begins, and so all others."""

    def dashes_m(self, first_m: float, last_m: float) -> FloatArray:
        """Stations where the whole dashes of a broken mark begin that lie between two stations and in its range."""
        first_m, last_m = max(self.from_m, first_m), min(self.to_m, last_m)
        period_m = self.dash_m + self.gap_m
        counts = np.arange(
            math.floor((first_m - self.dash_at_m) / period_m), math.ceil((last_m - self.dash_at_m) / period_m) + 1
        )
        begin = self.dash_at_m + counts * period_m
        return np.asarray(begin[(begin >= first_m) & (begin + self.dash_m <= last_m)], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Rail:
    """Something along the road that stops a car: a steel guard rail or a concrete barrier."""

    offset_m: float
    kind: Literal["rail", "barrier"]
    from_m: float = -math.inf
    to_m: float = math.inf


Along = TypeVar("Along", PavedArea, RoadMark, Rail)


def shift_stations(each: Along, by_m: float) -> Along:
    """Count stations from a place `by_m` further on."""
    return replace(each, from_m=each.from_m - by_m, to_m=each.to_m - by_m)
