"""The scenery: draw roadside objects from far to near, in one light."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import islice, repeat
from operator import itemgetter
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray, Picture
from lavt.vehicle.sim.rendering.light import Light
from lavt.vehicle.sim.rendering.pinhole import CameraPlacement
from lavt.vehicle.sim.rendering.roadside_objects import FAR_M, RoadsideObjects
from lavt.vehicle.sim.rendering.sprites import TREE_WIDTH, Trees
from lavt.vehicle.sim.rendering.weather import HAZE_M

_NEAR_M = 0.4
"""Parts of faces that are closer to the camera than this distance are not drawn."""

_SUBPIXEL_BITS = 4
_MAX_COORDINATE_PX = 4000.0
_GLASS_COLOUR = (104.0, 88.0, 74.0)
_POLE_GREY = 96.0

Drawing = tuple[float, Callable[..., None], Any, Any]
"""Depth (m), the drawing function, and its two arguments after the picture."""


class Scenery:
    """The roadside objects of one road, in one light."""

    def __init__(self, objects: RoadsideObjects, light: Light, haze_m: float = HAZE_M) -> None:
        self._objects = objects
        faces, walls = objects.faces, objects.walls
        self._face_ends_m = _ends(faces.corners_m)
        self._colours = faces.colours * light.upright_factors(faces.normals)
        x_m, y_m, foot_heights_m, top_heights_m, self._pole_widths_m = objects.poles.T
        ends_m = [np.column_stack([x_m, y_m, heights_m]) for heights_m in (foot_heights_m, top_heights_m)]
        self._pole_ends_m = np.stack(ends_m, axis=1)
        self._pole_colour = _POLE_GREY * light.upright_factors(np.zeros((1, 2)))
        self._wall_colours = walls.colours * light.upright_factors(walls.normals)
        self._wall_ends_m = _ends(walls.outlines_m)
        self._glass = np.array(_GLASS_COLOUR) * light.upright_factors(walls.normals)
        # Sprites show trees with the sun on the left. So a sprite is mirrored if the sun is to the right of the road.
        mirrored = np.sin(light.azimuth_rad - objects.tree_road_rad) < 0
        self._trees = np.column_stack([objects.trees, mirrored])
        self._haze = np.array(light.haze)
        self._haze_m = haze_m
        self._sprites = Trees(light)

    def prepare(self) -> None:
        """Fill the caches whose first use is slow."""
        self._sprites.prepare()

    def draw(self, placement: CameraPlacement, picture: Picture) -> None:
        """Draw the visible objects into `picture`."""
        drawings: list[Drawing] = [
            *self._face_drawings(placement),
            *self._pole_drawings(placement),
            *self._tree_drawings(placement),
            *self._wall_drawings(placement),
        ]
        drawings.sort(key=itemgetter(0), reverse=True)  # stable: faces of one piece stay in painting order
        for _, draw, shape, style in drawings:
            draw(picture, shape, style)

    def _face_drawings(self, placement: CameraPlacement) -> Iterable[Drawing]:
        faces = self._objects.faces
        begin, end = ahead = placement.depth_m(*self._face_ends_m)
        in_range = np.flatnonzero((np.maximum(begin, end) > _NEAR_M) & (np.minimum(begin, end) < faces.visible_to_m))
        ahead = ahead.T[in_range]
        points = placement.project(_clip(faces.corners_m[in_range], ahead))
        inside = _is_across(points, placement)
        # All faces of one piece of a rail have the same depth.
        depth = np.maximum(ahead[inside], _NEAR_M).mean(axis=1)
        shades = self._add_haze(self._colours[in_range[inside]], depth)
        return zip(depth.tolist(), repeat(_polygon), _subpixels(points[inside]), shades.tolist())

    def _pole_drawings(self, placement: CameraPlacement) -> Iterable[Drawing]:
        ahead = placement.depth_m(*self._pole_ends_m[:, 0, :2].T)
        visible = (ahead > 1.0) & (ahead < FAR_M)
        depth = ahead[visible]
        ends, widths_m = placement.project(self._pole_ends_m[visible]), self._pole_widths_m[visible]
        feet_u_px = ends[:, 0, 0]
        inside = (feet_u_px > -20) & (feet_u_px < placement.model.width_px + 20)
        depth = depth[inside]
        widths = np.clip(np.rint(widths_m[inside] * placement.model.focal_px / depth), 1, 40).astype(int).tolist()
        shades = self._add_haze(np.broadcast_to(self._pole_colour, (len(depth), 3)), depth).tolist()
        styles = zip(shades, widths, strict=True)
        # 0.3 m is added to the depth of a pole, so that the face that it carries is drawn over it.
        return zip((depth + 0.3).tolist(), repeat(_line), _subpixels(ends[inside]).tolist(), styles)

    def _tree_drawings(self, placement: CameraPlacement) -> Iterable[Drawing]:
        ahead = placement.depth_m(*self._trees[:, :2].T)
        trees = self._trees[(ahead > 3.0) & (ahead < FAR_M)]
        x_m, y_m, heights_m, kinds, mirrored = trees.T
        u_px, v_px, all_depths_m = placement.project(np.column_stack([x_m, y_m, np.zeros(len(trees))])).T
        heights_px = heights_m * placement.model.focal_px / all_depths_m
        reach_px = heights_px * (TREE_WIDTH / 2)
        inside = (heights_px >= 3) & (u_px > -reach_px) & (u_px < placement.model.width_px + reach_px)
        shapes = np.column_stack([u_px, v_px, heights_px, kinds, mirrored])[inside].tolist()
        depth = all_depths_m[inside]
        haze = (1.0 - np.exp(-depth / self._haze_m)).tolist()
        return zip(depth.tolist(), repeat(self._sprites.draw), shapes, haze)

    def _wall_drawings(self, placement: CameraPlacement) -> Iterable[Drawing]:
        walls = self._objects.walls
        outlines = walls.outlines_m
        begin_m, end_m = self._wall_ends_m.swapaxes(0, 1)  # each the coordinates x and y of all walls
        # A wall is visible from outside only. Seen from there, its beginning is on the left.
        along_x, along_y = end_m - begin_m
        in_view = (placement.x_m - begin_m[0]) * along_y > (placement.y_m - begin_m[1]) * along_x
        ahead = placement.depth_m(*self._wall_ends_m)
        nearest = ahead.min(axis=0)
        in_view &= (nearest > _NEAR_M) & (nearest < FAR_M * 1.2)
        points = placement.project(outlines)
        in_view &= _is_across(points, placement)
        visible = np.flatnonzero(in_view)
        depth = ahead[:, visible].mean(axis=0)
        windows = _project_groups(placement, [walls.windows_m[wall] for wall in visible])
        walls_and_glass = (
            self._add_haze(colours[visible], depth).tolist() for colours in (self._wall_colours, self._glass)
        )
        shapes = zip(_subpixels(points[visible]), windows, strict=True)
        return zip(depth.tolist(), repeat(_facade), shapes, zip(*walls_and_glass, strict=True))

    def _add_haze(self, colours: FloatArray, depth_m: FloatArray) -> FloatArray:
        share = (1.0 - np.exp(-depth_m / self._haze_m))[:, None]
        return np.asarray(np.minimum(np.rint(colours * (1 - share) + self._haze * share), 255.0))


def _polygon(picture: Picture, polygon: NDArray[np.int32], colour: list[float]) -> None:
    cv2.fillConvexPoly(picture, polygon, colour, cv2.LINE_AA, _SUBPIXEL_BITS)


def _line(picture: Picture, ends: list[list[int]], style: tuple[list[float], int]) -> None:
    (begin, end), (colour, width_px) = ends, style
    cv2.line(picture, begin, end, colour, width_px, cv2.LINE_AA, _SUBPIXEL_BITS)


def _facade(
    picture: Picture,
    shape: tuple[NDArray[np.int32], list[NDArray[np.int32]]],
    colours: tuple[list[float], list[float]],
) -> None:
    (outline, windows), (wall_colour, glass_colour) = shape, colours
    cv2.fillConvexPoly(picture, outline, wall_colour, cv2.LINE_AA, _SUBPIXEL_BITS)
    cv2.fillPoly(picture, windows, glass_colour, cv2.LINE_AA, _SUBPIXEL_BITS)


def _ends(outlines_m: FloatArray) -> FloatArray:
    """Return where upright outlines (n, 4, 3) begin and end, (2, 2, n): x and y, each of the beginning and the end."""
    return np.ascontiguousarray(outlines_m[:, :2, :2].T)


def _is_across(points: FloatArray, placement: CameraPlacement) -> NDArray[np.bool_]:
    """Return for each outline (n, 4, 3) in picture coordinates whether it reaches columns of the picture."""
    u_px = points[..., 0]
    return np.asarray((u_px > 0).any(axis=1) & (u_px < placement.model.width_px).any(axis=1))


def _clip(corners_m: FloatArray, ahead: FloatArray) -> FloatArray:
    """Cut off the parts of faces that are too close to the camera; `ahead` (n, 2) are the depths of the faces' ends."""
    for near, far in ((0, 1), (1, 0)):  # the end that may be too close, and the other end
        cut = ahead[:, near] < _NEAR_M
        if cut.any():
            share = ((_NEAR_M - ahead[cut, near]) / (ahead[cut, far] - ahead[cut, near]))[:, None]
            for near_corner, far_corner in ((near, far), (3 - near, 3 - far)):  # the low corners, and the high ones
                corners_m[cut, near_corner] += share * (corners_m[cut, far_corner] - corners_m[cut, near_corner])
    return corners_m


def _project_groups(placement: CameraPlacement, groups_m: Sequence[FloatArray]) -> list[list[NDArray[np.int32]]]:
    """Return the outlines in subpixels of each group of outlines (n, 4, 3), projected together because it is faster."""
    if not groups_m:
        return []
    outlines = iter(_subpixels(placement.project(np.concatenate(groups_m))))
    return [list(islice(outlines, len(group))) for group in groups_m]


def _subpixels(points: FloatArray) -> NDArray[np.int32]:
    limited = np.minimum(np.maximum(points[..., :2], -_MAX_COORDINATE_PX), _MAX_COORDINATE_PX)
    return np.asarray(np.rint(limited * (1 << _SUBPIXEL_BITS)), dtype=np.int32)
