"""Positions on the reference line and in the lanes of a road."""

from __future__ import annotations

import math
from typing import NamedTuple

from lavt.errors import UserError
from lavt.opendrive.geometry import ReferencePoint, element_point
from lavt.opendrive.road_map import LaneSection, MapLane, MapRoad


class LanePoint(NamedTuple):
    """The centre of a lane at a station."""

    x_m: float
    y_m: float
    heading_rad: float
    """The direction of the lane's centre line towards larger stations, whatever the direction of driving."""
    width_m: float
    """The width across the reference line, as OpenDRIVE defines it."""
    t_m: float
    """The lateral position relative to the reference line."""


def reference_point(road: MapRoad, s_m: float) -> ReferencePoint:
    """Return the point of a road's reference line at a station."""
    return element_point(road.plan_element(s_m), road.check_station(s_m))


def lane_point(road: MapRoad, lane: int, s_m: float, section_index: int | None = None) -> LanePoint:
    """Return the centre of a lane at a station.

    Where two lane sections meet, the second one counts unless `section_index` names the other.
    """
    index = road.section_index(s_m) if section_index is None else section_index
    section = road.sections[index]
    s_m = road.check_station(s_m)
    inner, outer = lane_edges(section, lane, s_m, f"road {road.number}")
    offset_m, offset_slope = road.lane_offsets.value_and_slope(s_m)
    t_m = offset_m + (inner[0] + outer[0]) / 2
    slope = offset_slope + (inner[1] + outer[1]) / 2
    reference = element_point(road.plan_element(s_m), s_m)
    return LanePoint(
        reference.x_m - t_m * math.sin(reference.heading_rad),
        reference.y_m + t_m * math.cos(reference.heading_rad),
        reference.heading_rad + math.atan2(slope, 1.0 - reference.curvature_per_m * t_m),
        abs(outer[0] - inner[0]),
        t_m,
    )


def lane_edges(
    section: LaneSection, lane: int, s_m: float, where: str
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the inner and the outer edge of a lane, each as its distance to the left of lane 0 and its slope.

    A width below 0, which some maps have by rounding, counts as 0.
    """
    if lane not in section.lanes:
        numbers = ", ".join(map(str, sorted(section.lanes)))
        raise UserError(f"{where} has no lane {lane} at s={s_m:.3f} m: name one of {numbers}")
    side = 1 if lane > 0 else -1
    along_m = s_m - section.s_m
    inner = outer = (0.0, 0.0)
    for number in range(side, lane + side, side) if lane else ():
        inner, outer = outer, _outer_edge(section.lanes[number], outer, side, along_m)
    return inner, outer


def all_edges_m(section: LaneSection, s_m: float) -> dict[int, float]:
    """Return the outer edges of all lanes of a section as distances to the left of lane 0, which is among them."""
    edges_m = {0: 0.0}
    for side in (1, -1):
        edge, number = (0.0, 0.0), side
        while number in section.lanes:
            edge = _outer_edge(section.lanes[number], edge, side, s_m - section.s_m)
            edges_m[number] = edge[0]
            number += side
    return edges_m


def _outer_edge(lane: MapLane, inner: tuple[float, float], side: int, along_m: float) -> tuple[float, float]:
    """Return the outer edge of a lane and its slope, from the inner edge and its slope."""
    if lane.borders.cubics:
        border_m, border_slope = lane.borders.value_and_slope(along_m)
        width_m, slope = side * (border_m - inner[0]), side * (border_slope - inner[1])
    else:
        width_m, slope = lane.widths.value_and_slope(along_m)
    return (inner[0] + side * width_m, inner[1] + side * slope) if width_m > 0.0 else inner
