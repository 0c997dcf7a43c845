"""Things that stand beside the road: rails and barriers, lamp posts, trees and buildings.

They are drawn from far to near. Their places are the world's, the same in every run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray, Picture
from lavt.streams import stream
from lavt.vehicle.sim.panorama import HAZE
from lavt.vehicle.sim.pinhole import View
from lavt.vehicle.sim.road import Rail, Road
from lavt.vehicle.sim.sprites import TREE_KINDS, draw_tree

_WORLD_SEED = 0
_NEAR_M = 0.4
_FAR_M = 160.0
_HAZE_M = 240.0
_POST_SPACING_M = 4.0
_LAMP_SPACING_M = 36.0
_SUBPIXEL_BITS = 4

_BANDS: dict[str, tuple[tuple[float, float, tuple[int, int, int]], ...]] = {
    "barrier": ((0.0, 0.22, (132, 138, 140)), (0.22, 0.78, (164, 170, 172)), (0.78, 0.86, (190, 196, 198))),
    "rail": ((0.44, 0.53, (150, 148, 144)), (0.53, 0.62, (108, 108, 106)), (0.62, 0.76, (178, 176, 170))),
}
"""The faces of a rail from below: from and to which height (m), and colour (blue green red)."""

_FACADES = ((158, 172, 190), (176, 182, 184), (120, 140, 168), (186, 200, 206))
_WINDOW = (104, 88, 74)

Drawing = tuple[float, Callable[[Picture], None]]
"""Depth (m) and what draws the thing."""


@dataclass(frozen=True, slots=True)
class Faces:
    """Upright quadrilaterals: corners (n, 4, 3) in m (begin low, end low, end high, begin high), colours (n, 3)."""

    corners_m: FloatArray
    colours: FloatArray


@dataclass(frozen=True, slots=True)
class Building:
    """A box: its faces, and the windows of each face (n, 4, 3)."""

    faces_m: FloatArray
    windows_m: tuple[FloatArray, ...]
    colour: tuple[int, int, int]


class Scenery:
    """Everything that stands along one road; `trees` says whether trees, lamp posts and buildings are there too."""

    def __init__(self, road: Road, *, trees: bool) -> None:
        runs = [_stations(road, rail) for rail in road.rails]
        self._faces = _rail_faces(road, runs)
        self._poles = _poles(road, runs, lamps=trees)
        self._trees = _plant(road) if trees else np.empty((0, 4))
        self._buildings = _build(road) if trees else ()

    def draw(self, view: View, picture: Picture) -> None:
        """Draw into `picture` what is in view."""
        things = self._rail_drawings(view) + self._pole_drawings(view) + self._tree_drawings(view)
        for building in self._buildings:
            things += _building_drawings(building, view)
        things.sort(key=lambda thing: -thing[0])
        for _, draw in things:
            draw(picture)

    def _rail_drawings(self, view: View) -> list[Drawing]:
        corners, colours = self._faces.corners_m, self._faces.colours
        ahead = _ahead(corners[:, :2, :2], view)
        shown = (ahead.max(axis=1) > _NEAR_M) & (ahead.min(axis=1) < _FAR_M)
        points = view.project(_clipped(corners[shown], ahead[shown]))
        inside = (points[..., 0].max(axis=1) > 0) & (points[..., 0].min(axis=1) < view.model.width_px)
        points = points[inside]
        depth = points[:, :2, 2].mean(axis=1)
        shades = _hazed(colours[shown][inside], depth).tolist()
        return [
            (far, _polygon(polygon, shade))
            for far, polygon, shade in zip(depth.tolist(), _subpixels(points), shades, strict=True)
        ]

    def _pole_drawings(self, view: View) -> list[Drawing]:
        ahead = _ahead(self._poles[:, :2], view)
        shown = (ahead > 1.0) & (ahead < _FAR_M)
        poles, depth = self._poles[shown], ahead[shown]
        foot = view.project(poles[:, :3])
        top = view.project(np.column_stack([poles[:, :2], poles[:, 3]]))
        inside = (foot[:, 0] > -20) & (foot[:, 0] < view.model.width_px + 20)
        ends = _subpixels(np.stack([foot, top], axis=1)[inside])
        widths = np.clip(np.rint(poles[inside, 4] * view.model.focal_px / depth[inside]), 1, 40).astype(int).tolist()
        shades = _hazed(np.full((len(ends), 3), 96.0), depth[inside]).tolist()
        # A pole stands behind the face it carries.
        return [
            (far + 0.3, _line(end, shade, width))
            for far, end, shade, width in zip(depth[inside].tolist(), ends, shades, widths, strict=True)
        ]

    def _tree_drawings(self, view: View) -> list[Drawing]:
        ahead = _ahead(self._trees[:, :2], view)
        shown = (ahead > 3.0) & (ahead < _FAR_M)
        trees = self._trees[shown]
        feet = view.project(np.column_stack([trees[:, :2], np.zeros(len(trees))]))
        found: list[Drawing] = []
        for (u_px, v_px, depth), (_, _, height_m, kind) in zip(feet.tolist(), trees.tolist(), strict=True):
            height_px = round(height_m * view.model.focal_px / depth)
            if height_px >= 3 and -height_px < u_px < view.model.width_px + height_px:
                found.append((depth, _tree(int(kind), height_px, (u_px, v_px), _haze_share(depth))))
        return found


def _polygon(polygon: NDArray[np.int32], colour: list[float]) -> Callable[[Picture], None]:
    def draw(picture: Picture) -> None:
        cv2.fillConvexPoly(picture, polygon, colour, lineType=cv2.LINE_AA, shift=_SUBPIXEL_BITS)

    return draw


def _line(ends: NDArray[np.int32], colour: list[float], width_px: int) -> Callable[[Picture], None]:
    def draw(picture: Picture) -> None:
        begin, end = ends.tolist()
        cv2.line(picture, begin, end, colour, width_px, cv2.LINE_AA, _SUBPIXEL_BITS)

    return draw


def _tree(kind: int, height_px: int, foot: tuple[float, float], haze: float) -> Callable[[Picture], None]:
    return lambda picture: draw_tree(picture, kind=kind, height_px=height_px, foot_px=foot, haze=haze)


def _building_drawings(building: Building, view: View) -> list[Drawing]:
    found: list[Drawing] = []
    for face, windows in zip(building.faces_m, building.windows_m, strict=True):
        centre, normal = face[:, :2].mean(axis=0), face[1, :2] - face[0, :2]
        # Seen from outside, a face's outline runs from the left to the right.
        towards = (view.x_m - centre[0]) * normal[1] - (view.y_m - centre[1]) * normal[0]
        ahead = _ahead(face[:, :2], view)
        if towards <= 0 or ahead.min() < _NEAR_M or ahead.min() > _FAR_M * 1.2:
            continue
        depth = float(ahead.mean())
        light = 1.0 if abs(normal[0]) > abs(normal[1]) else 0.82
        wall = _hazed(np.array([building.colour]) * light, np.array([depth])).tolist()[0]
        glass = _hazed(np.array([_WINDOW]), np.array([depth])).tolist()[0]
        found.append(
            (depth, _facade(_subpixels(view.project(face)[None])[0], _subpixels(view.project(windows)), wall, glass))
        )
    return found


def _facade(
    outline: NDArray[np.int32], windows: NDArray[np.int32], wall: list[float], glass: list[float]
) -> Callable[[Picture], None]:
    def draw(picture: Picture) -> None:
        cv2.fillConvexPoly(picture, outline, wall, lineType=cv2.LINE_AA, shift=_SUBPIXEL_BITS)
        cv2.fillPoly(picture, list(windows), glass, lineType=cv2.LINE_AA, shift=_SUBPIXEL_BITS)

    return draw


def _ahead(points_m: FloatArray, view: View) -> FloatArray:
    """How far ahead of the camera points (..., 2) are."""
    along = (points_m[..., 0] - view.x_m) * math.cos(view.heading_rad)
    return np.asarray(along + (points_m[..., 1] - view.y_m) * math.sin(view.heading_rad))


def _clipped(corners_m: FloatArray, ahead: FloatArray) -> FloatArray:
    """Faces with the part that is not in front of the camera cut off; `ahead` (n, 2) is of their begin and end."""
    corners = corners_m.copy()
    for near, far in ((0, 1), (1, 0)):
        cut = ahead[:, near] < _NEAR_M
        share = ((_NEAR_M - ahead[cut, near]) / (ahead[cut, far] - ahead[cut, near]))[:, None]
        for here, there in ((near, far), (3 - near, 3 - far)):
            corners[cut, here] += share * (corners[cut, there] - corners[cut, here])
    return corners


def _subpixels(points: FloatArray) -> NDArray[np.int32]:
    return np.rint(np.clip(points[..., :2], -4000, 4000) * (1 << _SUBPIXEL_BITS)).astype(np.int32)


def _haze_share(depth_m: float) -> float:
    return 1.0 - math.exp(-depth_m / _HAZE_M)


def _hazed(colours: FloatArray, depth_m: FloatArray) -> FloatArray:
    share = (1.0 - np.exp(-depth_m / _HAZE_M))[:, None]
    return np.asarray(np.rint(colours * (1 - share) + np.array(HAZE) * share))


def _stations(road: Road, rail: Rail) -> tuple[Rail, FloatArray]:
    first_m, last_m = max(rail.from_m, road.first_m), min(rail.to_m, road.last_m)
    return rail, np.linspace(first_m, last_m, max(2, round((last_m - first_m) / _POST_SPACING_M) + 1))


def _rail_faces(road: Road, runs: list[tuple[Rail, FloatArray]]) -> Faces:
    corners, colours = [], []
    for rail, stations in runs:
        line = road.across(stations, rail.offset_m)
        for low_m, high_m, colour in _BANDS[rail.kind]:
            low = np.column_stack([line, np.full(len(line), low_m)])
            high = np.column_stack([line, np.full(len(line), high_m)])
            corners.append(np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1))
            # Every piece a little different, so that the eye can see them pass.
            tone = stream(_WORLD_SEED, "rail").uniform(-6, 6, len(line) - 1)[:, None]
            colours.append(np.array(colour) + tone)
    if not corners:
        return Faces(np.empty((0, 4, 3)), np.empty((0, 3)))
    return Faces(np.concatenate(corners), np.concatenate(colours))


def _poles(road: Road, runs: list[tuple[Rail, FloatArray]], *, lamps: bool) -> FloatArray:
    """Place posts of rails and lamp posts on barriers, (n, 5): x, y, foot, top, width in metres."""
    poles = [np.empty((0, 5))]
    for rail, stations in runs:
        if rail.kind == "rail":
            place, shape = road.across(stations, rail.offset_m), (0.0, 0.72, 0.12)
        elif lamps:
            place = road.across(np.arange(stations[0] + 6.0, stations[-1], _LAMP_SPACING_M), rail.offset_m)
            shape = (0.8, 9.5, 0.16)
        else:
            continue
        poles.append(np.column_stack([place, np.tile(shape, (len(place), 1))]))
    return np.concatenate(poles)


def _free_places(road: Road, name: str, count: int, clear_m: float) -> FloatArray:
    """Up to `count` random places around the road, none nearer than `clear_m` to the middle of its asphalt."""
    left_m = max(strip.left_m for strip in road.paved)
    right_m = min(strip.right_m for strip in road.paved)
    middle = road.across(np.arange(road.first_m - 40.0, road.last_m + 40.0, 4.0), (left_m + right_m) / 2)
    margin_m = (left_m - right_m) / 2 + clear_m
    low, high = middle.min(axis=0) - 110.0, middle.max(axis=0) + 110.0
    places = stream(_WORLD_SEED, name).uniform(low, high, (count, 2))
    distance = np.sqrt(((places[:, None] - middle[None]) ** 2).sum(axis=-1)).min(axis=1)
    return np.asarray(places[distance > margin_m])


def _plant(road: Road) -> FloatArray:
    """Trees, (n, 4): x, y, height (m), kind."""
    places = _free_places(road, "tree places", 420, clear_m=6.0)
    random = stream(_WORLD_SEED, "tree shapes")
    kinds = random.integers(0, TREE_KINDS, len(places))
    heights = np.where(
        kinds == TREE_KINDS - 1, random.uniform(1.2, 2.6, len(places)), random.uniform(5.5, 12.0, len(places))
    )
    return np.column_stack([places, heights, kinds])


def _build(road: Road) -> tuple[Building, ...]:
    random = stream(_WORLD_SEED, "building shapes")
    found = []
    for x_m, y_m in _free_places(road, "building places", 26, clear_m=24.0):
        length_m, width_m, storeys = random.uniform(14, 34), random.uniform(10, 16), int(random.integers(2, 7))
        heading_rad = random.uniform(0, math.pi)
        colour = _FACADES[int(random.integers(0, len(_FACADES)))]
        found.append(_box((x_m, y_m), heading_rad, (length_m, width_m, 3.2 * storeys), colour))
    return tuple(found)


def _box(
    centre: tuple[float, float], heading_rad: float, size_m: tuple[float, float, float], colour: tuple[int, int, int]
) -> Building:
    length_m, width_m, height_m = size_m
    forward = np.array([math.cos(heading_rad), math.sin(heading_rad)]) * length_m / 2
    left = np.array([-math.sin(heading_rad), math.cos(heading_rad)]) * width_m / 2
    corners = np.array([forward - left, forward + left, -forward + left, -forward - left]) + np.array(centre)
    faces, windows = [], []
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        columns = max(2, round(float(np.hypot(*(end - begin))) / 3.0))
        rows = round(height_m / 3.2)
        whole = (np.zeros(1), np.ones(1))
        faces.append(_panels(begin, end, shares=whole, heights_m=(np.zeros(1), np.array([height_m])))[0])
        first = (np.arange(columns) + 0.25) / columns
        sill = np.linspace(1.0, 1.0 + 3.2 * (rows - 1), rows)
        windows.append(_panels(begin, end, shares=(first, first + 0.5 / columns), heights_m=(sill, sill + 1.5)))
    return Building(np.array(faces), tuple(windows), colour)


def _panels(
    begin: FloatArray,
    end: FloatArray,
    *,
    shares: tuple[FloatArray, FloatArray],
    heights_m: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Rectangles on a wall: every (first, last) share of its length with every (low, high) height, (n, 4, 3)."""
    left = begin + shares[0][:, None] * (end - begin)
    right = begin + shares[1][:, None] * (end - begin)
    panels = [
        [[*near, low], [*far, low], [*far, high], [*near, high]]
        for low, high in zip(*heights_m, strict=True)
        for near, far in zip(left, right, strict=True)
    ]
    return np.array(panels)
