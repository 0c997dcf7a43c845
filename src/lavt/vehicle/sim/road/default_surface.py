"""The asphalt and the marks of a road whose file names none: both follow the lanes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Literal

from lavt.vehicle.sim.road.cross_section import Lanes, PavedArea, RoadMark


def default_paved(lanes: Lanes, left_shoulder_m: float, right_shoulder_m: float) -> tuple[PavedArea, ...]:
    """Return asphalt under all lanes and their shoulders."""
    strips = []
    for from_m, to_m, edges_m, to_edges_m in _linear_pieces(lanes):
        left_m, to_left_m = edges_m[-1] + left_shoulder_m, to_edges_m[-1] + left_shoulder_m
        right_m, to_right_m = edges_m[0] - right_shoulder_m, to_edges_m[0] - right_shoulder_m
        strips.append(
            PavedArea(left_m, right_m, from_m, to_m, _if_other(to_left_m, left_m), _if_other(to_right_m, right_m))
        )
    return tuple(strips)


def default_marks(lanes: Lanes, width_m: float) -> tuple[RoadMark, ...]:
    """Return white marks: solid at both outer edges, broken between lanes; none beside a lane without width."""
    marks = []
    for from_m, to_m, edges_m, to_edges_m in _linear_pieces(lanes):
        ends_m = list(zip(edges_m, to_edges_m, strict=True))
        solid = (ends_m[0], ends_m[-1])
        for edge_m, to_edge_m in dict.fromkeys(ends_m):  # edges that coincide get one mark
            kind: Literal["solid", "broken"] = "solid" if (edge_m, to_edge_m) in solid else "broken"
            to_offset_m = _if_other(to_edge_m, edge_m)
            marks.append(RoadMark(edge_m, kind, "white", width_m, from_m, to_m, to_offset_m=to_offset_m))
    return tuple(marks)


def _linear_pieces(lanes: Lanes) -> Iterator[tuple[float, float, tuple[float, ...], tuple[float, ...]]]:
    """Yield the ends of pieces along which all widths are linear, and the edges at these ends."""
    ends_m = [-math.inf, *dict.fromkeys(lanes.knots_m), math.inf]
    for from_m, to_m in itertools.pairwise(ends_m):
        yield from_m, to_m, lanes.edges_at(from_m), lanes.edges_at(to_m)


def _if_other(value_m: float, than_m: float) -> float | None:
    return None if value_m == than_m else value_m
