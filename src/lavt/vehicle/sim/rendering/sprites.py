"""Sprites of trees and a bush, painted once for each light and scaled to the size that they have in the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from lavt.domain import FloatArray, Picture
from lavt.streams import stream
from lavt.vehicle.sim.rendering.light import Light
from lavt.vehicle.sim.rendering.textures import Grey

TREE_KINDS = 5
"""The number of kinds: three broad-leaved trees, a conifer, and a bush as the last kind."""

_WORLD_SEED = 0
_HEIGHT_PX = 256
_WIDTH_PX = 208
TREE_WIDTH = _WIDTH_PX / _HEIGHT_PX
"""The width of a tree's sprite as a share of its height."""

_SHADOW_REDUCTION = 4
_MAX_CACHED_HEIGHT_PX = 64
_MAX_CACHED_SPRITES = 2000
_HAZE_STEPS = 24
"""The haze on a tree is rounded to a multiple of 1 / 24."""


@dataclass(frozen=True, slots=True)
class Sprite:
    """A picture of a tree for drawing over a background, in two arrays (rows, columns, 3)."""

    colour: Picture
    """The tree's colour, multiplied by its opacity."""
    transmittance: Picture
    """The share of the background that remains visible, 0 to 255."""


class Trees:
    """The sprites of all trees in one light."""

    def __init__(self, light: Light) -> None:
        self._light = light
        self._cache: dict[tuple[int, bool, int, int], Sprite] = {}

    def prepare(self) -> None:
        """Paint all trees in advance."""
        for kind in range(TREE_KINDS):
            for mirrored in (False, True):
                _lit_tree(self._light, kind, mirrored)

    def draw(self, picture: Picture, shape: Sequence[float], haze: float) -> None:
        """Draw a tree into `picture`; `haze` is the share of haze in the tree's colour.

        `shape` has the position (u, v) of the tree's foot, the height in pixels, the kind, and whether the sprite is
        mirrored.
        """
        foot_u, foot_v, height_px, kind, mirrored = shape
        variant = (int(kind), mirrored != 0, round(haze * _HAZE_STEPS))
        if height_px > _MAX_CACHED_HEIGHT_PX:
            self._draw_large(picture, variant, height_px, (foot_u, foot_v))
            return
        rows = round(height_px)
        sprite = self._small_sprite(*variant, rows)
        columns = sprite.colour.shape[1]
        left, top = round(foot_u - columns / 2), round(foot_v) - rows + 1
        low_u, high_u = max(left, 0), min(left + columns, picture.shape[1])
        low_v, high_v = max(top, 0), min(top + rows, picture.shape[0])
        if low_u < high_u and low_v < high_v:
            part = np.s_[low_v - top : high_v - top, low_u - left : high_u - left]
            _blend(picture[low_v:high_v, low_u:high_u], sprite.colour[part], sprite.transmittance[part])

    def _small_sprite(self, kind: int, mirrored: bool, haze_step: int, rows: int) -> Sprite:
        key = (kind, mirrored, haze_step, rows)
        sprite = self._cache.get(key)
        if sprite is None:
            full_size = _halved_sprite(self._light, kind, mirrored, haze_step, 0)
            size = (max(2, round(rows * TREE_WIDTH)), rows)
            sprite = Sprite(_resize(full_size.colour, size), _resize(full_size.transmittance, size))
            if len(self._cache) >= _MAX_CACHED_SPRITES:
                self._cache.clear()
            self._cache[key] = sprite
        return sprite

    def _draw_large(
        self, picture: Picture, variant: tuple[int, bool, int], height_px: float, foot_px: tuple[float, float]
    ) -> None:
        """Draw the visible part of a large tree, scaled with subpixels: with whole pixels, large trees would jump."""
        (foot_u, foot_v), width_px = foot_px, height_px * TREE_WIDTH
        left, top = foot_u - width_px / 2, foot_v - height_px
        low_u, high_u = max(round(left), 0), min(round(left + width_px), picture.shape[1])
        low_v, high_v = max(round(top), 0), min(round(top + height_px), picture.shape[0])
        if low_u >= high_u or low_v >= high_v:
            return
        kind, mirrored, haze_step = variant
        sprite = _halved_sprite(self._light, kind, mirrored, haze_step, 1 if height_px < _HEIGHT_PX * 0.6 else 0)
        scale = sprite.colour.shape[0] / height_px
        matrix = np.array(
            [
                [scale, 0.0, (low_u - left + 0.5) * scale - 0.5],
                [0.0, scale, (low_v - top + 0.5) * scale - 0.5],
            ]
        )
        size, flags = (high_u - low_u, high_v - low_v), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        colour = cv2.warpAffine(sprite.colour, matrix, size, flags=flags, borderMode=cv2.BORDER_CONSTANT)
        border = (255.0, 255.0, 255.0)
        transmittance = cv2.warpAffine(
            sprite.transmittance, matrix, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=border
        )
        _blend(picture[low_v:high_v, low_u:high_u], np.asarray(colour, np.uint8), np.asarray(transmittance, np.uint8))


def _blend(under: Picture, colour: Picture, transmittance: Picture) -> None:
    cv2.multiply(under, transmittance, under, 1 / 255)
    cv2.add(under, colour, under)


def _resize(image: Picture, size: tuple[int, int]) -> Picture:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


@lru_cache(maxsize=240)
def _halved_sprite(light: Light, kind: int, mirrored: bool, haze_step: int, halvings: int) -> Sprite:
    """Return a tree's sprite, whose full size is halved `halvings` times."""
    if halvings:
        larger = _halved_sprite(light, kind, mirrored, haze_step, halvings - 1)
        size = (_WIDTH_PX >> halvings, _HEIGHT_PX >> halvings)
        return Sprite(_resize(larger.colour, size), _resize(larger.transmittance, size))
    clear, hazed, transmittance = _lit_tree(light, kind, mirrored)
    share = haze_step / _HAZE_STEPS
    return Sprite(np.asarray(cv2.addWeighted(clear, 1 - share, hazed, share, 0.0), dtype=np.uint8), transmittance)


@lru_cache(maxsize=6 * TREE_KINDS)
def _lit_tree(light: Light, kind: int, mirrored: bool) -> tuple[Picture, Picture, Picture]:
    """Return a tree's colour without haze and in full haze, and its transmittance."""
    colour, alpha = _paint_tree(kind)
    if mirrored:
        colour, alpha = colour[:, ::-1], alpha[:, ::-1]
    # The tree is painted in the noon sun. Its dark parts get the factor of the shade, its bright parts that of the sun.
    brightness = np.clip(colour.mean(axis=2, keepdims=True) / 75.0, 0.0, 1.0)
    if light.shadows:
        factor = np.array(light.shade) * 1.7 * (1 - brightness) + np.array(light.lit) * brightness
        lit = colour * np.minimum(factor, 1.15)
    else:
        # Under clouds light comes from all directions, so the tree loses most of its contrast.
        mean = colour[alpha > 0].mean(axis=0)
        lit = (mean + 0.45 * (colour - mean)) * np.array(light.lit)
    cover = alpha[..., None] / 255.0
    clear, hazed = (
        np.clip(np.rint(colours * cover), 0, 255).astype(np.uint8) for colours in (lit, np.array(light.haze))
    )
    return clear, hazed, np.repeat(255 - alpha[..., None], 3, axis=2)


@lru_cache(maxsize=TREE_KINDS)
def tree_shape(kind: int) -> Grey:
    """Return a tree's silhouette for its shadow, 0 to 255; it is reduced, so that the shadow's edge is soft."""
    _, alpha = _paint_tree(kind)
    size = (_WIDTH_PX // _SHADOW_REDUCTION, _HEIGHT_PX // _SHADOW_REDUCTION)
    return np.asarray(cv2.resize(alpha, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


@lru_cache(maxsize=TREE_KINDS)
def _paint_tree(kind: int) -> tuple[Picture, Grey]:
    """Return the colour (rows, columns, 3) and opacity of a tree, with the sun at its upper left."""
    random = stream(_WORLD_SEED, "tree", kind)
    leaf = np.array([46.0, 92.0, 70.0]) * random.uniform(0.75, 1.1) + random.uniform(-8, 8, 3)
    colour = np.broadcast_to(np.clip(leaf * 0.55, 0, 255), (_HEIGHT_PX, _WIDTH_PX, 3)).astype(np.uint8).copy()
    alpha = np.zeros((_HEIGHT_PX, _WIDTH_PX), dtype=np.uint8)
    middle = _WIDTH_PX // 2
    if kind != TREE_KINDS - 1:
        _paint_trunk(colour, alpha, middle, random)
    for u, v, radius, brightness in _leaf_tufts(kind, random):
        tuft_colour = np.clip(leaf * brightness + random.uniform(-5, 5, 3), 0, 255).tolist()
        centre, size = (round(u * 8), round(v * 8)), round(radius * 8)
        cv2.circle(colour, centre, size, tuft_colour, -1, cv2.LINE_AA, 3)
        cv2.circle(alpha, centre, size, (255,), -1, cv2.LINE_AA, 3)
    return colour, alpha


def _paint_trunk(colour: Picture, alpha: Grey, middle: int, random: np.random.Generator) -> None:
    branches = [((middle, _HEIGHT_PX), (middle, 120), 8)]
    branches += [
        ((middle, round(v)), (round(middle + u), round(v - 60)), 4)
        for u, v in random.uniform((-50, 130), (50, 190), (5, 2))
    ]
    for begin, end, width_px in branches:
        for image, paint in ((colour, (38, 50, 62)), (alpha, (255,))):
            cv2.line(image, begin, end, paint, width_px, cv2.LINE_AA)


def _leaf_tufts(kind: int, random: np.random.Generator) -> FloatArray:
    """Return tufts of leaves (n, 4), the farthest first: u, v, radius (all in pixels) and brightness."""
    count = 3200
    middle = _WIDTH_PX / 2
    if kind == 3:  # a conifer: a cone of tiers
        down = np.sqrt(random.uniform(0.0, 1.0, count))
        across = random.uniform(-1.0, 1.0, count)
        tier = 1.0 - 0.28 * np.mod(down * 8.0, 1.0)[::-1]
        u = middle + across * (4 + down * 72) * tier
        v = 8 + down * 214 + 10 * np.abs(across)
        brightness = 0.60 - 0.28 * across + random.uniform(-0.20, 0.20, count) + 0.1 * (1 - down)
        near = random.uniform(0, 1, count)
    else:
        u, v, brightness, near = _crown(kind, random, count, middle)
    order = np.argsort(near)
    radius = random.uniform(1.4, 3.6, count)
    return np.stack([u, v, radius, brightness], axis=-1)[order]


def _crown(
    kind: int, random: np.random.Generator, count: int, middle: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return u, v, brightness and nearness of a crown's tufts of leaves.

    A crown consists of overlapping clumps, each a ball of leaves with a bright and a dark side.
    """
    bush = kind == TREE_KINDS - 1
    clumps = 26
    half_height, centre_v, half_width = (84.0, 150.0, 70.0) if bush else (62.0, 96.0, 70.0)
    angle, away = random.uniform(0, 2 * np.pi, clumps), np.sqrt(random.uniform(0.02, 1, clumps))
    clump_u, clump_v = np.cos(angle) * away * half_width, np.sin(angle) * away * half_height
    clump_near, clump_size = random.uniform(0, 1, clumps), random.uniform(17.0, 30.0, clumps)
    clump = random.integers(0, clumps, count)
    turn, out = random.uniform(0, 2 * np.pi, count), np.sqrt(random.uniform(0, 1, count)) ** 0.8
    u_in, v_in = np.cos(turn) * out, np.sin(turn) * out
    u = middle + clump_u[clump] + u_in * clump_size[clump]
    v = centre_v + clump_v[clump] + v_in * clump_size[clump]
    brightness = 0.80 - 0.26 * u_in - 0.34 * v_in
    brightness += -0.14 * clump_u[clump] / half_width - 0.26 * clump_v[clump] / half_height + 0.16 * clump_near[clump]
    brightness += random.uniform(-0.16, 0.16, count)
    return u, np.minimum(v, _HEIGHT_PX - 3.0), brightness, clump_near[clump] + 0.25 * random.uniform(0, 1, count)
