"""Make a road file of a sequence of lanes of an OpenDRIVE map."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np
import yaml

from lavt.domain import FloatArray
from lavt.errors import UserError
from lavt.opendrive.clothoid_fit import fit_clothoids
from lavt.opendrive.geometry import Clothoid
from lavt.opendrive.lane_path import LanePath
from lavt.opendrive.road_map import OpenDriveMap
from lavt.opendrive.routes import find_route
from lavt.vehicle.sim.road.lane_surroundings import Surroundings
from lavt.vehicle.sim.road.road import Road, parse_road
from lavt.vehicle.sim.road.road_keys import (
    MAX_COORDINATE_M,
    MAX_CURVATURE_PER_M,
    MAX_LENGTH_M,
    MAX_MARKS,
    MAX_STRIPS,
    MIN_ROUTE_M,
)

STEP_M = 0.5
MIN_WIDTH_M, MAX_WIDTH_M = 0.5, 20.0
"""The narrowest and the widest driven lane."""


class ImportedRoad(NamedTuple):
    """A road file, made of lanes of a map."""

    text: str
    road: Road
    path: LanePath
    shift_m: tuple[float, float]
    """What was subtracted from the map's coordinates."""
    deviation_m: float
    """The largest distance between the map's and the road's centre line, at steps of 0.5 m."""
    notes: tuple[str, ...]
    """Sentences on what differs from the map."""


def import_lanes(road_map: OpenDriveMap, start: tuple[str, int], goal: tuple[str, int]) -> ImportedRoad:
    """Return a road that follows lanes from one (road, lane) to another.

    Raises UserError if no lanes join the two, or if they cannot be a road of LAVT.
    """
    path = LanePath(road_map, find_route(road_map, start, goal))
    _check_length(path)
    _check_width(path)
    notes = list(road_map.ignored)
    first = path.mean_pose(0.0)
    shift_m = (0.0, 0.0)
    if max(abs(first.x_m), abs(first.y_m)) > MAX_COORDINATE_M:
        shift_m = (first.x_m, first.y_m)
        notes.append(f"the map's coordinates are too large: {first.x_m:.4f}, {first.y_m:.4f} m was subtracted")
    name = PurePath(road_map.source).stem[:40]
    keys: dict[str, Any] = {
        "title": f"{name}: {start[0]},{start[1]} to {goal[0]},{goal[1]}"[:100],
        "origin": {
            "x_m": round(first.x_m - shift_m[0], 6),
            "y_m": round(first.y_m - shift_m[1], 6),
            "heading_rad": round(first.heading_rad, 10),
        },
        "segments": [_segment_keys(clothoid) for clothoid in fit_clothoids(path, MAX_CURVATURE_PER_M)],
    }
    source = f"the road of these lanes of {road_map.source}"
    centre = parse_road(_to_yaml({**keys, "lanes": {"widths_m": [0.5]}}, "", []), source)
    path_m = np.array(sample_path(path))
    stations_m, deviation_m = _follow(path, path_m, centre, shift_m)
    surroundings = Surroundings(path, centre, path_m, stations_m)
    keys |= {"lanes": surroundings.lanes(), "paved": surroundings.paved(), "marks": surroundings.marks()}
    if len(keys["marks"]) > MAX_MARKS or max(len(keys["paved"]), len(keys["lanes"].get("changes", ()))) > MAX_STRIPS:
        raise UserError("the lanes have more marks or changes of widths than a road file can hold: name fewer lanes")
    text = _to_yaml(keys, f"Imported from {PurePath(road_map.source).name!a}", notes)
    return ImportedRoad(text, parse_road(text, source), path, shift_m, deviation_m, tuple(notes))


def _check_length(path: LanePath) -> None:
    if path.length_m < MIN_ROUTE_M:
        raise UserError(
            f"the lanes are only {path.length_m:.1f} m long: a route needs {MIN_ROUTE_M:g} m, name more lanes"
        )
    if path.length_m > MAX_LENGTH_M:
        raise UserError(
            f"the lanes are {path.length_m:.0f} m long, and a road has at most {MAX_LENGTH_M:.0f} m: name fewer lanes"
        )


def _check_width(path: LanePath) -> None:
    for at_m in sample_path(path):
        step = path.step(at_m)
        width_m = step.width_m(at_m)
        if not MIN_WIDTH_M <= width_m <= MAX_WIDTH_M:
            raise UserError(
                f"road {step.road.number} lane {step.lane} is {width_m:.2f} m wide at s={step.station_m(at_m):.1f} m: "
                f"choose lanes of {MIN_WIDTH_M:g} to {MAX_WIDTH_M:g} m"
            )


def sample_path(path: LanePath) -> list[float]:
    """Return distances along a path at steps of at most 0.5 m."""
    distances: list[float] = np.linspace(0.0, path.length_m, int(path.length_m / STEP_M) + 2).tolist()
    return distances


def _follow(path: LanePath, path_m: FloatArray, road: Road, shift_m: tuple[float, float]) -> tuple[FloatArray, float]:
    """Return the stations of the road at distances along the path, and its largest distance from the path."""
    near_m = deviation_m = 0.0
    stations_m = []
    for at_m in path_m.tolist():
        pose = path.pose(at_m)
        near_m, offset_m, _ = road.project(pose.x_m - shift_m[0], pose.y_m - shift_m[1], near_m)
        deviation_m = max(deviation_m, abs(offset_m))
        stations_m.append(near_m)
    return np.maximum.accumulate(np.array(stations_m)), deviation_m


def _segment_keys(clothoid: Clothoid) -> dict[str, float]:
    keys = {"length_m": round(clothoid.length_m, 6)}
    begin, end = round(clothoid.curvature_per_m, 12), round(clothoid.end_curvature_per_m, 12)
    if begin or end:
        keys["curvature_per_m"] = begin
    if begin != end:
        keys["end_curvature_per_m"] = end
    return keys


def _to_yaml(keys: dict[str, Any], title: str, notes: list[str]) -> str:
    body = yaml.safe_dump(keys, sort_keys=False, allow_unicode=True, width=120, default_flow_style=None)
    return "".join(f"# {line}\n" for line in (f"{title}.", *(f"{note}." for note in notes))) + body
