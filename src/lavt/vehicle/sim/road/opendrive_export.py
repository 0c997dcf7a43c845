"""Write a road as an OpenDRIVE map (version 1.4) of one road.

The reference line is the centre of the driven lane, from the beginning of the run-in on, and the lane offset moves lane
0 to the left edge of the leftmost lane. So all lanes are right lanes: the leftmost is lane -1.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

from lavt.vehicle.sim.road.centreline import Segment
from lavt.vehicle.sim.road.cross_section import PavedArea, RoadMark
from lavt.vehicle.sim.road.road import Road

MARK_TOLERANCE_M = 0.15
"""A mark this near to the edge of a lane is the mark of that edge."""

_TOUCH_M = 1e-6


class ExportedRoad(NamedTuple):
    """A road as OpenDRIVE."""

    text: str
    start_m: float
    """The station s of the map at which the route starts."""
    lane: int
    """The number of the driven lane in the map."""
    notes: tuple[str, ...]
    """Sentences on what the map does not have."""


def export_road(road: Road) -> ExportedRoad:
    """Return a road as the text of an OpenDRIVE file."""
    length_m = road.last_m - road.first_m
    knots_m = _knots_m(road)
    widths = [_lane_widths(road, knots_m, lane) for lane in range(len(road.lanes.widths_m))]
    shoulders = [_shoulder_widths(road, knots_m, side) for side in (1, -1)]
    marks = _edge_marks(road)
    left = f"<left>{_lane(1, 'shoulder', shoulders[0], '')}</left>" if _has_width(shoulders[0]) else ""
    right = "".join(
        _lane(-1 - lane, "driving", entries, _mark_elements(road, marks[lane + 1]))
        for lane, entries in enumerate(widths)
    )
    if _has_width(shoulders[1]):
        right += _lane(-1 - len(widths), "shoulder", shoulders[1], "")
    offsets = _entries(road, knots_m, [road.lanes.edges_at(s_m)[-1] for s_m in knots_m])
    offset_elements = "".join(f"<laneOffset s={_number(s_m)} {_cubic(a, b)}/>\n" for s_m, a, b in offsets)
    name = quoteattr("".join(filter(str.isprintable, road.title)))  # XML cannot hold control characters
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<OpenDRIVE>
<header revMajor="1" revMinor="4" name={name} version="1.00"/>
<road name={name} length={_number(length_m)} id="1" junction="-1">
<link/>
<type s="0" type="town"/>
<planView>
{"".join(_geometry(road))}</planView>
<lanes>
{offset_elements}<laneSection s="0">
{left}<center><lane id="0" type="none" level="false"><link/>{_mark_elements(road, marks[0])}</lane></center>
<right>
{right}</right>
</laneSection>
</lanes>
</road>
</OpenDRIVE>
"""
    return ExportedRoad(text, -road.first_m, -1 - road.lanes.driven, tuple(_left_out(road, marks)))


def _left_out(road: Road, marks: Sequence[Sequence[RoadMark]]) -> Iterator[str]:
    """Yield a sentence for each kind of content that is left out."""
    count = len(road.marks) - len({id(mark) for edge in marks for mark in edge})
    if count:
        yield f"marks that are not on an edge of a lane are left out: {count}"
    if road.rails:
        yield f"rails and barriers are left out: {len(road.rails)}"
    reached = [_reach_m(road, 0.0, side) for side in (1, -1)]
    if any(strip.left_m < reached[1] or strip.right_m > reached[0] for strip in road.paved):
        yield "asphalt that does not adjoin the lanes is left out"


def _knots_m(road: Road) -> list[float]:
    """Return the stations at which widths of lanes or asphalt may change their course, from the first to the last."""
    ends_m = (end_m for strip in road.paved for end_m in (strip.from_m, strip.to_m))
    inside = {s_m for s_m in (*road.lanes.knots_m, *ends_m) if road.first_m < s_m < road.last_m}
    return sorted({road.first_m, road.last_m, *inside})


def _geometry(road: Road) -> Iterator[str]:
    """Yield the elements of the plan view."""
    s_m = road.first_m
    for segment in road.segments:
        if segment.length_m > 0.0:
            x_m, y_m, heading_rad, _ = (float(value) for value in road.centre_at(s_m))
            pose = f"x={_number(x_m)} y={_number(y_m)} hdg={_number(heading_rad)} length={_number(segment.length_m)}"
            yield f"<geometry s={_number(s_m - road.first_m)} {pose}>{_shape(segment)}</geometry>\n"
        s_m += segment.length_m


def _shape(segment: Segment) -> str:
    begin, end = segment.curvature_per_m, segment.end_curvature_per_m
    if begin != end:
        return f"<spiral curvStart={_number(begin)} curvEnd={_number(end)}/>"
    return f"<arc curvature={_number(begin)}/>" if begin else "<line/>"


def _entries(road: Road, knots_m: Sequence[float], values: Sequence[float]) -> list[tuple[float, float, float]]:
    """Return linear pieces of values at knots: the station from the road's beginning, the value and its slope."""
    pieces = zip(itertools.pairwise(knots_m), itertools.pairwise(values), strict=True)
    return _without_repetition(
        [(from_m - road.first_m, begin, (end - begin) / (to_m - from_m)) for (from_m, to_m), (begin, end) in pieces]
    )


def _without_repetition(entries: list[tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    """Leave out entries that continue a constant value."""
    kept = entries[:1]
    for entry in entries[1:]:
        if entry[1:] != kept[-1][1:] or entry[2]:
            kept.append(entry)
    return kept


def _lane_widths(road: Road, knots_m: Sequence[float], lane: int) -> list[tuple[float, float, float]]:
    edges_m = [road.lanes.edges_at(s_m) for s_m in knots_m]
    return _entries(road, knots_m, [max(edges[-1 - lane] - edges[-2 - lane], 0.0) for edges in edges_m])


def _shoulder_widths(road: Road, knots_m: Sequence[float], side: int) -> list[tuple[float, float, float]]:
    """Return the widths of the asphalt beyond the lanes on one side: 1 is left, -1 is right."""
    entries = []
    edge = -1 if side > 0 else 0
    for from_m, to_m in itertools.pairwise(knots_m):
        middle_m = (from_m + to_m) / 2
        there = [strip for strip in road.paved if strip.from_m <= middle_m <= strip.to_m]
        begin, end = (
            max(side * (_reach_m(road, s_m, side, there) - road.lanes.edges_at(s_m)[edge]), 0.0)
            for s_m in (from_m, to_m)
        )
        entries.append((from_m - road.first_m, round(begin, 6), round(end - begin, 6) / (to_m - from_m)))
    return _without_repetition(entries)


def _has_width(entries: Sequence[tuple[float, float, float]]) -> bool:
    return any(width_m or slope for _, width_m, slope in entries)


def _reach_m(road: Road, s_m: float, side: int, strips: Sequence[PavedArea] | None = None) -> float:
    """Return the offset up to which asphalt continues from the edge of the lanes to one side."""
    if strips is None:
        strips = [strip for strip in road.paved if strip.from_m <= s_m <= strip.to_m]
    edges_m = [(float(strip.left_at(s_m)), float(strip.right_at(s_m))) for strip in strips]
    reach_m = road.lanes.edges_at(s_m)[-1 if side > 0 else 0]
    for left_m, right_m in sorted(edges_m, key=lambda edges: side * edges[0 if side < 0 else 1]):
        if right_m - _TOUCH_M <= reach_m <= left_m + _TOUCH_M:
            reach_m = max(reach_m, left_m) if side > 0 else min(reach_m, right_m)
    return reach_m


def _edge_marks(road: Road) -> list[list[RoadMark]]:
    """Return the marks on the edges of lanes, the leftmost edge first; each list is sorted by the beginning."""
    edges: list[list[RoadMark]] = [[] for _ in range(len(road.lanes.widths_m) + 1)]
    for mark in sorted(road.marks, key=lambda mark: mark.from_m):
        ends_m = max(mark.from_m, road.first_m), min(mark.to_m, road.last_m)
        distances_m = [
            max(abs(float(mark.offset_at(s_m)) - road.lanes.edges_at(s_m)[-1 - edge]) for s_m in ends_m)
            for edge in range(len(edges))
        ]
        nearest = min(range(len(edges)), key=distances_m.__getitem__)
        if distances_m[nearest] <= MARK_TOLERANCE_M:
            edges[nearest].append(mark)
    return edges


def _mark_elements(road: Road, marks: Sequence[RoadMark]) -> str:
    """Return the marks of an edge as elements, with `none` in between."""
    elements, end_m = [], road.first_m
    for mark in marks:
        from_m = max(mark.from_m, road.first_m)
        if from_m > end_m:
            elements.append(f'<roadMark sOffset={_number(end_m - road.first_m)} type="none" color="white"/>')
        elements.append(
            f'<roadMark sOffset={_number(from_m - road.first_m)} type="{mark.kind}" weight="standard" '
            f'color="{mark.colour}" width={_number(mark.width_m)}/>'
        )
        end_m = mark.to_m
    if end_m < road.last_m:
        elements.append(f'<roadMark sOffset={_number(end_m - road.first_m)} type="none" color="white"/>')
    return "".join(elements)


def _lane(number: int, kind: str, widths: Sequence[tuple[float, float, float]], marks: str) -> str:
    entries = "".join(f"<width sOffset={_number(s_m)} {_cubic(a, b)}/>" for s_m, a, b in widths)
    return f'<lane id="{number}" type="{kind}" level="false"><link/>{entries}{marks}</lane>\n'


def _cubic(a: float, b: float) -> str:
    return f'a={_number(a)} b={_number(b)} c="0" d="0"'


def _number(value: float) -> str:
    """Return a number as an attribute."""
    return f'"{round(value, 12) + 0.0!r}"'
