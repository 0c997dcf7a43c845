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
from lavt.vehicle.sim.cross_section import Rail
from lavt.vehicle.sim.panorama import HAZE
from lavt.vehicle.sim.pinhole import View
from lavt.vehicle.sim.road import Road
from lavt.vehicle.sim.sprites import TREE_KINDS, draw_tree

_WORLD_SEED = 0
_NEAR_M = 0.4
_FAR_M = 160.0
_DETAIL_M = 45.0
_HAZE_M = 240.0
_POST_SPACING_M = 4.0
_LAMP_SPACING_M = 36.0
_SUBPIXEL_BITS = 4

_BANDS: dict[str, tuple[tuple[float, float, tuple[int, int, int], float], ...]] = {
    "barrier": (
        (0.0, 0.86, (164, 170, 172), _FAR_M),
        (0.0, 0.22, (132, 138, 140), _DETAIL_M),
        (0.78, 0.86, (190, 196, 198), _DETAIL_M),
    ),
    "rail": (
        (0.44, 0.76, (160, 158, 153), _FAR_M),
        (0.53, 0.62, (108, 108, 106), _DETAIL_M),
        (0.62, 0.76, (178, 176, 170), _DETAIL_M),
    ),
}
"""The faces of a rail in the order of painting: from and to which height (m), blue green red, how far it is seen."""

_FACADES = ((158, 172, 190), (176, 182, 184), (120, 140, 168), (186, 200, 206))
_WINDOW = (104, 88, 74)
_STOREY_M = 3.2

Drawing = tuple[float, Callable[[Picture], None]]
"""Depth (m) and what draws the thing."""


@dataclass(frozen=True, slots=True)
class Faces:
    """Upright quadrilaterals: corners (n, 4, 3) in m (begin low, end low, end high, begin high), colours (n, 3)."""

    corners_m: FloatArray
    colours: FloatArray
    seen_to_m: FloatArray


@dataclass(frozen=True, slots=True)
class Walls:
    """Walls of buildings: outlines (n, 4, 3) as of `Faces`, colours (n, 3), and the windows of each (m, 4, 3)."""

    outlines_m: FloatArray
    colours: FloatArray
    windows_m: tuple[FloatArray, ...]


class Scenery:
    """Everything that stands along one road; `trees` says whether trees, lamp posts and buildings are there too."""

    def __init__(self, road: Road, *, trees: bool) -> None:
        runs = [_stations(road, rail) for rail in road.rails]
        self._faces = _join_faces([_rail_faces(road, runs), _lamp_faces(road, runs if trees else [])])
        self._poles = _poles(road, runs, lamps=trees)
        self._trees = _plant(road) if trees else np.empty((0, 4))
        self._walls = _build(road) if trees else None

    def draw(self, view: View, picture: Picture) -> None:
        """Draw into `picture` what is in view."""
        things = self._rail_drawings(view) + self._pole_drawings(view) + self._tree_drawings(view)
        if self._walls is not None:
            things += _wall_drawings(self._walls, view)
        things.sort(key=lambda thing: -thing[0])
        for _, draw in things:
            draw(picture)

    def _rail_drawings(self, view: View) -> list[Drawing]:
        corners, colours = self._faces.corners_m, self._faces.colours
        ahead = _ahead(corners[:, :2, :2], view)
        shown = (ahead.max(axis=1) > _NEAR_M) & (ahead.min(axis=1) < self._faces.seen_to_m)
        points = view.project(_clipped(corners[shown], ahead[shown]))
        inside = (points[..., 0].max(axis=1) > 0) & (points[..., 0].min(axis=1) < view.model.width_px)
        points = points[inside]
        # Faces of one piece have one depth, and sorting keeps the order of painting among them.
        depth = np.maximum(ahead[shown][inside], _NEAR_M).mean(axis=1)
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
        heights = np.rint(trees[:, 2] * view.model.focal_px / feet[:, 2])
        inside = (heights >= 3) & (feet[:, 0] > -heights) & (feet[:, 0] < view.model.width_px + heights)
        rows = np.column_stack([feet, heights, trees[:, 3]])[inside]
        return [
            (depth, _tree(int(kind), int(height_px), (u_px, v_px), 1.0 - math.exp(-depth / _HAZE_M)))
            for u_px, v_px, depth, height_px, kind in rows.tolist()
        ]


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


def _wall_drawings(walls: Walls, view: View) -> list[Drawing]:
    outlines = walls.outlines_m
    begin, end = outlines[:, 0, :2], outlines[:, 1, :2]
    # Seen from outside, a wall's outline runs from the left to the right.
    seen = (view.x_m - begin[:, 0]) * (end - begin)[:, 1] > (view.y_m - begin[:, 1]) * (end - begin)[:, 0]
    ahead = _ahead(outlines[:, :2, :2], view)
    seen &= (ahead.min(axis=1) > _NEAR_M) & (ahead.min(axis=1) < _FAR_M * 1.2)
    points = view.project(outlines)
    seen &= (points[..., 0].max(axis=1) > 0) & (points[..., 0].min(axis=1) < view.model.width_px)
    shown = np.flatnonzero(seen)
    depth = ahead[shown].mean(axis=1)
    colours = _hazed(walls.colours[shown], depth).tolist()
    glass = _hazed(np.broadcast_to(np.array(_WINDOW), (len(shown), 3)), depth).tolist()
    outlines_px = _subpixels(points[shown])
    return [
        (far, _facade(outlines_px[i], _subpixels(view.project(walls.windows_m[wall])), colours[i], glass[i]))
        for i, (wall, far) in enumerate(zip(shown.tolist(), depth.tolist(), strict=True))
    ]


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


def _hazed(colours: FloatArray, depth_m: FloatArray) -> FloatArray:
    share = (1.0 - np.exp(-depth_m / _HAZE_M))[:, None]
    return np.asarray(np.rint(colours * (1 - share) + np.array(HAZE) * share))


def _stations(road: Road, rail: Rail) -> tuple[Rail, FloatArray]:
    first_m, last_m = max(rail.from_m, road.first_m), min(rail.to_m, road.last_m)
    return rail, np.linspace(first_m, last_m, max(2, round((last_m - first_m) / _POST_SPACING_M) + 1))


def _lamp_stations(stations: FloatArray) -> FloatArray:
    return np.arange(stations[0] + 6.0, stations[-1], _LAMP_SPACING_M)


def _rail_faces(road: Road, runs: list[tuple[Rail, FloatArray]]) -> Faces:
    found = []
    for rail, stations in runs:
        line = road.across(stations, rail.offset_m)
        # Every piece a little different, so that the eye can see them pass.
        tone = stream(_WORLD_SEED, "rail").uniform(-6, 6, len(line) - 1)[:, None]
        found += [
            Faces(_upright(line[:-1], line[1:], low_m, high_m), np.array(colour) + tone, np.full(len(tone), seen_to_m))
            for low_m, high_m, colour, seen_to_m in _BANDS[rail.kind]
        ]
    return _join_faces(found)


def _lamp_faces(road: Road, runs: list[tuple[Rail, FloatArray]]) -> Faces:
    """Make the arms of lamp posts, to both sides."""
    found = []
    for rail, stations in runs:
        if rail.kind == "barrier":
            places = _lamp_stations(stations)
            ends = road.across(places, rail.offset_m - 1.8), road.across(places, rail.offset_m + 1.8)
            corners = _upright(*ends, 9.35, 9.55)
            found.append(Faces(corners, np.full((len(corners), 3), 104.0), np.full(len(corners), _FAR_M)))
    return _join_faces(found)


def _upright(begin: FloatArray, end: FloatArray, low_m: float, high_m: float) -> FloatArray:
    low, high = np.full(len(begin), low_m), np.full(len(begin), high_m)
    corners = [(begin, low), (end, low), (end, high), (begin, high)]
    return np.stack([np.column_stack(corner) for corner in corners], axis=1)


def _join_faces(faces: list[Faces]) -> Faces:
    return Faces(
        np.concatenate([np.empty((0, 4, 3)), *(each.corners_m for each in faces)]),
        np.concatenate([np.empty((0, 3)), *(each.colours for each in faces)]),
        np.concatenate([np.empty(0), *(each.seen_to_m for each in faces)]),
    )


def _poles(road: Road, runs: list[tuple[Rail, FloatArray]], *, lamps: bool) -> FloatArray:
    """Place posts of rails and lamp posts on barriers, (n, 5): x, y, foot, top, width in metres."""
    poles = [np.empty((0, 5))]
    for rail, stations in runs:
        if rail.kind == "rail":
            place, shape = road.across(stations, rail.offset_m), (0.0, 0.72, 0.12)
        elif lamps:
            place, shape = road.across(_lamp_stations(stations), rail.offset_m), (0.8, 9.5, 0.16)
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
    places = _free_places(road, "tree places", 340, clear_m=6.0)
    random = stream(_WORLD_SEED, "tree shapes")
    kinds = random.integers(0, TREE_KINDS, len(places))
    heights = np.where(
        kinds == TREE_KINDS - 1, random.uniform(1.2, 2.6, len(places)), random.uniform(5.5, 12.0, len(places))
    )
    return np.column_stack([places, heights, kinds])


def _build(road: Road) -> Walls:
    random = stream(_WORLD_SEED, "building shapes")
    outlines, colours, windows = [], [], []
    for place in _free_places(road, "building places", 26, clear_m=24.0):
        length_m, width_m, storeys = random.uniform(14, 34), random.uniform(10, 16), int(random.integers(2, 7))
        heading_rad = random.uniform(0, math.pi)
        colour = np.array(_FACADES[int(random.integers(0, len(_FACADES)))])
        forward = np.array([math.cos(heading_rad), math.sin(heading_rad)]) * length_m / 2
        left = np.array([-math.sin(heading_rad), math.cos(heading_rad)]) * width_m / 2
        corners = np.array([forward - left, forward + left, -forward + left, -forward - left]) + place
        for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            columns = max(2, round(float(np.hypot(*(end - begin))) / 3.0))
            first = (np.arange(columns) + 0.25) / columns
            sill = np.linspace(1.0, 1.0 + _STOREY_M * (storeys - 1), storeys)
            windows.append(_panels(begin, end, shares=(first, first + 0.5 / columns), heights_m=(sill, sill + 1.5)))
            whole, height_m = (np.zeros(1), np.ones(1)), (np.zeros(1), np.full(1, _STOREY_M * storeys))
            outlines.append(_panels(begin, end, shares=whole, heights_m=height_m)[0])
            sunny = abs(end[0] - begin[0]) > abs(end[1] - begin[1])
            colours.append(colour * (1.0 if sunny else 0.82))
    return Walls(np.array(outlines).reshape(-1, 4, 3), np.array(colours).reshape(-1, 3), tuple(windows))


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
