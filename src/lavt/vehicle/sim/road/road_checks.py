"""Checks of road files that concern more than one key."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

from lavt.vehicle.sim.road.road_keys import MAX_LENGTH_M, MIN_ROUTE_M, LaneKeys, RangeKeys, RoadFile

MIN_INNER_SHARE = 0.1
"""In a curve, the length of the road's inner edge must be at least this share of the length of the lane's centre."""

_TAPER_KEYS = ("to_offset_m", "to_left_m", "to_right_m")


def find_problems(road: RoadFile) -> Iterable[str]:
    """Yield the problems that concern more than one key."""
    problem = next(iter(_find_lane_problems(road.lane_keys)), None)
    if problem is not None:
        yield problem
        return
    if road.paved is not None and road.shoulders is not None:
        yield "paved defines all asphalt: leave out shoulders"
    begin_m, end_m = -road.run_in_m, road.segments_length_m + road.run_out_m
    for name, keys in _named_ranges(road):
        if keys.from_m >= keys.to_m:
            yield f"{name} goes from {keys.from_m} m to {keys.to_m} m: from_m must be less than to_m"
        if keys.to_m <= begin_m or keys.from_m >= end_m:
            yield f"{name} is not on the road, which lies from {begin_m} m to {end_m} m"
        tapers = [key for key in _TAPER_KEYS if getattr(keys, key, None) is not None]
        if tapers and not math.isfinite(keys.to_m - keys.from_m):
            yield f"{name} has {tapers[0]}, the offset at its end: give it from_m and to_m"
            return
    yield from _find_misplaced(road)
    if road.segments_length_m > MAX_LENGTH_M:
        yield f"the segments are {road.segments_length_m:.0f} m long: a road has at most {MAX_LENGTH_M / 1000:g} km"
    elif road.route_length_m < MIN_ROUTE_M:
        yield f"the segments are only {road.segments_length_m:g} m long: a route has at least {MIN_ROUTE_M:g} m"
    elif road.route_length_m > road.segments_length_m:
        segments = f"the segments are only {road.segments_length_m:.3f} m long"
        yield f"length_m is {road.route_length_m}, but {segments}: add to them"
    yield from _find_tight_curves(road)
    yield from _find_unpaved(road)


def _find_misplaced(road: RoadFile) -> Iterable[str]:
    """Yield the rails that are in the driven lane, and the strips whose edges are exchanged."""
    lanes = road.lanes
    for index, rail in enumerate(road.rails):
        stations_m = (rail.from_m, rail.to_m, *(s_m for s_m in lanes.knots_m if rail.from_m < s_m < rail.to_m))
        if abs(rail.offset_m) <= max(map(lanes.driven_width_at, stations_m)) / 2:
            yield f"rails.{index} is in the driven lane, at {rail.offset_m} m: move it out"
    for strip in road.all_paved:
        if strip.lefts_m[1] < strip.rights_m[1]:
            yield (
                f"a strip of paved has to_left_m {strip.lefts_m[1]} and to_right_m {strip.rights_m[1]}: left is the "
                "greater offset"
            )
        if strip.left_m < strip.right_m or (strip.left_m == strip.right_m and not strip.is_tapered):
            yield f"a strip of paved has left_m {strip.left_m} and right_m {strip.right_m}: left is the greater offset"


def _find_lane_problems(lanes: LaneKeys) -> Iterable[str]:
    """Yield the problems of lanes and of changes of their widths."""
    if lanes.driven >= len(lanes.widths_m):
        yield f"lanes.driven is {lanes.driven}, but lanes count from 0 to {len(lanes.widths_m) - 1}"
        return
    last_m = -math.inf
    widths_m = {
        "lanes": lanes.widths_m,
        **{f"lanes.changes.{i}": keys.widths_m for i, keys in enumerate(lanes.changes)},
    }
    for name, widths in widths_m.items():
        if len(widths) != len(lanes.widths_m):
            yield f"{name} has {len(widths)} widths_m for {len(lanes.widths_m)} lanes: give one for each lane"
        elif widths[lanes.driven] == 0.0:
            yield f"{name} has a width of 0 for the driven lane: only other lanes may begin or end"
    for index, change in enumerate(lanes.changes):
        if change.from_m >= change.to_m:
            yield f"lanes.changes.{index} goes from {change.from_m} m to {change.to_m} m: from_m must be less than to_m"
        if change.from_m < last_m:
            yield f"lanes.changes.{index} begins at {change.from_m} m, before the last one ends: sort them by from_m"
        last_m = change.to_m


def _named_ranges(road: RoadFile) -> Iterable[tuple[str, RangeKeys]]:
    """Yield each entry that has `from_m` and `to_m`, after its name for messages."""
    for section, entries in (("paved", road.paved), ("marks", road.marks), ("rails", road.rail_keys)):
        for index, keys in enumerate(entries or ()):
            yield f"{section}.{index}", keys


def _find_tight_curves(road: RoadFile) -> Iterable[str]:
    """Yield a problem for the first curve whose inner edge comes too close to the centre of the circle."""
    lanes = road.lanes
    elements: list[tuple[float, float, tuple[float, ...]]] = [
        *((mark.from_m, mark.to_m, mark.offsets_m) for mark in road.all_marks),
        *((rail.from_m, rail.to_m, (rail.offset_m,)) for rail in road.rails),
        *((strip.from_m, strip.to_m, strip.lefts_m + strip.rights_m) for strip in road.all_paved),
    ]
    end_m = 0.0
    for index, keys in enumerate(road.segments):
        segment, begin_m = keys.to_segment(), end_m
        end_m += segment.length_m
        offsets_m = [
            *(
                offset_m
                for from_m, to_m, ends_m in elements
                if from_m < end_m and to_m > begin_m
                for offset_m in ends_m
            ),
            *(
                edge_m
                for s_m in (begin_m, end_m, *(s_m for s_m in lanes.knots_m if begin_m < s_m < end_m))
                for edge_m in lanes.edges_at(s_m)
            ),
        ]
        for curvature_per_m in (segment.curvature_per_m, segment.end_curvature_per_m):
            reach_in_radii = max(offset_m * curvature_per_m for offset_m in offsets_m)
            if reach_in_radii > 1.0 - MIN_INNER_SHARE:
                radius_m = abs(1 / curvature_per_m)
                yield (
                    f"segments.{index} has a radius of {radius_m:.1f} m, but the road reaches "
                    f"{abs(reach_in_radii / curvature_per_m):.1f} m to the inside of the curve: "
                    "make one wider or the other narrower"
                )
                return


def _find_unpaved(road: RoadFile) -> Iterable[str]:
    """Yield a problem for the first part of the route on which the driven lane is not wholly on asphalt."""
    lanes, strips = road.lanes, road.all_paved
    strip_ends_m = (end_m for strip in strips for end_m in (strip.from_m, strip.to_m))
    ends_m = sorted({0.0, road.route_length_m, *strip_ends_m, *lanes.knots_m})
    for first_m, last_m in itertools.pairwise(end_m for end_m in ends_m if 0.0 <= end_m <= road.route_length_m):
        there = [strip for strip in strips if strip.from_m <= first_m and strip.to_m >= last_m]
        for s_m in (first_m, last_m):  # all offsets are linear in between
            half_width_m = lanes.driven_width_at(s_m) / 2
            covered_to_m = half_width_m  # the lane is on asphalt from its left edge to this offset
            edges_m = sorted((float(strip.left_at(s_m)), float(strip.right_at(s_m))) for strip in there)
            for left_m, right_m in reversed(edges_m):
                if left_m >= covered_to_m - 1e-6:
                    covered_to_m = min(covered_to_m, right_m)
            if covered_to_m > -half_width_m + 1e-6:
                yield f"the driven lane lies on no asphalt from {first_m:.1f} m to {last_m:.1f} m: correct paved"
                return
