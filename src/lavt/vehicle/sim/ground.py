"""The ground seen from above, painted in square tiles on a world grid, at three scales.

A tile is a function of its place alone, so that what the camera sees does not depend on where the car has been.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lavt.domain import FloatArray, Picture
from lavt.vehicle.sim.road import Road
from lavt.vehicle.sim.textures import PERIOD_M, SCALES_M, Grey, all_textures

TILE_M = (16.0, 32.0, 64.0)
"""Edge of a tile at each scale."""

DASH_M, GAP_M = 3.0, 6.0
"""Broken marks; the map does not say how long they are, so this is our choice."""

_KEPT_TILES = (128, 512, 512)
_CHUNK_M = 8.0
_OVERLAP_M = 0.03
_GRAVEL_M = 1.6
_SUBPIXEL_BITS = 4
_PAINT = {"white": (212, 218, 216), "yellow": (62, 172, 208)}
_TRACK_PROFILE = ((1.0, 3), (0.7, 5), (0.4, 7))
"""Wheel tracks are darker than the rest of a lane: width (m) and by how many grey levels, widest first."""


@dataclass(frozen=True, slots=True)
class Strips:
    """Quadrilaterals on the ground (n, 4, 2) in metres, with bounding boxes (n, 4): low x, low y, high x, high y."""

    corners_m: FloatArray
    boxes_m: FloatArray

    def near(self, left_m: float, low_m: float, size_m: float) -> FloatArray:
        """Those that touch the square with the corner (left, low)."""
        boxes = self.boxes_m
        touch = (boxes[:, 0] <= left_m + size_m) & (boxes[:, 2] >= left_m)
        touch &= (boxes[:, 1] <= low_m + size_m) & (boxes[:, 3] >= low_m)
        return self.corners_m[touch]


class Ground:
    """Tiles of one road, painted when they are first asked for."""

    def __init__(self, road: Road) -> None:
        self._tiles: tuple[OrderedDict[tuple[int, int], Picture], ...] = tuple(OrderedDict() for _ in SCALES_M)
        self._gravel = _join(
            [_strips(road, strip.left_m + _GRAVEL_M, strip.right_m - _GRAVEL_M) for strip in road.paved]
        )
        self._asphalt = _join([_strips(road, strip.left_m, strip.right_m) for strip in road.paved])
        edges = np.array(road.lanes.edges_m)
        tracks = [centre + side for centre in (edges[1:] + edges[:-1]) / 2 for side in (-0.85, 0.85)]
        self._tracks = [
            (_join([_strips(road, at + width_m / 2, at - width_m / 2) for at in tracks]), grey)
            for width_m, grey in _TRACK_PROFILE
        ]
        self._marks = {colour: _marks(road, colour) for colour in _PAINT}

    def window(self, level: int, low: tuple[int, int], count: int) -> Picture:
        """Paint `count` x `count` tiles from the tile index `low` (x, y) on.

        Row 0 is at low y, column 0 at low x; the middle of texel i is (i + 0.5) * scale from the corner.
        """
        rows = [
            np.hstack([self._tile(level, low[0] + column, low[1] + row) for column in range(count)])
            for row in range(count)
        ]
        return np.vstack(rows)

    def _tile(self, level: int, column: int, row: int) -> Picture:
        tiles = self._tiles[level]
        tile = tiles.get((column, row))
        if tile is None:
            tile = self._paint(level, column, row)
            tiles[(column, row)] = tile
            if len(tiles) > _KEPT_TILES[level]:
                tiles.popitem(last=False)
        else:
            tiles.move_to_end((column, row))
        return tile

    def _paint(self, level: int, column: int, row: int) -> Picture:
        size_m, scale_m = TILE_M[level], SCALES_M[level]
        left_m, low_m = column * size_m, row * size_m
        pixels = round(size_m / scale_m)
        textures = all_textures()[level]

        def surface(texture: Picture) -> Picture:
            period = round(PERIOD_M / scale_m)
            rows = (np.arange(pixels) + row * pixels) % period
            columns = (np.arange(pixels) + column * pixels) % period
            return texture[rows[:, None], columns]

        def mask(strips: Strips) -> Grey | None:
            return _filled(strips.near(left_m, low_m, size_m), (left_m, low_m), scale_m, pixels)

        picture = _mottled(surface(textures.grass), left_m, low_m, size_m)
        gravel = mask(self._gravel)
        if gravel is None:
            return picture
        picture = _blend(picture, surface(textures.gravel), gravel)
        asphalt = mask(self._asphalt)
        if asphalt is None:
            return picture
        grey = surface(textures.asphalt)
        shade = np.zeros_like(grey)
        for strips, depth in self._tracks:
            _fill(shade, strips.near(left_m, low_m, size_m), (left_m, low_m), scale_m, depth)
        grey = np.asarray(cv2.subtract(grey, shade), dtype=np.uint8)
        picture = _blend(picture, np.dstack([grey, grey, grey - 2]), asphalt)
        wear = surface(textures.wear)
        for colour, strips in self._marks.items():
            paint = mask(strips)
            if paint is not None:
                # A mark thinner than a texel is still drawn about one texel wide: let as much of the road through.
                thinness = min(1.0, 1.3 * 0.125 / scale_m)
                alpha = np.asarray(cv2.multiply(paint, wear, scale=thinness / 255), dtype=np.uint8)
                picture = _blend(picture, np.full_like(picture, _PAINT[colour]), alpha)
        return picture


def _strips(road: Road, left_m: float, right_m: float, from_m: float = -np.inf, to_m: float = np.inf) -> Strips:
    """Lay a strip along the road between two lateral offsets, cut into short pieces."""
    first_m, last_m = max(from_m, road.first_m), min(to_m, road.last_m)
    cuts = np.linspace(first_m, last_m, max(2, round((last_m - first_m) / _CHUNK_M * 4) + 1))
    return _pieces(road, left_m, right_m, cuts[:-1], cuts[1:] + _OVERLAP_M)


def _pieces(road: Road, left_m: float, right_m: float, begin_m: FloatArray, end_m: FloatArray) -> Strips:
    corners = np.stack(
        [
            road.across(begin_m, left_m),
            road.across(begin_m, right_m),
            road.across(end_m, right_m),
            road.across(end_m, left_m),
        ],
        axis=1,
    )
    return Strips(corners, np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1))


def _join(strips: Sequence[Strips]) -> Strips:
    return Strips(
        np.concatenate([strip.corners_m for strip in strips]), np.concatenate([strip.boxes_m for strip in strips])
    )


def _marks(road: Road, colour: str) -> Strips:
    found = []
    for mark in road.marks:
        if mark.colour != colour:
            continue
        left_m, right_m = mark.offset_m + mark.width_m / 2, mark.offset_m - mark.width_m / 2
        if mark.kind == "solid":
            found.append(_strips(road, left_m, right_m, mark.from_m, mark.to_m))
            continue
        first_m, last_m = max(mark.from_m, road.first_m), min(mark.to_m, road.last_m)
        period_m = DASH_M + GAP_M
        begin = np.arange(np.floor(first_m / period_m), np.ceil(last_m / period_m)) * period_m
        begin = begin[(begin >= first_m) & (begin + DASH_M <= last_m)]
        # Two halves a dash, so that it bends with the road.
        halves = np.concatenate([begin, begin + DASH_M / 2])
        found.append(_pieces(road, left_m, right_m, halves, halves + DASH_M / 2 + _OVERLAP_M))
    return _join(found) if found else Strips(np.empty((0, 4, 2)), np.empty((0, 4)))


def _filled(corners_m: FloatArray, low_m: tuple[float, float], scale_m: float, pixels: int) -> Grey | None:
    """Make a mask of the quadrilaterals, None when there are none."""
    if not len(corners_m):
        return None
    mask = np.zeros((pixels, pixels), dtype=np.uint8)
    _fill(mask, corners_m, low_m, scale_m, 255)
    return mask


def _fill(mask: Grey, corners_m: FloatArray, low_m: tuple[float, float], scale_m: float, value: int) -> None:
    corners_px = (corners_m - np.array(low_m)) / scale_m - 0.5
    for polygon in np.rint(corners_px * (1 << _SUBPIXEL_BITS)).astype(np.int32):
        cv2.fillConvexPoly(mask, polygon, (value,), lineType=cv2.LINE_AA, shift=_SUBPIXEL_BITS)


def _blend(under: Picture, over: Picture, alpha: Grey) -> Picture:
    if alpha.min() == 255:
        return over
    weight = alpha.astype(np.uint16)[..., None]
    weight += weight >> 7  # 255 becomes 256, so that full paint is full
    return ((over * weight + under * (256 - weight)) >> 8).astype(np.uint8)


def _mottled(grass: Picture, left_m: float, low_m: float, size_m: float) -> Picture:
    """Large patches in the grass, of lengths that do not fit its period, so that the eye does not see it repeat."""
    count = 32
    x_m = left_m + (np.arange(count) + 0.5) * size_m / count
    y_m = (low_m + (np.arange(count) + 0.5) * size_m / count)[:, None]
    light = 1.0 + 0.06 * np.sin(0.071 * x_m + 0.113 * y_m) + 0.05 * np.sin(0.157 * x_m - 0.093 * y_m + 1.0)
    fine = np.asarray(cv2.resize(light.astype(np.float32), grass.shape[1::-1], interpolation=cv2.INTER_LINEAR))
    return np.asarray(np.clip(grass * fine[..., None], 0, 255), dtype=np.uint8)
