"""Compare lanes with `carla.Map` of the genuine wheel, which works without a server.

python -m tests.opendrive.carla_comparison MAP.xodr ...
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from lavt.opendrive.lanes import lane_point
from lavt.opendrive.reader import read_map
from lavt.opendrive.road_map import MapRoad, OpenDriveMap
from lavt.vehicle.sim.road.lane_import import import_lanes, sample_path

STEP_M = 0.5
LARGE = 0.05
END_M = 1e-3
"""Positions this near to the ends of a lane section are left out: there, rounding decides which section counts."""


class Difference(NamedTuple):
    """A difference between LAVT and CARLA at the centre of a lane."""

    centre_m: float
    width_m: float
    heading_rad: float
    road: str
    lane: int
    s_m: float


def compare(path: str, kinds: tuple[str, ...] = ("driving",)) -> Iterator[Difference]:
    """Yield the differences for every lane of some kinds, at steps of 0.5 m."""
    carla: Any = importlib.import_module("carla")
    ours = read_map(path)
    theirs = carla.Map("map", Path(path).read_text(encoding="utf-8"))
    for road in ours.roads.values():
        for lane, s_m in _places(road, kinds):
            yield _difference(ours, theirs, road, lane, s_m)


def compare_import(path: str, start: tuple[str, int], goal: tuple[str, int]) -> Iterator[Difference]:
    """Yield the differences of an imported road's centre and width, at steps of 0.5 m along the lanes."""
    carla: Any = importlib.import_module("carla")
    theirs = carla.Map("map", Path(path).read_text(encoding="utf-8"))
    imported = import_lanes(read_map(path), start, goal)
    road, near_m = imported.road, 0.0
    for at_m in sample_path(imported.path):
        step = imported.path.step(at_m)
        s_m = step.station_m(at_m)
        if min(s_m - step.section.s_m, step.section.end_m - s_m) < END_M:
            continue
        waypoint = theirs.get_waypoint_xodr(int(step.road.number), step.lane, s_m)
        location = waypoint.transform.location
        shift_x_m, shift_y_m = imported.shift_m
        near_m, offset_m, heading_rad = road.project(location.x - shift_x_m, -location.y - shift_y_m, near_m)
        yaw_rad = -math.radians(waypoint.transform.rotation.yaw)
        yield Difference(
            abs(offset_m),
            abs(waypoint.lane_width - road.lanes.driven_width_at(near_m)),
            abs(math.remainder(yaw_rad - heading_rad, 2 * math.pi)),
            step.road.number,
            step.lane,
            s_m,
        )


def _places(road: MapRoad, kinds: tuple[str, ...]) -> Iterator[tuple[int, float]]:
    for section in road.sections:
        first_m, last_m = section.s_m + END_M, section.end_m - END_M
        if first_m > last_m:
            continue
        steps = int((last_m - first_m) / STEP_M)
        for lane in section.lanes.values():
            if lane.number and lane.kind in kinds:
                yield from ((lane.number, first_m + index * STEP_M) for index in range(steps + 1))
                yield lane.number, last_m


def _difference(ours: OpenDriveMap, theirs: Any, road: MapRoad, lane: int, s_m: float) -> Difference:
    waypoint = theirs.get_waypoint_xodr(int(road.number), lane, s_m)
    if waypoint is None:
        return Difference(math.inf, math.inf, math.inf, road.number, lane, s_m)
    point = lane_point(ours.roads[road.number], lane, s_m)
    transform = waypoint.transform
    heading_rad = -math.radians(transform.rotation.yaw) + (0.0 if road.drives_forward(lane) else math.pi)
    return Difference(
        math.hypot(transform.location.x - point.x_m, -transform.location.y - point.y_m),
        abs(waypoint.lane_width - point.width_m),
        abs(math.remainder(heading_rad - point.heading_rad, 2 * math.pi)),
        road.number,
        lane,
        s_m,
    )


def main() -> None:
    """Print the largest differences on each map."""
    for path in sys.argv[1:]:
        differences = list(compare(path))
        print(f"{Path(path).name}: {len(differences)} positions, ignored: {read_map(path).ignored}")
        for key in ("centre_m", "width_m", "heading_rad"):
            worst = max(differences, key=attrgetter(key))
            large = [item.road for item in differences if getattr(item, key) > LARGE]
            print(
                f"  {key}: largest {getattr(worst, key):.4f} at road {worst.road} lane {worst.lane} s={worst.s_m:.2f} m"
            )
            print(f"    {len(large)} of them over {LARGE}, on the roads {sorted(set(large))[:12]}")


if __name__ == "__main__":
    main()
