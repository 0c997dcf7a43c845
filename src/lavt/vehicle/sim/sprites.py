"""Trees and a bush, painted once and scaled to what the camera sees of them."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray, Picture
from lavt.streams import stream
from lavt.vehicle.sim.panorama import HAZE
from lavt.vehicle.sim.textures import Grey

TREE_KINDS = 5
"""Three broad-leaved trees, a conifer, and last a bush."""

_WORLD_SEED = 0
_HEIGHT_PX = 256
_WIDTH_PX = 208
_LARGEST_CACHED_PX = 110
_HAZE_STEPS = 64

Weights = NDArray[np.uint16]


def draw_tree(picture: Picture, *, kind: int, height_px: int, foot_px: tuple[float, float], haze: float) -> None:
    """Draw a tree that is `height_px` high with its foot at (u, v); `haze` is the share of haze in its colour."""
    sprite = _cached if height_px <= _LARGEST_CACHED_PX else _covering
    paint, see_through = sprite(kind, height_px, round(haze * _HAZE_STEPS))
    rows, columns, _ = paint.shape
    left, top = round(foot_px[0] - columns / 2), round(foot_px[1]) - rows + 1
    low_u, high_u = max(left, 0), min(left + columns, picture.shape[1])
    low_v, high_v = max(top, 0), min(top + rows, picture.shape[0])
    if low_u >= high_u or low_v >= high_v:
        return
    part = np.s_[low_v - top : high_v - top, low_u - left : high_u - left]
    under = picture[low_v:high_v, low_u:high_u]
    mixed = under * see_through[part]
    mixed += paint[part]
    np.right_shift(mixed, 8, out=under, casting="unsafe")


@lru_cache(maxsize=2000)
def _cached(kind: int, height_px: int, haze_step: int) -> tuple[Weights, Weights]:
    return _covering(kind, height_px, haze_step)


def _covering(kind: int, height_px: int, haze_step: int) -> tuple[Weights, Weights]:
    """Make what a sprite adds (rows, columns, 3) and leaves of what is behind (rows, columns, 1), times 256."""
    colour, alpha = _scaled(kind, height_px)
    share = haze_step / _HAZE_STEPS
    cover = (alpha.astype(np.uint16) + (alpha >> 7))[..., None]
    hazed = np.rint(colour * (1 - share) + np.array(HAZE) * share).astype(np.uint16)
    return np.asarray(hazed * cover, dtype=np.uint16), np.asarray(256 - cover, dtype=np.uint16)


def _scaled(kind: int, height_px: int) -> tuple[Picture, Grey]:
    colour, alpha = _painted(kind)
    size = (max(2, round(height_px * _WIDTH_PX / _HEIGHT_PX)), height_px)
    method = cv2.INTER_AREA if height_px < _HEIGHT_PX else cv2.INTER_LINEAR
    return (
        np.asarray(cv2.resize(colour, size, interpolation=method), dtype=np.uint8),
        np.asarray(cv2.resize(alpha, size, interpolation=method), dtype=np.uint8),
    )


@lru_cache(maxsize=TREE_KINDS)
def _painted(kind: int) -> tuple[Picture, Grey]:
    """Colour (rows, columns, 3) and cover of a tree."""
    random = stream(_WORLD_SEED, "tree", kind)
    leaf = np.array([46.0, 92.0, 70.0]) * random.uniform(0.75, 1.1) + random.uniform(-8, 8, 3)
    colour = np.broadcast_to(np.clip(leaf * 0.55, 0, 255), (_HEIGHT_PX, _WIDTH_PX, 3)).astype(np.uint8).copy()
    alpha = np.zeros((_HEIGHT_PX, _WIDTH_PX), dtype=np.uint8)
    middle = _WIDTH_PX // 2
    if kind != TREE_KINDS - 1:
        for image, paint in ((colour, (44, 58, 72)), (alpha, (255,))):
            cv2.line(image, (middle, _HEIGHT_PX), (middle, _HEIGHT_PX // 2), paint, 11, cv2.LINE_AA)
    for u, v, radius, light in _leaves(kind, random):
        shade = np.clip(leaf * light, 0, 255).tolist()
        cv2.circle(colour, (round(u), round(v)), round(radius), shade, -1, cv2.LINE_AA)
        cv2.circle(alpha, (round(u), round(v)), round(radius), (255,), -1, cv2.LINE_AA)
    colour = np.asarray(cv2.GaussianBlur(colour, (3, 3), 0), dtype=np.uint8)
    return colour, alpha


def _leaves(kind: int, random: np.random.Generator) -> FloatArray:
    """Tufts of leaves, back to front, (n, 4): u, v, radius in pixels, brightness. The sun is at the upper left."""
    count = 900
    middle = _WIDTH_PX / 2
    if kind == 3:  # a conifer: a cone
        down = np.sqrt(random.uniform(0.0, 1.0, count))
        across = random.uniform(-1.0, 1.0, count)
        u = middle + across * (6 + down * 68)
        v = 10 + down * 208
        light = 0.62 - 0.25 * across + random.uniform(-0.16, 0.16, count) + 0.1 * (1 - down)
    else:
        angle, away = random.uniform(0, 2 * np.pi, count), np.sqrt(random.uniform(0, 1, count))
        lobes = 0.80 + 0.09 * np.sin(3 * angle + kind * 2.0) + 0.07 * np.sin(5 * angle + kind)
        bush = kind == TREE_KINDS - 1
        half_height, centre_v = (112.0, 140.0) if bush else (84.0, 98.0)
        u = middle + np.cos(angle) * away * lobes * 92
        v = centre_v + np.sin(angle) * away * lobes * half_height
        light = 0.9 - 0.3 * np.cos(angle) * away - 0.42 * np.sin(angle) * away + random.uniform(-0.2, 0.2, count)
    order = np.argsort(light)
    radius = random.uniform(3.5, 8.0, count)
    return np.stack([u, v, radius, light], axis=-1)[order]
