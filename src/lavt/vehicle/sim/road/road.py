"""A road as data: the centre of the driven lane as lines, arcs and clothoids, and the cross-section.

A station `s_m` is a distance along the centre of the driven lane, 0 at the route's start. A lateral offset is a
distance from this centre, left positive. Roads are flat. `docs/roads.md` describes road files.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lavt.domain import FloatArray
from lavt.errors import UserError
from lavt.vehicle.sim.road.centreline import Centreline, CentrelinePoints, Segment
from lavt.vehicle.sim.road.cross_section import Lanes, PavedArea, Rail, RoadMark, shift_stations
from lavt.vehicle.sim.road.random_road import random_road_number, random_road_text
from lavt.vehicle.sim.road.road_file import read_road_file
from lavt.vehicle.sim.road.road_keys import RoadFile

PROJECTION_WINDOW_M = 15.0
"""A projection searches this far before and behind the last known station. A search of the whole road could find
another part of the road."""


@dataclass(frozen=True)
class Road:
    """A road and the route on it.

    The route goes from station 0 to station `route_length_m`. The first segment begins before the route's start, at
    station `first_m`, where the pose is `origin` (x, y in m, heading in rad, world frame). The last segment ends beyond
    the route's end. Before the first and after the last segment the road is straight.
    """

    title: str
    origin: tuple[float, float, float]
    first_m: float
    route_length_m: float
    segments: tuple[Segment, ...]
    lanes: Lanes
    paved: tuple[PavedArea, ...]
    marks: tuple[RoadMark, ...]
    rails: tuple[Rail, ...]

    @cached_property
    def last_m(self) -> float:
        """The station where the last segment ends."""
        return self._centreline.last_m

    @cached_property
    def start(self) -> tuple[float, float, float]:
        """The pose of the route's start in the world frame: x, y (m) and heading (rad)."""
        x_m, y_m, heading_rad, _ = self.centre_at(0.0)
        return float(x_m), float(y_m), float(heading_rad)

    def centre_at(self, s_m: ArrayLike) -> CentrelinePoints:
        """Return the points of the driven lane's centre at the stations `s_m`, an array of any shape."""
        return self._centreline.sample(s_m)

    def point_at(self, s_m: ArrayLike, offset_m: ArrayLike) -> FloatArray:
        """Return world x, y (m) of the points at stations `s_m` and lateral offsets `offset_m`, shape (..., 2)."""
        x_m, y_m, heading_rad, _ = self.centre_at(s_m)
        offset = np.asarray(offset_m, dtype=np.float64)
        return np.stack([x_m - offset * np.sin(heading_rad), y_m + offset * np.cos(heading_rad)], axis=-1)

    def project(self, x_m: float, y_m: float, near_station_m: float) -> tuple[float, float, float]:
        """Project a position onto the lane's centre.

        The search covers the stations up to `PROJECTION_WINDOW_M` before and behind `near_station_m`. Returns the
        station (m) of the nearest point on the centre, the position's lateral offset (m, left positive), and the lane's
        heading (rad) at the nearest point.
        """
        window_m = PROJECTION_WINDOW_M
        return self._centreline.project(x_m, y_m, near_station_m - window_m, near_station_m + window_m)[:3]

    def sub_route(self, title: str, from_m: float, route_length_m: float) -> Road:
        """Return the same road with another route, which begins at station `from_m`."""
        return replace(
            self,
            title=title,
            first_m=self.first_m - from_m,
            route_length_m=route_length_m,
            lanes=self.lanes.shifted(from_m),
            paved=tuple(shift_stations(strip, from_m) for strip in self.paved),
            marks=tuple(
                replace(shift_stations(mark, from_m), dash_at_m=mark.dash_at_m - from_m) for mark in self.marks
            ),
            rails=tuple(shift_stations(rail, from_m) for rail in self.rails),
        )

    @cached_property
    def _centreline(self) -> Centreline:
        return Centreline(self.first_m, self.origin, self.segments)


def road_names() -> list[str]:
    """Return the sorted names of the roads that come with LAVT."""
    folder = resources.files("lavt") / "data" / "roads"
    return sorted(file.name.removesuffix(".yaml") for file in folder.iterdir() if file.name.endswith(".yaml"))


def load_road(name: str) -> Road:
    """Load the road that comes with LAVT under `name`, a random road (`random_1`), or the road file at that path.

    Raises `UserError` if there is no such road, or if its file is invalid.
    """
    return parse_road(*_read_text(name))


def parse_road(text: str, source: str) -> Road:
    """Parse a road from YAML text.

    Raises `UserError`, which names `source` and the key, if a key or a value is invalid. The key `part_of` names a road
    that comes with LAVT, or a file relative to the directory of `source`.
    """
    road_file = read_road_file(text, source)
    if isinstance(road_file, RoadFile):
        return _make_road(road_file)
    try:
        whole_file = read_road_file(*_read_text(_resolve_part_of(source, road_file.part_of)))
    except UserError as error:
        raise UserError(f"{source} is a part of {road_file.part_of}: {error}") from error
    if not isinstance(whole_file, RoadFile):
        raise UserError(f"{source}: {road_file.part_of} is itself a part of a road: name the whole road as part_of")
    whole = _make_road(whole_file)
    part_of, from_m = road_file.part_of, road_file.from_m
    available_m = whole.last_m - from_m
    if available_m <= 0.0:
        raise UserError(f"{source}: {part_of} ends at {whole.last_m:.1f} m: from_m must be less than this")
    if road_file.length_m > available_m:
        raise UserError(f"{source}: {part_of} has only {available_m:.1f} m from {from_m} m on: shorten length_m")
    return whole.sub_route(road_file.title, from_m, road_file.length_m)


def _make_road(road_file: RoadFile) -> Road:
    x_m, y_m, heading_rad = road_file.start
    before_start_m = road_file.run_in_m
    return Road(
        title=road_file.title,
        origin=(
            x_m - before_start_m * math.cos(heading_rad),
            y_m - before_start_m * math.sin(heading_rad),
            heading_rad,
        ),
        first_m=-before_start_m,
        route_length_m=road_file.route_length_m,
        segments=road_file.all_segments,
        lanes=road_file.lanes,
        paved=road_file.all_paved,
        marks=road_file.all_marks,
        rails=road_file.rails,
    )


def _read_text(name: str) -> tuple[str, str]:
    """Read a road file and return its text and its name for messages."""
    if name in road_names():
        file = resources.files("lavt") / "data" / "roads" / f"{name}.yaml"
        return file.read_text(encoding="utf-8"), f"{name}.yaml"
    number = random_road_number(name)
    if number is not None:
        return random_road_text(number), name
    if not name.endswith((".yaml", ".yml")):
        raise UserError(
            f"there is no road {name!r}: name one that comes with LAVT ({', '.join(road_names())}), a random one "
            "(random_1, random_2, ..) or a .yaml file"
        )
    try:
        return Path(name).read_text(encoding="utf-8"), name
    except OSError as error:
        raise UserError(f"the road {name} cannot be read ({error.strerror}): name an existing file") from error
    except ValueError as error:  # bytes that are not text, or a path with a null character
        raise UserError(f"the road {name} is not a text file ({error}): name a YAML file") from error


def _resolve_part_of(source: str, part_of: str) -> str:
    return (
        part_of
        if part_of in road_names() or random_road_number(part_of) is not None
        else str(Path(source).parent / part_of)
    )
