"""The schema of road files: keys, defaults and checks. `docs/roads.md` describes road files for users."""

from __future__ import annotations

import difflib
import functools
import itertools
import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lavt.errors import UserError
from lavt.vehicle.sim.road.centreline import Segment
from lavt.vehicle.sim.road.cross_section import DASH_M, GAP_M, Lanes, PavedArea, Rail, RoadMark

MARK_WIDTH_M = 0.125
"""Default width of a mark, taken from the map that contains the six routes."""

MAX_CURVATURE_PER_M = 0.2
"""The largest curvature, which a car with a turning radius of 5 m can just follow."""

MIN_ROUTE_M = 10.0
"""The shortest route; a car starts at a station between 0 and 2 m."""

MIN_DASH_M = 0.1
"""The shortest dash and gap. Shorter dashes would be invisible, and drawing hundreds of thousands takes minutes."""

MIN_INNER_SHARE = 0.1
"""In a curve, the length of the road's inner edge must be at least this share of the length of the lane's centre."""

MAX_COORDINATE_M = 100_000.0
MAX_LENGTH_M = 20_000.0

Coordinate = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Offset = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-200, le=200)]
Station = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-20_000, le=20_000)]
Length = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=20_000)]
Dash = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=MIN_DASH_M, le=20_000)]
RouteLength = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=MIN_ROUTE_M, le=20_000)]
RunLength = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=2_000)]
Width = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=20)]
Curvature = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_CURVATURE_PER_M, le=MAX_CURVATURE_PER_M)]
Index = Annotated[int, Field(strict=True, ge=0)]
Title = Annotated[str, Field(strict=True, min_length=1, max_length=100)]


class _Keys(BaseModel):
    """A mapping in a road file, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _OriginKeys(_Keys):
    x_m: Coordinate = 0.0
    y_m: Coordinate = 0.0
    heading_rad: Coordinate = 0.0


class _SegmentKeys(_Keys):
    length_m: Length
    curvature_per_m: Curvature = 0.0
    end_curvature_per_m: Curvature | None = None

    def to_segment(self) -> Segment:
        end = self.end_curvature_per_m
        return Segment(self.length_m, self.curvature_per_m, self.curvature_per_m if end is None else end)


class _LaneKeys(_Keys):
    widths_m: Annotated[list[Width], Field(min_length=1, max_length=12)] = [3.5]
    driven: Index = 0


class _ShoulderKeys(_Keys):
    left_m: RunLength = 0.5
    right_m: RunLength = 0.5


class _RangeKeys(_Keys):
    from_m: Station = -math.inf
    to_m: Station = math.inf


class _PavedKeys(_RangeKeys):
    left_m: Offset
    right_m: Offset


class _MarkKeys(_RangeKeys):
    offset_m: Offset
    kind: Literal["solid", "broken"] = "solid"
    colour: Literal["white", "yellow"] = "white"
    width_m: Width = MARK_WIDTH_M
    dash_m: Dash = DASH_M
    gap_m: Dash = GAP_M
    dash_at_m: Station = 0.0


class _RailKeys(_RangeKeys):
    offset_m: Offset
    kind: Literal["rail", "barrier"] = "rail"


class PartFile(_Keys):
    """A file whose route lies on the road of another file, and begins at the station `from_m` of that road."""

    title: Title
    part_of: Annotated[str, Field(strict=True, min_length=1)]
    from_m: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=20_000)]
    length_m: RouteLength


class RoadFile(_Keys):
    """A file with a complete road; every key but `title` and `segments` has a default."""

    title: Title
    segments: Annotated[list[_SegmentKeys], Field(min_length=1, max_length=1000)]
    length_m: RouteLength | None = None
    origin: _OriginKeys = _OriginKeys()
    run_in_m: RunLength = 20.0
    run_out_m: RunLength = 100.0
    lane_keys: _LaneKeys = Field(_LaneKeys(), alias="lanes")
    shoulders: _ShoulderKeys | None = None
    paved: Annotated[list[_PavedKeys], Field(max_length=100)] | None = None
    marks: Annotated[list[_MarkKeys], Field(max_length=200)] | None = None
    rail_keys: Annotated[list[_RailKeys], Field(max_length=100)] = Field([], alias="rails")

    @property
    def start(self) -> tuple[float, float, float]:
        """The pose of station 0: x, y (m), heading (rad)."""
        return self.origin.x_m, self.origin.y_m, self.origin.heading_rad

    @property
    def segments_length_m(self) -> float:
        """The total length of the segments."""
        return sum(segment.length_m for segment in self.segments)

    @property
    def route_length_m(self) -> float:
        """The length of the route, by default the total length of the segments."""
        return self.segments_length_m if self.length_m is None else self.length_m

    @property
    def all_segments(self) -> tuple[Segment, ...]:
        """The straight run-in, the segments, and the straight run-out."""
        run_in, run_out = Segment(self.run_in_m, 0.0, 0.0), Segment(self.run_out_m, 0.0, 0.0)
        return run_in, *(segment.to_segment() for segment in self.segments), run_out

    @property
    def lanes(self) -> Lanes:
        """The lanes of the driven direction."""
        return Lanes(tuple(self.lane_keys.widths_m), self.lane_keys.driven)

    @property
    def all_paved(self) -> tuple[PavedArea, ...]:
        """The strips of asphalt, by default the lanes and their shoulders."""
        if self.paved is not None:
            return tuple(PavedArea(**dict(keys)) for keys in self.paved)
        edges_m, shoulders = self.lanes.edges_m, self.shoulders or _ShoulderKeys()
        return (PavedArea(edges_m[-1] + shoulders.left_m, edges_m[0] - shoulders.right_m),)

    @property
    def all_marks(self) -> tuple[RoadMark, ...]:
        """The marks, by default white: solid at both edges and broken between lanes."""
        if self.marks is not None:
            return tuple(RoadMark(**dict(keys)) for keys in self.marks)
        edges_m = self.lanes.edges_m
        solid_m = (edges_m[0], edges_m[-1])
        return tuple(
            RoadMark(edge_m, "solid" if edge_m in solid_m else "broken", "white", MARK_WIDTH_M) for edge_m in edges_m
        )

    @property
    def rails(self) -> tuple[Rail, ...]:
        """The rails and barriers."""
        return tuple(Rail(**dict(keys)) for keys in self.rail_keys)


@functools.lru_cache(maxsize=32)  # a sweep loads the same roads repeatedly, and parsing YAML takes 7 ms
def read_road_file(text: str, source: str) -> RoadFile | PartFile:
    """Parse a road file. If it is invalid, raise a `UserError` that names `source` and the problems."""
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, AttributeError, RecursionError) as error:
        raise UserError(f"{source} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        kind_name = type(data).__name__
        raise UserError(f"{source} must have keys and values, not a {kind_name}: write them as in docs/roads.md")
    kind = PartFile if "part_of" in data else RoadFile
    try:
        road_file = kind.model_validate(data)
    except ValidationError as error:
        problems = "; ".join(_describe_error(kind, problem) for problem in error.errors())
        raise UserError(f"{source} is not a road: {problems}") from error
    if isinstance(road_file, RoadFile):
        for problem in _find_problems(road_file):
            raise UserError(f"{source} is not a road: {problem}")
    return road_file


def _find_problems(road: RoadFile) -> Iterable[str]:
    """Yield the problems that concern more than one key."""
    lanes = road.lane_keys
    if lanes.driven >= len(lanes.widths_m):
        yield f"lanes.driven is {lanes.driven}, but lanes count from 0 to {len(lanes.widths_m) - 1}"
        return
    if road.paved is not None and road.shoulders is not None:
        yield "paved defines all asphalt: leave out shoulders"
    begin_m, end_m = -road.run_in_m, road.segments_length_m + road.run_out_m
    for name, keys in _named_ranges(road):
        if keys.from_m >= keys.to_m:
            yield f"{name} goes from {keys.from_m} m to {keys.to_m} m: from_m must be less than to_m"
        if keys.to_m <= begin_m or keys.from_m >= end_m:
            yield f"{name} is not on the road, which lies from {begin_m} m to {end_m} m"
    for index, rail in enumerate(road.rails):
        if abs(rail.offset_m) <= lanes.widths_m[lanes.driven] / 2:
            yield f"rails.{index} is in the driven lane, at {rail.offset_m} m: move it out"
    for strip in road.all_paved:
        if strip.left_m <= strip.right_m:
            yield f"a strip of paved has left_m {strip.left_m} and right_m {strip.right_m}: left is the greater offset"
    if road.segments_length_m > MAX_LENGTH_M:
        yield f"the segments are {road.segments_length_m:.0f} m long: 20 km are enough"
    elif road.route_length_m < MIN_ROUTE_M:
        yield f"the segments are only {road.segments_length_m:g} m long: a route has at least {MIN_ROUTE_M:g} m"
    elif road.route_length_m > road.segments_length_m:
        segments = f"the segments are only {road.segments_length_m:.3f} m long"
        yield f"length_m is {road.route_length_m}, but {segments}: add to them"
    yield from _find_tight_curves(road)
    yield from _find_unpaved(road)


def _named_ranges(road: RoadFile) -> Iterable[tuple[str, _RangeKeys]]:
    """Yield each entry that has `from_m` and `to_m`, after its name for messages."""
    for section, entries in (("paved", road.paved), ("marks", road.marks), ("rails", road.rail_keys)):
        for index, keys in enumerate(entries or ()):
            yield f"{section}.{index}", keys


def _find_tight_curves(road: RoadFile) -> Iterable[str]:
    """Yield a problem for the first curve whose inner edge comes too close to the centre of the circle."""
    offsets_m = [
        *road.lanes.edges_m,
        *(mark.offset_m for mark in road.all_marks),
        *(rail.offset_m for rail in road.rails),
    ]
    offsets_m += [edge_m for strip in road.all_paved for edge_m in (strip.left_m, strip.right_m)]
    for index, keys in enumerate(road.segments):
        segment = keys.to_segment()
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
    half_width_m = road.lanes.widths_m[road.lanes.driven] / 2
    strips = road.all_paved
    ends_m = sorted({0.0, road.route_length_m, *(end_m for strip in strips for end_m in (strip.from_m, strip.to_m))})
    for first_m, last_m in itertools.pairwise(end_m for end_m in ends_m if 0.0 <= end_m <= road.route_length_m):
        covered_to_m = half_width_m  # the lane is on asphalt from its left edge to this offset
        for strip in sorted(strips, key=lambda strip: -strip.left_m):
            if strip.from_m <= first_m and strip.to_m >= last_m and strip.left_m >= covered_to_m - 1e-6:
                covered_to_m = min(covered_to_m, strip.right_m)
        if covered_to_m > -half_width_m + 1e-6:
            yield f"the driven lane lies on no asphalt from {first_m:.1f} m to {last_m:.1f} m: correct paved"
            return


def _describe_error(kind: type[BaseModel], problem: Mapping[str, Any]) -> str:
    """Return a sentence about one invalid value."""
    location = [str(part)[:60] for part in problem["loc"]]
    key = ".".join(location)
    if problem["type"] == "extra_forbidden":
        known = _known_keys(kind, problem["loc"][:-1])
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"the known keys are {', '.join(sorted(known))}"
        return f"unknown key {key!r}: {hint}"
    if problem["type"] == "missing":
        return f"{key!r} is missing: add it"
    if problem["type"] == "model_type":
        return f"{key!r} must contain keys and values, not {_format_value(problem['input'])}"
    return f"{key!r}: {problem['msg']}, not {_format_value(problem['input'])}"


def _format_value(value: Any) -> str:
    """Return a value as text, or only its type: lists can contain themselves, and integers can be huge."""
    if not isinstance(value, str | int | float | None) or (isinstance(value, int) and value.bit_length() > 64):
        return f"this {type(value).__name__}"
    shown = repr(value)
    return shown if len(shown) <= 60 else shown[:57] + "..."


_SECTION_MODELS: dict[str, type[BaseModel]] = {
    "origin": _OriginKeys,
    "segments": _SegmentKeys,
    "lanes": _LaneKeys,
    "shoulders": _ShoulderKeys,
    "paved": _PavedKeys,
    "marks": _MarkKeys,
    "rails": _RailKeys,
}


def _known_keys(kind: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    inner = _SECTION_MODELS[location[0]] if location else kind
    return [field.alias or name for name, field in inner.model_fields.items()]
