"""Road-surface wear: patches, seams, cracks and sealed cracks. It is the same in every run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lavt.domain import FloatArray
from lavt.streams import stream
from lavt.vehicle.sim.road.cross_section import PavedArea
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.road.strips import Strips, join_strips, make_strips, strip_along, strip_pieces

_WORLD_SEED = 0
_PATCH_SPACING_M = 16.0
_CRACK_SPACING_M = 7.0
_SEAM_WIDTH_M = 0.03
_PATCH_SEAM_WIDTH_M = 0.05
"""The width of the seam around a patch."""
_PAVER_WIDTH_M = 3.5
"""The width of a strip that a paver lays at a time; there is a seam between two strips."""


@dataclass(frozen=True, slots=True)
class SurfaceWear:
    """Strips of one kind of wear."""

    strips: Strips
    width_m: float
    darkening: int
    """By how many grey levels the strips darken the asphalt."""


def surface_wear(road: Road) -> list[SurfaceWear]:
    """Return all wear of one road, in painting order."""
    patches, patch_seams = _patches(road)
    seams = [
        strip_along(road, offset_m + _SEAM_WIDTH_M / 2, offset_m - _SEAM_WIDTH_M / 2, strip.from_m, strip.to_m)
        for strip in road.paved
        for offset_m in np.arange(max(strip.rights_m) + _PAVER_WIDTH_M, min(strip.lefts_m) - 1.0, _PAVER_WIDTH_M)
    ]
    return [
        *(SurfaceWear(join_strips(strips), 2.0, darkening) for darkening, strips in patches.items()),
        SurfaceWear(join_strips(seams), _SEAM_WIDTH_M, 12),
        SurfaceWear(patch_seams, _PATCH_SEAM_WIDTH_M, 30),
        SurfaceWear(_cracks(road, "cracks", 0.018), 0.018, 34),
        SurfaceWear(_cracks(road, "sealed cracks", 0.07), 0.07, 26),
    ]


def _patches(road: Road) -> tuple[dict[int, list[Strips]], Strips]:
    """Return rectangular patches of newer asphalt, by darkening (grey levels), and the seams around the patches."""
    random = stream(_WORLD_SEED, "repairs")
    by_darkening: dict[int, list[Strips]] = {7: [], 12: [], 17: []}
    half_seam_m = _PATCH_SEAM_WIDTH_M / 2
    seams = []
    strips = _wearing_strips(road)
    for _ in range(int(_paved_length_m(strips) / _PATCH_SPACING_M)):
        strip, first_m, last_m = strips[int(random.integers(len(strips)))]
        begin_m = random.uniform(first_m, last_m)
        end_m = min(begin_m + random.uniform(2.0, 16.0), last_m)
        right_m = random.uniform(strip.right_m, max(strip.left_m - 2.0, strip.right_m))
        left_m = min(right_m + random.uniform(1.0, 3.4), strip.left_m)
        darkening = sorted(by_darkening)[int(random.integers(len(by_darkening)))]
        by_darkening[darkening].append(strip_along(road, left_m, right_m, begin_m, end_m))
        seams += [
            strip_along(road, edge_m + half_seam_m, edge_m - half_seam_m, begin_m, end_m)
            for edge_m in (left_m, right_m)
        ]
        ends_m = np.array([begin_m, end_m])
        seams.append(strip_pieces(road, left_m, right_m, ends_m - half_seam_m, ends_m + half_seam_m))
    return by_darkening, join_strips(seams)


def _cracks(road: Road, name: str, width_m: float) -> Strips:
    """Return cracks: random polylines along or across the road, with steps of about a third of a metre."""
    random = stream(_WORLD_SEED, name)
    cracks = []
    strips = _wearing_strips(road)
    for _ in range(int(_paved_length_m(strips) / _CRACK_SPACING_M)):
        strip, first_m, last_m = strips[int(random.integers(len(strips)))]
        steps = int(random.integers(8, 30))
        if random.uniform() < 0.5:
            ahead, left = random.uniform(0.15, 0.45, steps), random.normal(0.0, 0.10, steps)
        else:
            ahead, left = random.normal(0.0, 0.10, steps), random.uniform(0.15, 0.40, steps)
        station = random.uniform(first_m, last_m) + np.cumsum(ahead)
        offset = random.uniform(strip.right_m, strip.left_m) + np.cumsum(left)
        inside = (offset < strip.left_m) & (station > first_m) & (station < last_m)
        if inside.sum() > 2:
            cracks.append(_line(road.point_at(station[inside], offset[inside]), width_m))
    return join_strips(cracks)


def _wearing_strips(road: Road) -> list[tuple[PavedArea, float, float]]:
    """Return the strips of asphalt of constant width, each with its ends on the road."""
    return [
        (strip, max(strip.from_m, road.first_m), min(strip.to_m, road.last_m))
        for strip in road.paved
        if not strip.is_tapered
    ]


def _paved_length_m(strips: Sequence[tuple[PavedArea, float, float]]) -> float:
    """Return the sum of the lengths of strips; pieces that follow each other count like one strip."""
    return sum(last_m - first_m for _, first_m, last_m in strips)


def _line(points_m: FloatArray, width_m: float) -> Strips:
    """Create a quadrilateral of the given width along each segment of a polyline (n, 2)."""
    begin, end = points_m[:-1], points_m[1:]
    step = end - begin
    side = np.column_stack([-step[:, 1], step[:, 0]]) * (width_m / 2 / np.hypot(step[:, :1], step[:, 1:]))
    return make_strips(np.stack([begin + side, begin - side, end - side, end + side], axis=1))
