"""The centre line of a sequence of lanes, in the direction of driving."""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from lavt.opendrive.lanes import all_edges_m, lane_edges, lane_point
from lavt.opendrive.road_map import CubicPieces, LaneSection, MapRoad, OpenDriveMap
from lavt.opendrive.routes import LaneStep

MIN_STEP_M = 1e-6
"""Shorter lane sections are left out."""

_JUST_M = 1e-7


class PathPose(NamedTuple):
    """A point of a lane's centre with the direction of driving."""

    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True)
class PathStep:
    """A lane within one lane section, as a part of a path."""

    road: MapRoad
    section_index: int
    lane: int
    begin_m: float
    """The distance along the path at which the lane is entered."""
    end_m: float

    @property
    def section(self) -> LaneSection:
        """The lane section."""
        return self.road.sections[self.section_index]

    @cached_property
    def forward(self) -> bool:
        """Whether the lane is driven towards larger stations."""
        return self.road.drives_forward(self.lane)

    def station_m(self, path_m: float) -> float:
        """Return the station of the road at a distance along the path."""
        along_m = min(max(path_m - self.begin_m, 0.0), self.end_m - self.begin_m)
        station_m = self.section.s_m + along_m if self.forward else self.section.end_m - along_m
        return min(max(station_m, self.section.s_m), self.section.end_m)

    def path_m(self, station_m: float) -> float:
        """Return the distance along the path at a station of the road."""
        along_m = station_m - self.section.s_m if self.forward else self.section.end_m - station_m
        return self.begin_m + along_m

    def pose(self, path_m: float) -> PathPose:
        """Return the lane's centre."""
        point = lane_point(self.road, self.lane, self.station_m(path_m), self.section_index)
        turn_rad = 0.0 if self.forward else math.pi
        return PathPose(point.x_m, point.y_m, math.remainder(point.heading_rad + turn_rad, 2 * math.pi))

    def width_m(self, path_m: float) -> float:
        """Return the lane's width."""
        inner, outer = lane_edges(self.section, self.lane, self.station_m(path_m), f"road {self.road.number}")
        return abs(outer[0] - inner[0])

    def edge_offsets_m(self, path_m: float) -> dict[int, float]:
        """Return the outer edge of every lane of the section, and lane 0, as offsets from the path, left positive."""
        edges_m = all_edges_m(self.section, self.station_m(path_m))
        inner_lane = self.lane - 1 if self.lane > 0 else self.lane + 1
        centre_m = (edges_m[inner_lane] + edges_m[self.lane]) / 2
        sign = 1.0 if self.forward else -1.0
        return {lane: sign * (edge_m - centre_m) for lane, edge_m in edges_m.items()}

    def breaks_m(self) -> Iterator[float]:
        """Yield the distances along the path at which the shape of the centre line may change."""
        section, road = self.section, self.road
        yield from (self.begin_m, self.end_m)
        inner_lanes = range(self.lane, 0, -1 if self.lane > 0 else 1)
        entries: list[CubicPieces] = [pieces for n in inner_lanes for pieces in _pieces(section, n)]
        stations_m = itertools.chain(
            road.shape_breaks_m(section.s_m, section.end_m),
            (section.s_m + begin_m for pieces in entries for begin_m in pieces.begins_m),
        )
        yield from (self.path_m(s_m) for s_m in stations_m if section.s_m < s_m < section.end_m)


class LanePath:
    """The centre line of lanes that are driven one after the other.

    A position on it is the sum of the lengths of reference lines up to there, which is not the arc length of the centre
    line.
    """

    def __init__(self, road_map: OpenDriveMap, steps: Sequence[LaneStep]) -> None:
        self.steps: list[PathStep] = []
        at_m = 0.0
        for step in steps:
            section = road_map.roads[step.road].sections[step.section_index]
            length_m = section.end_m - section.s_m
            if length_m > MIN_STEP_M:
                self.steps.append(
                    PathStep(road_map.roads[step.road], step.section_index, step.lane, at_m, at_m + length_m)
                )
                at_m += length_m
        self.length_m = at_m
        self._begins_m = [step.begin_m for step in self.steps]

    def step(self, path_m: float) -> PathStep:
        """Return the lane at a distance along the path; where two meet, the second."""
        return self.steps[max(bisect_right(self._begins_m, path_m) - 1, 0)]

    def pose(self, path_m: float) -> PathPose:
        """Return the centre line's pose; at a break, that of the part that begins there."""
        return self.step(path_m).pose(path_m)

    def mean_pose(self, path_m: float) -> PathPose:
        """Return the mean of the centre line's poses just before and just after a point.

        Maps are rounded, so that an element often ends a little beside the beginning of the next one.
        """
        before = self.pose(max(path_m - _JUST_M, 0.0))
        after = self.pose(min(path_m + _JUST_M, self.length_m))
        turn_rad = math.remainder(after.heading_rad - before.heading_rad, 2 * math.pi)
        return PathPose((before.x_m + after.x_m) / 2, (before.y_m + after.y_m) / 2, before.heading_rad + turn_rad / 2)

    def breaks_m(self) -> list[float]:
        """Return the sorted distances at which the shape of the centre line may change, with both ends."""
        return sorted({at_m for step in self.steps for at_m in step.breaks_m()})


def _pieces(section: LaneSection, lane: int) -> tuple[CubicPieces, CubicPieces]:
    return section.lanes[lane].widths, section.lanes[lane].borders
