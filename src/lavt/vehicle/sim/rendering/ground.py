"""The ground from above, painted in square tiles on a world grid, at five scales, with light and shadows.

A tile depends on its position alone, so pictures do not depend on what the car did before.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from functools import lru_cache

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from lavt.domain import FloatArray, Picture
from lavt.vehicle.sim.rendering.light import Light
from lavt.vehicle.sim.rendering.shadows import Shadows
from lavt.vehicle.sim.rendering.surface_wear import surface_wear
from lavt.vehicle.sim.rendering.textures import SCALES_M, all_textures
from lavt.vehicle.sim.rendering.weather import WEATHERS, Weather, worn_paint
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.road.strips import (
    MAX_PIECE_M,
    OVERLAP_M,
    Grey,
    Square,
    Strips,
    across_mark,
    beside_lane,
    join_strips,
    strip_along,
    strip_pieces,
    widen,
)

TILE_M = (8.0, 16.0, 32.0, 32.0, 64.0)
"""The length of a tile's edge at each scale."""

_MAX_TILES = (300, 160, 160, 400, 400)
"""The number of cached tiles of each scale. Tiles of the two finest scales are painted during the drive, a few at a
time. All tiles along a route of 600 m fit into the cache, so the next run on the same route needs no new ones."""

_GRAVEL_WIDTH_M = 1.6
_PAINT = {"white": (212, 218, 216), "yellow": (62, 172, 208)}
_TRACK_PROFILE = ((1.1, 4), (0.8, 8), (0.5, 12))
"""Wheel tracks, which are darker than the rest of a lane: width (m) and darkening (grey levels), widest first."""
_OIL = (0.7, 6)
"""The middle of a lane, which oil makes darker: width (m) and darkening (grey levels)."""


class Ground:
    """The tiles of one road in one light and weather, painted on first use."""

    def __init__(self, road: Road, light: Light, shadows: Shadows | None, weather: Weather = WEATHERS["clear"]) -> None:
        self._weather = weather
        self._tiles: tuple[OrderedDict[tuple[int, int], Picture], ...] = tuple(OrderedDict() for _ in SCALES_M)
        # Both in 255ths: the light on a surface in the sun, and the share of this light that is missing in full shadow.
        self._sunlight = _bytes(np.array(light.lit))
        self._missing_in_shadow = _bytes(1.0 - np.array(light.shade) / np.array(light.lit))
        self._shadows = shadows
        self._gravel, self._asphalt = (
            join_strips([strip_along(road, *widen(strip, margin_m), strip.from_m, strip.to_m) for strip in road.paved])
            for margin_m in (_GRAVEL_WIDTH_M, 0.0)
        )
        self._tracks = _tracks(road)
        self._wear = surface_wear(road)
        self._marks = [(colour, width_m, _marks(road, colour, width_m)) for colour, width_m in _mark_styles(road)]

    def assemble(self, level: int, first_tile: tuple[int, int], count: int) -> Picture:
        """Return a picture of `count` x `count` tiles, the first of which has the index `first_tile` (x, y).

        Row 0 has the lowest y and column 0 the lowest x. The middle of texel i is at (i + 0.5) * scale from the corner.
        The picture has an unused fourth channel, because OpenCV warps texels of four bytes in less than half the time
        that texels of three bytes take. On a wet road it has the share of asphalt.
        """
        pixels = round(TILE_M[level] / SCALES_M[level])
        assembled = np.empty((count * pixels, count * pixels, 4), dtype=np.uint8)
        for row in range(count):
            for column in range(count):
                tile = self.tile(level, first_tile[0] + column, first_tile[1] + row)
                part = np.s_[row * pixels : (row + 1) * pixels, column * pixels : (column + 1) * pixels]
                cv2.cvtColor(tile, cv2.COLOR_BGR2BGRA, assembled[part])
                if self._weather.film:
                    corner = (first_tile[0] + column, first_tile[1] + row)
                    asphalt = self._asphalt.mask(_square(level, *corner))
                    assembled[part][..., 3] = 0 if asphalt is None else asphalt
        return assembled

    def has_room(self, level: int) -> bool:
        """Return whether the cache can take one more tile of a scale without removing another."""
        return len(self._tiles[level]) < _MAX_TILES[level]

    def tile(self, level: int, column: int, row: int) -> Picture:
        """Return one tile; paint it unless it is cached."""
        tiles = self._tiles[level]
        tile = tiles.get((column, row))
        if tile is None:
            tile = self._paint(level, _square(level, column, row))
            tiles[(column, row)] = tile
            if len(tiles) > _MAX_TILES[level]:
                tiles.popitem(last=False)
        else:
            tiles.move_to_end((column, row))
        return tile

    def _paint(self, level: int, square: Square) -> Picture:
        asphalt = self._asphalt.mask(square)
        if asphalt is None:
            picture = self._paint_verge(level, square)
        elif asphalt.min() == 255:
            picture = self._paint_asphalt(level, square)
        else:
            picture = _blend(self._paint_verge(level, square), self._paint_asphalt(level, square), asphalt)
        shade = None if self._shadows is None else self._shadows.mask(square)
        sunlit = _multiply_colour(picture, self._sunlight)
        if shade is None:
            return sunlit
        missing_share = _multiply_colour(cv2.merge((shade, shade, shade)), self._missing_in_shadow)
        return np.asarray(cv2.subtract(sunlit, cv2.multiply(sunlit, missing_share, scale=1 / 255)), dtype=np.uint8)

    def _paint_verge(self, level: int, square: Square) -> Picture:
        textures = all_textures()[level]
        grass = _mottle(_crop_texture(textures.grass, square), square)
        gravel = self._gravel.mask(square)
        return grass if gravel is None else _blend(grass, _crop_texture(textures.gravel, square), gravel)

    def _paint_asphalt(self, level: int, square: Square) -> Picture:
        textures, scale_m = all_textures()[level], SCALES_M[level]
        darkening = np.zeros((square.pixels, square.pixels), dtype=np.uint8)
        for strips, grey_levels in self._tracks:
            strips.fill(darkening, square, grey_levels)
        for wear in self._wear:
            # Strips that are thinner than a texel are drawn about one texel wide, so reduce their darkening.
            grey_levels = round(wear.darkening * min(1.0, wear.width_m / scale_m))
            if grey_levels:
                wear.strips.fill(darkening, square, grey_levels)
        worn = np.asarray(cv2.subtract(_crop_texture(textures.asphalt, square), darkening), dtype=np.uint8)
        if self._weather.asphalt != 1.0:
            worn = np.asarray(cv2.convertScaleAbs(worn, alpha=self._weather.asphalt), dtype=np.uint8)
        picture = np.asarray(cv2.merge((worn, worn, worn - 2)), dtype=np.uint8)
        for colour, width_m, strips in self._marks:
            paint = strips.mask(square)
            if paint is not None:
                thinness = min(1.0, width_m * 1.3 / scale_m)
                alpha = np.asarray(
                    cv2.multiply(paint, _crop_texture(textures.wear, square), scale=thinness / 255), np.uint8
                )
                if self._weather.paint_left < 1.0:
                    left = _crop_texture(worn_paint(self._weather.paint_left)[level], square)
                    alpha = np.asarray(cv2.multiply(alpha, left, scale=1 / 255), np.uint8)
                cover = cv2.merge((alpha, alpha, alpha))
                kept = cv2.multiply(picture, cv2.bitwise_not(cover), scale=1 / 255)
                picture = np.asarray(cv2.add(kept, _multiply_colour(cover, _PAINT[colour])), dtype=np.uint8)
        return picture


def _square(level: int, column: int, row: int) -> Square:
    """Return the square of ground that a tile shows."""
    edge_m = TILE_M[level]
    return Square(column * edge_m, row * edge_m, edge_m, SCALES_M[level])


def _bytes(factors: FloatArray) -> tuple[int, ...]:
    return tuple(np.clip(np.rint(factors * 255.0), 0, 255).astype(int).tolist())


def _multiply_colour(picture: MatLike, colour: tuple[int, ...]) -> Picture:
    """Multiply every texel by a colour in 255ths."""
    return np.asarray(cv2.multiply(picture, _uniform_picture(picture.shape[0], colour), scale=1 / 255), dtype=np.uint8)


@lru_cache(maxsize=32)
def _uniform_picture(pixels: int, colour: tuple[int, ...]) -> Picture:
    """Return a square picture of one colour. OpenCV multiplies by a picture much faster than by a colour."""
    flat = np.empty((pixels, pixels, 3), dtype=np.uint8)
    flat[:] = colour
    return flat


def _crop_texture(texture: NDArray[np.uint8], square: Square) -> NDArray[np.uint8]:
    """Return a square's part of a texture.

    The texture's period is a whole multiple of the square's edge, or the edge is a whole multiple of the period.
    """
    pixels, period = square.pixels, len(texture)
    if pixels > period:
        count = pixels // period
        return np.tile(texture, (count, count, 1)[: texture.ndim])
    row = round(square.low_m / square.scale_m) % period
    column = round(square.left_m / square.scale_m) % period
    return texture[row : row + pixels, column : column + pixels]


def _tracks(road: Road) -> list[tuple[Strips, int]]:
    """Return the strips of wheel tracks and oil in every lane of the driven direction, with their darkening."""
    lanes = range(len(road.lanes.widths_m))
    tracks = [(_OIL[0], (0.0,), _OIL[1])] + [(width_m, (-0.85, 0.85), dark) for width_m, dark in _TRACK_PROFILE]
    return [
        (
            join_strips(
                [
                    strip_along(road, *beside_lane(road.lanes, lane, from_centre_m, width_m))
                    for lane in lanes
                    for from_centre_m in from_centres_m
                ]
            ),
            darkening,
        )
        for width_m, from_centres_m, darkening in tracks
    ]


def _mark_styles(road: Road) -> list[tuple[str, float]]:
    """Return the combinations of colour and width (m) of the road's marks, white ones first."""
    return [
        (colour, width_m)
        for colour in _PAINT
        for width_m in sorted({mark.width_m for mark in road.marks if mark.colour == colour})
    ]


def _marks(road: Road, colour: str, width_m: float) -> Strips:
    """Return the strips of all marks of one colour and width."""
    parts = []
    for mark in road.marks:
        if (mark.colour, mark.width_m) != (colour, width_m):
            continue
        left_m, right_m = across_mark(mark)
        if mark.kind == "solid":
            parts.append(strip_along(road, left_m, right_m, mark.from_m, mark.to_m))
            continue
        dash_begins_m = mark.dash_begins_m(road.first_m, road.last_m)
        # A dash has at least two pieces, so that it bends with the road.
        count = max(2, math.ceil(mark.dash_m / MAX_PIECE_M))
        begins_m = (dash_begins_m + np.arange(count)[:, None] * (mark.dash_m / count)).ravel()
        parts.append(strip_pieces(road, left_m, right_m, begins_m, begins_m + mark.dash_m / count + OVERLAP_M))
    return join_strips(parts)


def _blend(under: Picture, over: Picture, alpha: Grey) -> Picture:
    """Lay the picture `over` on the picture `under`; `alpha` is the opacity of `over`, 0 to 255."""
    cover = cv2.merge((alpha, alpha, alpha))
    kept = cv2.multiply(under, cv2.bitwise_not(cover), scale=1 / 255)
    return np.asarray(cv2.add(cv2.multiply(over, cover, scale=1 / 255), kept), dtype=np.uint8)


def _mottle(grass: Picture, square: Square) -> Picture:
    """Vary the brightness of the grass with wavelengths that do not divide its period, which hides the repetition."""
    count = 16
    middle_m = (np.arange(count) + 0.5) * square.edge_m / count
    x_m, y_m = square.left_m + middle_m, (square.low_m + middle_m)[:, None]
    brightness = 0.92 + 0.09 * np.sin(0.071 * x_m + 0.113 * y_m) + 0.07 * np.sin(0.157 * x_m - 0.093 * y_m + 1.0)
    levels = np.rint(brightness * 200.0).astype(np.uint8)
    fine = cv2.resize(cv2.merge((levels, levels, levels)), grass.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.multiply(grass, fine, scale=1 / 200), dtype=np.uint8)
