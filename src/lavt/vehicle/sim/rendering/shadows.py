"""Shadows of roadside objects and clouds, painted into the ground's tiles."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from lavt.domain import FloatArray
from lavt.vehicle.sim.rendering.light import Light
from lavt.vehicle.sim.rendering.roadside_objects import RoadsideObjects
from lavt.vehicle.sim.rendering.sprites import TREE_WIDTH, tree_shape
from lavt.vehicle.sim.rendering.textures import seamless_noise
from lavt.vehicle.sim.road.strips import Grey, Square, Strips, join_strips, make_strips

_CLOUD_TEXELS = 128
_CLOUD_TEXEL_M = 6.0
_DARKEST_CLOUD_SHADOW = 150.0
"""The largest value of a cloud's shadow in a mask. It is not 255, because some light passes clouds."""

_MARGIN_M = 1.0


class Shadows:
    """The shadows on one road in one light."""

    def __init__(self, objects: RoadsideObjects, light: Light, *, clouds: bool) -> None:
        self._shadow_per_height = light.shadow_per_height
        self._upright = join_strips(
            [_face_shadows(objects, self._shadow_per_height), _pole_shadows(objects.poles, self._shadow_per_height)]
        )
        self._trees = objects.trees
        feet_m, heights_m = objects.trees[:, :2], objects.trees[:, 2:3]
        shadow_ends_m = feet_m + heights_m * self._shadow_per_height
        reach_m = heights_m * TREE_WIDTH / 2 + _MARGIN_M
        self._tree_boxes = np.concatenate(
            [np.minimum(feet_m, shadow_ends_m) - reach_m, np.maximum(feet_m, shadow_ends_m) + reach_m], axis=1
        )
        """The bounding boxes of the trees' shadows, (n, 4): low x, low y, high x, high y."""
        self._clouds = _clouds() if clouds else None

    def mask(self, square: Square) -> Grey | None:
        """Return the share of sunlight that each texel of a square lacks, 0 to 255; None without any shadow."""
        mask = np.zeros((square.pixels, square.pixels), dtype=np.uint8)
        if self._clouds is not None:
            _draw_clouds(self._clouds, square, mask)
        self._upright.fill(mask, square, 255)
        self._draw_trees(square, mask)
        return mask if mask.any() else None

    def _draw_trees(self, square: Square, mask: Grey) -> None:
        low = np.array([square.left_m, square.low_m])
        boxes = self._tree_boxes
        overlapping = (boxes[:, :2] <= low + square.edge_m).all(axis=1) & (boxes[:, 2:] >= low).all(axis=1)
        across = np.array([-self._shadow_per_height[1], self._shadow_per_height[0]]) / np.hypot(
            *self._shadow_per_height
        )
        for x_m, y_m, height_m, kind in self._trees[overlapping]:
            shape = tree_shape(int(kind))
            rows, columns = shape.shape
            # The last row of the shape is the tree's foot; the first row is the shadow of its top.
            right = across * (height_m * TREE_WIDTH / columns)
            down = -self._shadow_per_height * (height_m / rows)
            foot = np.array([x_m, y_m])
            origin = foot - right * (columns - 1) / 2 - down * (rows - 1)
            ground_from_shape = np.column_stack([right, down, origin - low]) / square.scale_m
            ground_from_shape[:, 2] -= 0.5
            size = (square.pixels, square.pixels)
            cv2.max(mask, cv2.warpAffine(shape, ground_from_shape, size, flags=cv2.INTER_LINEAR), mask)


def _face_shadows(objects: RoadsideObjects, shadow_per_height: FloatArray) -> Strips:
    """Return the shadows of rails, barriers, lamp arms and walls."""
    corners = np.concatenate([objects.faces.corners_m, objects.walls.outlines_m])
    return make_strips(corners[..., :2] + corners[..., 2:] * shadow_per_height)


def _pole_shadows(poles: FloatArray, shadow_per_height: FloatArray) -> Strips:
    places_m, foot_heights_m, top_heights_m, widths_m = poles[:, :2], poles[:, 2:3], poles[:, 3:4], poles[:, 4:]
    side = np.array([-shadow_per_height[1], shadow_per_height[0]]) / np.hypot(*shadow_per_height) * widths_m / 2
    foot, top = places_m + foot_heights_m * shadow_per_height, places_m + top_heights_m * shadow_per_height
    return make_strips(np.stack([foot - side, foot + side, top + side, top - side], axis=1))


@lru_cache(maxsize=1)
def _clouds() -> Grey:
    noise = seamless_noise("cloud shadows", _CLOUD_TEXELS, 8) + 0.45 * seamless_noise(
        "cloud shadows", _CLOUD_TEXELS, 20
    )
    return np.rint(np.clip((noise - 0.75) * 1.6, 0.0, 1.0) * _DARKEST_CLOUD_SHADOW).astype(np.uint8)


def _draw_clouds(clouds: Grey, square: Square, mask: Grey) -> None:
    texel = square.scale_m / _CLOUD_TEXEL_M
    matrix = np.array(
        [
            [texel, 0.0, square.left_m / _CLOUD_TEXEL_M + texel / 2],
            [0.0, texel, square.low_m / _CLOUD_TEXEL_M + texel / 2],
        ]
    )
    # Reduce the offset to one period: `warpAffine` repeats the pattern, but loses precision far from the origin.
    matrix[:, 2] %= len(clouds)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    cv2.warpAffine(clouds, matrix, mask.shape, mask, flags, cv2.BORDER_WRAP)
