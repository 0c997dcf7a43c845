"""Quadrilaterals on the ground, along a road or elsewhere, and their rasterisation in a square of ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray
from lavt.vehicle.sim.road.cross_section import Lanes, PavedArea, RoadMark
from lavt.vehicle.sim.road.road import Road

Offset = float | FloatArray | Callable[[FloatArray], FloatArray]
"""A lateral offset: a number, an array (n,), or a function of stations (n,)."""

Grey = NDArray[np.uint8]
"""Grey levels or the values of a mask, 0 to 255, (rows, columns)."""

OVERLAP_M = 0.03
"""The length by which a piece overlaps the next piece, so that no gap is visible."""

MAX_PIECE_M = 2.0
"""The longest straight piece of a strip that follows the road."""

_SUBPIXEL_BITS = 4


@dataclass(frozen=True, slots=True)
class Square:
    """A square of ground."""

    left_m: float
    """x of the left edge, in the world frame."""
    low_m: float
    """y of the lower edge, in the world frame."""
    edge_m: float
    """Length of an edge."""
    scale_m: float
    """Metres per texel."""

    @property
    def pixels(self) -> int:
        """The number of texels along an edge."""
        return round(self.edge_m / self.scale_m)


@dataclass(frozen=True, slots=True)
class Strips:
    """Convex quadrilaterals on the ground."""

    corners_m: FloatArray
    """The corners in the world frame, (n, 4, 2)."""
    boxes_m: FloatArray
    """The bounding boxes, (n, 4): low x, low y, high x, high y."""

    def fill(self, mask: Grey, square: Square, value: int) -> bool:
        """Paint `value` into the mask of a square where strips are; return False if no strip is near the square."""
        low_x_m, low_y_m, high_x_m, high_y_m = self.boxes_m.T
        overlapping = (low_x_m <= square.left_m + square.edge_m) & (high_x_m >= square.left_m)
        overlapping &= (low_y_m <= square.low_m + square.edge_m) & (high_y_m >= square.low_m)
        near = self.corners_m[overlapping]
        corners_px = (near - np.array([square.left_m, square.low_m])) / square.scale_m - 0.5
        for polygon in np.rint(corners_px * (1 << _SUBPIXEL_BITS)).astype(np.int32):
            cv2.fillConvexPoly(mask, polygon, (value,), lineType=cv2.LINE_AA, shift=_SUBPIXEL_BITS)
        return len(near) > 0

    def mask(self, square: Square) -> Grey | None:
        """Return a mask of the strips in a square; None if there are none."""
        mask = np.zeros((square.pixels, square.pixels), dtype=np.uint8)
        return mask if self.fill(mask, square, 255) and mask.any() else None


def make_strips(corners_m: FloatArray) -> Strips:
    """Create strips from corners (n, 4, 2)."""
    return Strips(corners_m, np.concatenate([corners_m.min(axis=1), corners_m.max(axis=1)], axis=1))


def join_strips(parts: Sequence[Strips]) -> Strips:
    """Return all strips together."""
    return make_strips(np.concatenate([np.empty((0, 4, 2)), *(part.corners_m for part in parts)]))


def strip_along(road: Road, left_m: Offset, right_m: Offset, from_m: float = -np.inf, to_m: float = np.inf) -> Strips:
    """Create a strip along the road between two lateral offsets, divided into short pieces."""
    first_m, last_m = max(from_m, road.first_m), min(to_m, road.last_m)
    ends_m = np.linspace(first_m, last_m, max(2, round((last_m - first_m) / MAX_PIECE_M) + 1))
    return strip_pieces(road, left_m, right_m, ends_m[:-1], ends_m[1:] + OVERLAP_M)


def strip_pieces(road: Road, left_m: Offset, right_m: Offset, begin_m: FloatArray, end_m: FloatArray) -> Strips:
    """Create n quadrilaterals between two lateral offsets, from the stations `begin_m` (n,) to `end_m` (n,)."""
    corners = [(begin_m, left_m), (begin_m, right_m), (end_m, right_m), (end_m, left_m)]
    points = [road.point_at(s_m, offset_m(s_m) if callable(offset_m) else offset_m) for s_m, offset_m in corners]
    return make_strips(np.stack(points, axis=1))


def widen(strip: PavedArea, margin_m: float) -> tuple[Offset, Offset]:
    """Return the left and the right edge of a strip of asphalt that is wider by a margin on both sides."""
    if not strip.is_tapered:
        return strip.left_m + margin_m, strip.right_m - margin_m
    return lambda s_m: strip.left_at(s_m) + margin_m, lambda s_m: strip.right_at(s_m) - margin_m


def across_mark(mark: RoadMark) -> tuple[Offset, Offset]:
    """Return the left and the right edge of a mark."""
    half_m = mark.width_m / 2
    if mark.to_offset_m is None:
        return mark.offset_m + half_m, mark.offset_m - half_m
    return lambda s_m: mark.offset_at(s_m) + half_m, lambda s_m: mark.offset_at(s_m) - half_m


def beside_lane(lanes: Lanes, lane: int, from_centre_m: float, width_m: float) -> tuple[Offset, Offset]:
    """Return the edges of a band along a lane, `from_centre_m` to the left of its centre; lane 0 is the rightmost.

    Where the lane is narrower than the driven lane is at the beginning, the band is narrower and nearer to the centre.
    """
    if not lanes.changes:
        centre_m = (lanes.edges_at(0.0)[lane + 1] + lanes.edges_at(0.0)[lane]) / 2 + from_centre_m
        return centre_m + width_m / 2, centre_m - width_m / 2
    full_m = lanes.widths_m[lanes.driven]

    def edge(side: float) -> Callable[[FloatArray], FloatArray]:
        def offset_m(s_m: FloatArray) -> FloatArray:
            right_m, left_m = lanes.edges_along(s_m)[lane : lane + 2]
            share = np.minimum((left_m - right_m) / full_m, 1.0)
            return np.asarray((left_m + right_m) / 2 + share * (from_centre_m + side * width_m / 2))

        return offset_m

    return edge(1.0), edge(-1.0)
