"""The schema of road files: their keys, defaults and checks. `docs/roads.md` is the users' description."""

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

SOLID_M = 0.125
"""Default width of a mark, that of the map the six routes come from."""

TIGHTEST_PER_M = 0.2
"""The largest curvature, which a car with a turning radius of 5 m can just follow."""

SHORTEST_M = 10.0
"""The shortest route; cars start up to 2 m into it."""

SHORTEST_DASH_M = 0.1
"""The shortest dash and gap; hundreds of thousands of dashes would take minutes to draw and be invisible."""

INNER_SHARE = 0.1
"""The inner edge of the road must keep this share of the centre's length in a curve."""

Coordinate = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-100_000, le=100_000)]
Offset = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-200, le=200)]
Station = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-20_000, le=20_000)]
Length = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=20_000)]
Dash = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=SHORTEST_DASH_M, le=20_000)]
RouteLength = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=SHORTEST_M, le=20_000)]
RunLength = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=2_000)]
Width = Annotated[float, Field(strict=True, allow_inf_nan=False, gt=0, le=20)]
Curvature = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-TIGHTEST_PER_M, le=TIGHTEST_PER_M)]
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

    def segment(self) -> Segment:
        end = self.end_curvature_per_m
        return Segment(self.length_m, self.curvature_per_m, self.curvature_per_m if end is None else end)


class _LaneKeys(_Keys):
    widths_m: Annotated[list[Width], Field(min_length=1, max_length=12)] = [3.5]
    driven: Index = 0


class _ShoulderKeys(_Keys):
    left_m: RunLength = 0.5
    right_m: RunLength = 0.5


class _Along(_Keys):
    from_m: Station = -math.inf
    to_m: Station = math.inf


class _PavedKeys(_Along):
    left_m: Offset
    right_m: Offset


class _MarkKeys(_Along):
    offset_m: Offset
    kind: Literal["solid", "broken"] = "solid"
    colour: Literal["white", "yellow"] = "white"
    width_m: Width = SOLID_M
    dash_m: Dash = DASH_M
    gap_m: Dash = GAP_M
    dash_at_m: Station = 0.0


class _RailKeys(_Along):
    offset_m: Offset
    kind: Literal["rail", "barrier"] = "rail"


class PartFile(_Keys):
    """A file with a route on the road of another file, from a station of that file's route."""

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
        return sum(each.length_m for each in self.segments)

    @property
    def route_m(self) -> float:
        """The length of the route, by default that of all segments."""
        return self.segments_length_m if self.length_m is None else self.length_m

    @property
    def all_segments(self) -> tuple[Segment, ...]:
        """The segments with the straight run-in before and the straight run-out after them."""
        run_in, run_out = Segment(self.run_in_m, 0.0, 0.0), Segment(self.run_out_m, 0.0, 0.0)
        return run_in, *(each.segment() for each in self.segments), run_out

    @property
    def lanes(self) -> Lanes:
        """The lanes of the driven direction."""
        return Lanes(tuple(self.lane_keys.widths_m), self.lane_keys.driven)

    @property
    def all_paved(self) -> tuple[PavedArea, ...]:
        """The strips of asphalt, by default the lanes and their shoulders."""
        if self.paved is not None:
            return tuple(PavedArea(**dict(each)) for each in self.paved)
        edges_m, shoulders = self.lanes.edges_m, self.shoulders or _ShoulderKeys()
        return (PavedArea(edges_m[-1] + shoulders.left_m, edges_m[0] - shoulders.right_m),)

    @property
    def all_marks(self) -> tuple[RoadMark, ...]:
        """The marks, by default white: solid at both edges and broken between lanes."""
        if self.marks is not None:
            return tuple(RoadMark(**dict(each)) for each in self.marks)
        edges_m = self.lanes.edges_m
        outer = (edges_m[0], edges_m[-1])
        return tuple(
            RoadMark(offset_m, "solid" if offset_m in outer else "broken", "white", SOLID_M) for offset_m in edges_m
        )

    @property
    def rails(self) -> tuple[Rail, ...]:
        """The rails and barriers."""
        return tuple(Rail(**dict(each)) for each in self.rail_keys)


@functools.lru_cache(maxsize=32)  # a sweep loads the same roads repeatedly, and parsing YAML takes 7 ms
def read_road_file(text: str, source: str) -> RoadFile | PartFile:
    """Parse a road file; raise a `UserError` that names `source` and the problems."""
    try:
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, AttributeError, RecursionError) as error:
        raise UserError(f"{source} is not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise UserError(f"{source} must contain keys and values, as docs/roads.md shows, not a {type(data).__name__}")
    kind = PartFile if "part_of" in data else RoadFile
    try:
        read = kind.model_validate(data)
    except ValidationError as error:
        problems = "; ".join(_describe_error(kind, problem) for problem in error.errors())
        raise UserError(f"{source} is not a road: {problems}") from error
    if isinstance(read, RoadFile):
        for problem in _problems(read):
            raise UserError(f"{source} is not a road: {problem}")
    return read


def _problems(road: RoadFile) -> Iterable[str]:
    """Yield the problems that concern more than one key."""
    lanes = road.lane_keys
    if lanes.driven >= len(lanes.widths_m):
        yield f"lanes.driven is {lanes.driven}, but lanes count from 0 to {len(lanes.widths_m) - 1}"
        return
    if road.paved is not None and road.shoulders is not None:
        yield "paved defines all asphalt: leave out shoulders"
    begin_m, end_m = -road.run_in_m, road.segments_length_m + road.run_out_m
    for name, each in _ranges(road):
        if each.from_m >= each.to_m:
            yield f"{name} goes from {each.from_m} m to {each.to_m} m: from_m must be less than to_m"
        if each.to_m <= begin_m or each.from_m >= end_m:
            yield f"{name} is not on the road, which lies from {begin_m} m to {end_m} m"
    for index, rail in enumerate(road.rails):
        if abs(rail.offset_m) <= lanes.widths_m[lanes.driven] / 2:
            yield f"rails.{index} is in the driven lane, at {rail.offset_m} m: move it out"
    for strip in road.all_paved:
        if strip.left_m <= strip.right_m:
            yield f"a strip of paved has left_m {strip.left_m} and right_m {strip.right_m}: left is the greater offset"
    if road.segments_length_m > 20_000:
        yield f"the segments are {road.segments_length_m:.0f} m long: 20 km are enough"
    elif road.route_m < SHORTEST_M:
        yield f"the segments are only {road.segments_length_m:g} m long: a route has at least {SHORTEST_M:g} m"
    elif road.route_m > road.segments_length_m:
        yield f"length_m is {road.route_m}, but the segments are only {road.segments_length_m:.3f} m long: add to them"
    yield from _find_tight_curves(road)
    yield from _find_unpaved(road)


def _ranges(road: RoadFile) -> Iterable[tuple[str, _Along]]:
    for name, each in (("paved", road.paved), ("marks", road.marks), ("rails", road.rail_keys)):
        for index, along in enumerate(each or ()):
            yield f"{name}.{index}", along


def _find_tight_curves(road: RoadFile) -> Iterable[str]:
    """Yield a problem where the inner side of a curve reaches the circle's centre."""
    offsets = [
        *road.lanes.edges_m,
        *(mark.offset_m for mark in road.all_marks),
        *(rail.offset_m for rail in road.rails),
    ]
    offsets += [edge for strip in road.all_paved for edge in (strip.left_m, strip.right_m)]
    for index, segment in enumerate(road.segments):
        placed = segment.segment()
        for curvature in (placed.curvature_per_m, placed.end_curvature_per_m):
            reach = max(offset * curvature for offset in offsets)
            if reach > 1.0 - INNER_SHARE:
                yield (
                    f"segments.{index} has a radius of {abs(1 / curvature):.1f} m, but the road reaches "
                    f"{abs(reach / curvature):.1f} m to the inside of the curve: make one wider or the other narrower"
                )
                return


def _find_unpaved(road: RoadFile) -> Iterable[str]:
    """Yield a problem where the driven lane is not on asphalt along the whole route."""
    half_m = road.lanes.widths_m[road.lanes.driven] / 2
    strips = road.all_paved
    cuts = sorted({0.0, road.route_m, *(each for strip in strips for each in (strip.from_m, strip.to_m))})
    for first_m, last_m in itertools.pairwise(each for each in cuts if 0.0 <= each <= road.route_m):
        reached_m = half_m
        for strip in sorted(strips, key=lambda strip: -strip.left_m):
            if strip.from_m <= first_m and strip.to_m >= last_m and strip.left_m >= reached_m - 1e-6:
                reached_m = min(reached_m, strip.right_m)
        if reached_m > -half_m + 1e-6:
            yield f"the driven lane lies on no asphalt from {first_m:.1f} m to {last_m:.1f} m: correct paved"
            return


def _describe_error(kind: type[BaseModel], problem: Mapping[str, Any]) -> str:
    """Return a sentence about one invalid value."""
    location = [str(part)[:60] for part in problem["loc"]]
    where = ".".join(location)
    if problem["type"] == "extra_forbidden":
        known = _known_keys(kind, problem["loc"][:-1])
        near = difflib.get_close_matches(location[-1], known, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"the known keys are {', '.join(sorted(known))}"
        return f"unknown key {where!r}: {hint}"
    if problem["type"] == "missing":
        return f"{where!r} is missing: add it"
    if problem["type"] == "model_type":
        return f"{where!r} must contain keys and values, not {_format_value(problem['input'])}"
    return f"{where!r}: {problem['msg']}, not {_format_value(problem['input'])}"


def _format_value(value: Any) -> str:
    """Return a value as text, or only its type: lists may contain themselves, and integers may be huge."""
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
