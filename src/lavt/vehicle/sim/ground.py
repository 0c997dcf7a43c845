"""The ground seen from above, painted in square tiles on a world grid, at three scales.

A tile is a function of its place alone, so that what the camera sees does not depend on where the car has been.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray, Picture
from lavt.vehicle.sim.road import Road
from lavt.vehicle.sim.textures import SCALES_M, Grey, all_textures

TILE_M = (16.0, 32.0, 64.0)
"""Edge of a tile at each scale."""

_MARK_M = 0.125
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
            [
                _strips(road, strip.left_m + _GRAVEL_M, strip.right_m - _GRAVEL_M, strip.from_m, strip.to_m)
                for strip in road.paved
            ]
        )
        self._asphalt = _join(
            [_strips(road, strip.left_m, strip.right_m, strip.from_m, strip.to_m) for strip in road.paved]
        )
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
        place = _Place(level, column * TILE_M[level], row * TILE_M[level])
        textures = all_textures()[level]
        asphalt = place.mask(self._asphalt)
        if asphalt is None or asphalt.min() < 255:
            picture = _mottled(place.surface(textures.grass), place)
            gravel = place.mask(self._gravel)
            if gravel is not None:
                picture = _blend(picture, place.surface(textures.gravel), gravel)
        if asphalt is None:
            return picture
        shade = np.zeros_like(asphalt)
        for strips, depth in self._tracks:
            place.fill(shade, strips, depth)
        grey = np.asarray(cv2.subtract(place.surface(textures.asphalt), shade), dtype=np.uint8)
        road = np.dstack([grey, grey, grey - 2])
        picture = road if asphalt.min() == 255 else _blend(picture, road, asphalt)
        # A mark thinner than a texel is still drawn about one texel wide: let as much of the road through.
        thinness = min(1.0, _MARK_M * 1.3 / SCALES_M[level])
        for colour, strips in self._marks.items():
            paint = place.mask(strips)
            if paint is not None:
                wear = place.surface(textures.wear)
                alpha = np.asarray(cv2.multiply(paint, wear, scale=thinness / 255), dtype=np.uint8)
                picture = _blend(picture, np.array(_PAINT[colour], dtype=np.uint8), alpha)
        return picture


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a tile is: its scale and its corner."""

    level: int
    left_m: float
    low_m: float

    @property
    def pixels(self) -> int:
        return round(TILE_M[self.level] / SCALES_M[self.level])

    def surface(self, texture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Cut the tile's part of a pattern; a period is a whole number of tiles or a tile one of periods."""
        pixels, period = self.pixels, len(texture)
        if pixels > period:
            count = pixels // period
            return np.tile(texture, (count, count, 1)[: texture.ndim])
        row = round(self.low_m / SCALES_M[self.level]) % period
        column = round(self.left_m / SCALES_M[self.level]) % period
        return texture[row : row + pixels, column : column + pixels]

    def mask(self, strips: Strips) -> Grey | None:
        """Make a mask of the strips; None when none is in the tile."""
        mask = np.zeros((self.pixels, self.pixels), dtype=np.uint8)
        self.fill(mask, strips, 255)
        return mask if mask.any() else None

    def fill(self, mask: Grey, strips: Strips, value: int) -> None:
        """Paint the strips into `mask`."""
        corners_m = strips.near(self.left_m, self.low_m, TILE_M[self.level])
        corners_px = (corners_m - np.array([self.left_m, self.low_m])) / SCALES_M[self.level] - 0.5
        for polygon in np.rint(corners_px * (1 << _SUBPIXEL_BITS)).astype(np.int32):
            cv2.fillConvexPoly(mask, polygon, (value,), lineType=cv2.LINE_AA, shift=_SUBPIXEL_BITS)


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
        begin = mark.dashes_m(road.first_m, road.last_m)
        # Two halves a dash, so that it bends with the road.
        halves = np.concatenate([begin, begin + mark.dash_m / 2])
        found.append(_pieces(road, left_m, right_m, halves, halves + mark.dash_m / 2 + _OVERLAP_M))
    return _join(found) if found else Strips(np.empty((0, 4, 2)), np.empty((0, 4)))


def _blend(under: Picture, over: Picture, alpha: Grey) -> Picture:
    """Lay `over`, a picture or one colour, over `under`."""
    weight = alpha.astype(np.uint16)[..., None]
    weight += weight >> 7  # 255 becomes 256, so that full paint is full
    mixed = over * weight
    mixed += under * (256 - weight)
    mixed >>= 8
    return mixed.astype(np.uint8)


def _mottled(grass: Picture, place: _Place) -> Picture:
    """Lay large patches over the grass, of lengths that do not fit its period: the eye must not see it repeat."""
    count = 32
    middle_m = (np.arange(count) + 0.5) * TILE_M[place.level] / count
    x_m, y_m = place.left_m + middle_m, (place.low_m + middle_m)[:, None]
    light = 1.0 + 0.06 * np.sin(0.071 * x_m + 0.113 * y_m) + 0.05 * np.sin(0.157 * x_m - 0.093 * y_m + 1.0)
    fine = np.asarray(cv2.resize(light.astype(np.float32), grass.shape[1::-1], interpolation=cv2.INTER_LINEAR))
    return np.asarray(np.clip(grass * fine[..., None], 0, 255), dtype=np.uint8)
