"""Roadside objects: rails and barriers, lamp posts, trees and buildings.

The positions and shapes of the objects are the same in every run and with every setting of `vehicle.light`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lavt.domain import FloatArray
from lavt.streams import stream
from lavt.vehicle.sim.rendering.sprites import TREE_KINDS
from lavt.vehicle.sim.road.cross_section import Rail
from lavt.vehicle.sim.road.road import Road

FAR_M = 160.0
"""The distance beyond which nothing is drawn."""

_WORLD_SEED = 0
_DETAIL_VISIBLE_TO_M = 45.0
_POST_SPACING_M = 4.0
_LAMP_SPACING_M = 36.0
_STOREY_M = 3.2
_SCENERY_WIDTH_M = 110.0
"""Trees and buildings are at most this far from the asphalt."""

_GROUND_PER_TREE_M2 = 480.0
_GROUND_PER_BUILDING_M2 = 6200.0

_RAIL_FACES: dict[str, tuple[tuple[float, float, tuple[int, int, int], float], ...]] = {
    "barrier": (
        (0.0, 0.86, (164, 170, 172), FAR_M),
        (0.0, 0.22, (132, 138, 140), _DETAIL_VISIBLE_TO_M),
        (0.78, 0.86, (190, 196, 198), _DETAIL_VISIBLE_TO_M),
    ),
    "rail": (
        (0.44, 0.76, (160, 158, 153), FAR_M),
        (0.53, 0.62, (108, 108, 106), _DETAIL_VISIBLE_TO_M),
        (0.62, 0.76, (178, 176, 170), _DETAIL_VISIBLE_TO_M),
    ),
}
"""The faces of each kind of rail in painting order: lower height (m), upper height (m), colour (blue, green, red), and
the distance (m) up to which the face is visible."""

_FACADES = ((158, 172, 190), (176, 182, 184), (120, 140, 168), (186, 200, 206))


@dataclass(frozen=True, slots=True)
class Faces:
    """Upright quadrilaterals."""

    corners_m: FloatArray
    """(n, 4, 3): low at the beginning, low at the end, high at the end, high at the beginning."""
    colours: FloatArray
    """(n, 3)."""
    normals: FloatArray
    """Horizontal unit vectors towards the road, (n, 2)."""
    visible_to_m: FloatArray
    """The distances up to which the faces are visible, (n,)."""


@dataclass(frozen=True, slots=True)
class Walls:
    """Walls of buildings."""

    outlines_m: FloatArray
    """(n, 4, 3), in the order of `Faces.corners_m`."""
    colours: FloatArray
    normals: FloatArray
    """Horizontal unit vectors away from the building, (n, 2)."""
    windows_m: tuple[FloatArray, ...]
    """The outlines of each wall's windows."""


_NO_WALLS = Walls(np.empty((0, 4, 3)), np.empty((0, 3)), np.empty((0, 2)), ())


@dataclass(frozen=True, slots=True)
class RoadsideObjects:
    """The objects along one road."""

    faces: Faces
    poles: FloatArray
    """(n, 5), in metres: x, y, height of the foot, height of the top, width."""
    trees: FloatArray
    """(n, 4): x (m), y (m), height (m), kind."""
    tree_road_rad: FloatArray
    """The heading of the road beside each tree, (n,)."""
    walls: Walls


def place_roadside_objects(road: Road, *, full_scenery: bool) -> RoadsideObjects:
    """Place a road's rails and barriers (two kinds of `Rail`) and, in full scenery, trees, lamp posts and buildings."""
    sampled_rails = [_rail_stations(road, rail) for rail in road.rails]
    placed_trees = _place_trees(road) if full_scenery else np.empty((0, 4))
    return RoadsideObjects(
        faces=_join_faces(
            [*_rail_faces(road, sampled_rails), *_lamp_faces(road, sampled_rails if full_scenery else [])]
        ),
        poles=_place_poles(road, sampled_rails, lamps=full_scenery),
        trees=placed_trees,
        tree_road_rad=_road_heading(road, placed_trees[:, :2]),
        walls=_place_buildings(road) if full_scenery else _NO_WALLS,
    )


def _rail_stations(road: Road, rail: Rail) -> tuple[Rail, FloatArray]:
    """Return a rail and the stations (n,) of its posts, which divide it into straight pieces."""
    first_m, last_m = max(rail.from_m, road.first_m), min(rail.to_m, road.last_m)
    return rail, np.linspace(first_m, last_m, max(2, round((last_m - first_m) / _POST_SPACING_M) + 1))


def _lamp_stations(stations: FloatArray) -> FloatArray:
    return np.arange(stations[0] + 6.0, stations[-1], _LAMP_SPACING_M)


def _rail_faces(road: Road, sampled_rails: Sequence[tuple[Rail, FloatArray]]) -> list[Faces]:
    faces = []
    for rail, stations in sampled_rails:
        line = road.point_at(stations, rail.offset_m)
        # Vary the tone of the pieces, so that the motion of a rail in the picture is visible.
        tone = stream(_WORLD_SEED, "rail").uniform(-6, 6, len(line) - 1)[:, None]
        normals = _left_normals(line[:-1], line[1:]) * (-1.0 if rail.offset_m > 0 else 1.0)
        for low_m, high_m, colour, visible_to_m in _RAIL_FACES[rail.kind]:
            corners = _upright_faces(line[:-1], line[1:], low_m, high_m)
            faces.append(Faces(corners, np.array(colour) + tone, normals, np.full(len(tone), visible_to_m)))
    return faces


def _lamp_faces(road: Road, sampled_rails: Sequence[tuple[Rail, FloatArray]]) -> list[Faces]:
    """Create the arms of lamp posts, which extend to both sides of a barrier."""
    faces = []
    for rail, stations in sampled_rails:
        if rail.kind == "barrier":
            places = _lamp_stations(stations)
            begin, end = road.point_at(places, rail.offset_m - 1.8), road.point_at(places, rail.offset_m + 1.8)
            corners = _upright_faces(begin, end, 9.35, 9.55)
            normals = _left_normals(begin, end)
            faces.append(Faces(corners, np.full((len(corners), 3), 104.0), normals, np.full(len(corners), FAR_M)))
    return faces


def _left_normals(begin: FloatArray, end: FloatArray) -> FloatArray:
    """Return unit vectors (n, 2) to the left, as seen in the direction from `begin` to `end`."""
    along = end - begin
    left = np.column_stack([-along[:, 1], along[:, 0]])
    return np.asarray(left / np.maximum(np.hypot(left[:, :1], left[:, 1:]), 1e-9))


def _upright_faces(begin: FloatArray, end: FloatArray, low_m: float, high_m: float) -> FloatArray:
    low, high = np.full(len(begin), low_m), np.full(len(begin), high_m)
    corners = [(begin, low), (end, low), (end, high), (begin, high)]
    return np.stack([np.column_stack(corner) for corner in corners], axis=1)


def _join_faces(parts: Sequence[Faces]) -> Faces:
    return Faces(
        np.concatenate([np.empty((0, 4, 3)), *(part.corners_m for part in parts)]),
        np.concatenate([np.empty((0, 3)), *(part.colours for part in parts)]),
        np.concatenate([np.empty((0, 2)), *(part.normals for part in parts)]),
        np.concatenate([np.empty(0), *(part.visible_to_m for part in parts)]),
    )


def _place_poles(road: Road, sampled_rails: Sequence[tuple[Rail, FloatArray]], *, lamps: bool) -> FloatArray:
    """Place the posts of rails, and with `lamps` also lamp posts on barriers."""
    poles = [np.empty((0, 5))]
    for rail, stations in sampled_rails:
        if rail.kind == "rail":
            place, shape = road.point_at(stations, rail.offset_m), (0.0, 0.72, 0.12)
        elif lamps:
            place, shape = road.point_at(_lamp_stations(stations), rail.offset_m), (0.8, 9.5, 0.16)
        else:
            continue
        poles.append(np.column_stack([place, np.tile(shape, (len(place), 1))]))
    return np.concatenate(poles)


def _road_middle(road: Road) -> tuple[FloatArray, FloatArray, float]:
    """Return points (n, 2) along the asphalt's middle, the road's heading there (n,), and half the asphalt's width."""
    left_m = max(max(strip.lefts_m) for strip in road.paved)
    right_m = min(min(strip.rights_m) for strip in road.paved)
    stations = np.arange(road.first_m - 40.0, road.last_m + 40.0, 4.0)
    return road.point_at(stations, (left_m + right_m) / 2), road.centre_at(stations).heading_rad, (left_m - right_m) / 2


def _road_heading(road: Road, places: FloatArray) -> FloatArray:
    middle, heading_rad, _ = _road_middle(road)
    nearest = ((places[:, None] - middle[None]) ** 2).sum(axis=-1).argmin(axis=1)
    return np.asarray(heading_rad[nearest], dtype=np.float64)


def _free_places(road: Road, name: str, ground_per_object_m2: float, clearance_m: float) -> FloatArray:
    """Return random positions around the road, none closer than `clearance_m` to the asphalt."""
    middle, _, half_width_m = _road_middle(road)
    low, high = middle.min(axis=0) - _SCENERY_WIDTH_M, middle.max(axis=0) + _SCENERY_WIDTH_M
    places = stream(_WORLD_SEED, name).uniform(low, high, (round(float(np.prod(high - low)) / ground_per_object_m2), 2))
    distance = np.full(len(places), np.inf)
    for x_m, y_m in middle:  # one point at a time: a table of all distances would be too large for a long road
        np.minimum(distance, np.hypot(places[:, 0] - x_m, places[:, 1] - y_m), out=distance)
    return np.asarray(places[(distance > half_width_m + clearance_m) & (distance < half_width_m + _SCENERY_WIDTH_M)])


def _place_trees(road: Road) -> FloatArray:
    places = _free_places(road, "tree places", _GROUND_PER_TREE_M2, clearance_m=6.0)
    random = stream(_WORLD_SEED, "tree shapes")
    kinds = random.integers(0, TREE_KINDS, len(places))
    heights = np.where(
        kinds == TREE_KINDS - 1, random.uniform(1.2, 2.6, len(places)), random.uniform(5.5, 12.0, len(places))
    )
    return np.column_stack([places, heights, kinds])


def _place_buildings(road: Road) -> Walls:
    random = stream(_WORLD_SEED, "building shapes")
    outlines, colours, normals, windows = [], [], [], []
    for place in _free_places(road, "building places", _GROUND_PER_BUILDING_M2, clearance_m=24.0):
        length_m, width_m, storeys = random.uniform(14, 34), random.uniform(10, 16), int(random.integers(2, 7))
        heading_rad = random.uniform(0, math.pi)
        colour = np.array(_FACADES[int(random.integers(0, len(_FACADES)))], dtype=np.float64)
        forward = np.array([math.cos(heading_rad), math.sin(heading_rad)]) * length_m / 2
        left = np.array([-math.sin(heading_rad), math.cos(heading_rad)]) * width_m / 2
        corners = np.array([forward - left, forward + left, -forward + left, -forward - left]) + place
        for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            columns = max(2, round(float(np.hypot(*(end - begin))) / 3.0))
            left_edge = (np.arange(columns) + 0.25) / columns
            sill = np.linspace(1.0, 1.0 + _STOREY_M * (storeys - 1), storeys)
            windows.append(
                _panels(begin, end, shares=(left_edge, left_edge + 0.5 / columns), heights_m=(sill, sill + 1.5))
            )
            whole, height_m = (np.zeros(1), np.ones(1)), (np.zeros(1), np.full(1, _STOREY_M * storeys + 0.5))
            outlines.append(_panels(begin, end, shares=whole, heights_m=height_m)[0])
            normals.append(-_left_normals(begin[None], end[None])[0])
            colours.append(colour)
    return Walls(
        np.array(outlines).reshape(-1, 4, 3),
        np.array(colours).reshape(-1, 3),
        np.array(normals).reshape(-1, 2),
        tuple(windows),
    )


def _panels(
    begin: FloatArray,
    end: FloatArray,
    *,
    shares: tuple[FloatArray, FloatArray],
    heights_m: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Return rectangles (n, 4, 3) on a wall, in columns and rows.

    The wall goes from `begin` to `end`. `shares` are where columns begin and end, as shares of the wall's length.
    `heights_m` are the low and high edges of the rows.
    """
    begin_shares, end_shares = shares
    column_begins = begin + begin_shares[:, None] * (end - begin)
    column_ends = begin + end_shares[:, None] * (end - begin)
    panels = [
        [[*column_begin, low], [*column_end, low], [*column_end, high], [*column_begin, high]]
        for low, high in zip(*heights_m, strict=True)
        for column_begin, column_end in zip(column_begins, column_ends, strict=True)
    ]
    return np.array(panels)
