"""Sequences of lanes along the direction of driving, through junctions."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import Literal, NamedTuple

from lavt.errors import UserError
from lavt.opendrive.road_map import MapRoad, OpenDriveMap, RoadLink

MAX_STARTS = 20
"""A route is searched from at most so many sections of the lane where it begins."""


class LaneStep(NamedTuple):
    """A lane within one lane section of a road."""

    road: str
    section_index: int
    lane: int


def find_route(road_map: OpenDriveMap, start: tuple[str, int], goal: tuple[str, int]) -> list[LaneStep]:
    """Return the shortest sequence of lanes from one (road, lane) to another, without changes of lane.

    It begins where vehicles enter the lane `start`, and ends where they leave the lane `goal`. Where a lane's number
    means another lane in a later section of the road, the first section from which a way leads counts, and the last
    section to which it leads.
    """
    firsts, lasts = _steps_of_lane(road_map, *start), _steps_of_lane(road_map, *goal)
    for first in firsts[:MAX_STARTS]:
        steps = _search(road_map, first, lasts)
        if steps is not None:
            return steps
    raise UserError(
        f"{road_map.source}: no way leads from road {start[0]} lane {start[1]} to road {goal[0]} lane {goal[1]} "
        "without a change of lane: name lanes that are joined in the direction of driving"
    )


def _search(road_map: OpenDriveMap, first: LaneStep, lasts: list[LaneStep]) -> list[LaneStep] | None:
    """Return the shortest sequence of lanes to the last of the goals that can be reached, or None."""
    came_from: dict[LaneStep, LaneStep | None] = {}
    queue: list[tuple[float, LaneStep, LaneStep | None]] = [(0.0, first, None)]
    while queue:
        length_m, step, previous = heapq.heappop(queue)
        if step in came_from:
            continue
        came_from[step] = previous
        if step == lasts[-1]:
            break
        section = road_map.roads[step.road].sections[step.section_index]
        length_m += section.end_m - section.s_m
        for following in next_steps(road_map, step):
            if following not in came_from:
                heapq.heappush(queue, (length_m, following, step))
    reached = [last for last in lasts if last in came_from]
    return _walk_back(came_from, reached[-1]) if reached else None


def next_steps(road_map: OpenDriveMap, step: LaneStep) -> Iterator[LaneStep]:
    """Yield the lanes that a vehicle can enter at the end of a lane."""
    road = road_map.roads[step.road]
    forward = road.drives_forward(step.lane)
    lane = road.sections[step.section_index].lanes[step.lane]
    number = lane.successor if forward else lane.predecessor
    following_index = step.section_index + (1 if forward else -1)
    if 0 <= following_index < len(road.sections):
        if number is not None and number in road.sections[following_index].lanes:
            yield LaneStep(road.number, following_index, number)
        return
    link = road.successor if forward else road.predecessor
    if link is None:
        return
    if link.contact is not None:
        if number is not None:
            yield from _enter(road_map, link.target, number, link.contact)
        return
    leaving: Literal["start", "end"] = "end" if forward else "start"
    for connection in road_map.connections(link.target, road.number):
        if _joins(road_map, connection.connecting, connection.contact, road, leaving):
            for from_lane, to_lane in connection.lane_links:
                if from_lane == step.lane:
                    yield from _enter(road_map, connection.connecting, to_lane, connection.contact)


def _joins(road_map: OpenDriveMap, connecting: str, contact: str, road: MapRoad, leaving: str) -> bool:
    """Return whether a connecting road begins at the end `leaving` of a road.

    The road's other end may lie in the same junction.
    """
    other = road_map.roads.get(connecting)
    if other is None:
        return False
    link: RoadLink | None = other.predecessor if contact == "start" else other.successor
    return link is None or link.contact is None or (link.target, link.contact) == (road.number, leaving)


def _enter(road_map: OpenDriveMap, number: str, lane: int, contact: Literal["start", "end"]) -> Iterator[LaneStep]:
    """Yield the lane at an end of a road, if it exists there and vehicles drive away from this end."""
    road = road_map.roads.get(number)
    if road is None or lane == 0 or road.drives_forward(lane) != (contact == "start"):
        return
    index = 0 if contact == "start" else len(road.sections) - 1
    if lane in road.sections[index].lanes:
        yield LaneStep(number, index, lane)


def _steps_of_lane(road_map: OpenDriveMap, number: str, lane: int) -> list[LaneStep]:
    """Return the steps of all sections that have a lane, in the direction of driving."""
    road = road_map.road(number)
    steps = [LaneStep(number, index, lane) for index, section in enumerate(road.sections) if lane in section.lanes]
    if not steps or lane == 0:
        numbers = sorted({item for section in road.sections for item in section.lanes if item})
        raise UserError(f"road {number} has no lane {lane}: name one of {', '.join(map(str, numbers))}")
    return steps if road.drives_forward(lane) else steps[::-1]


def _walk_back(came_from: dict[LaneStep, LaneStep | None], step: LaneStep) -> list[LaneStep]:
    steps = [step]
    while (previous := came_from[steps[-1]]) is not None:
        steps.append(previous)
    return steps[::-1]
