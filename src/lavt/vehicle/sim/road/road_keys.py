"""The schema of road files: keys and defaults. `docs/roads.md` describes road files for users."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from lavt.vehicle.sim.road.centreline import Segment
from lavt.vehicle.sim.road.cross_section import DASH_M, GAP_M, Lanes, PavedArea, Rail, RoadMark, WidthChange
from lavt.vehicle.sim.road.default_surface import default_marks, default_paved

MARK_WIDTH_M = 0.125
"""Default width of a mark, taken from the map that contains the six routes."""

MAX_CURVATURE_PER_M = 0.2
"""The largest curvature, which a car with a turning radius of 5 m can just follow."""

MIN_ROUTE_M = 10.0
"""The shortest route; a car starts at a station between 0 and 2 m."""

MIN_DASH_M = 0.1
"""The shortest dash and gap. Shorter dashes would be invisible, and drawing hundreds of thousands takes minutes."""

MAX_LANES, MAX_CHANGES, MAX_STRIPS, MAX_MARKS = 12, 300, 300, 1000

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
LaneWidth = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=20)]
Curvature = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-MAX_CURVATURE_PER_M, le=MAX_CURVATURE_PER_M)]
Index = Annotated[int, Field(strict=True, ge=0)]
Title = Annotated[str, Field(strict=True, min_length=1, max_length=100)]


class RoadFileKeys(BaseModel):
    """A mapping in a road file, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class OriginKeys(RoadFileKeys):
    """The pose of station 0."""

    x_m: Coordinate = 0.0
    y_m: Coordinate = 0.0
    heading_rad: Coordinate = 0.0


class SegmentKeys(RoadFileKeys):
    """A straight, an arc or a clothoid."""

    length_m: Length
    curvature_per_m: Curvature = 0.0
    end_curvature_per_m: Curvature | None = None

    def to_segment(self) -> Segment:
        """Return the segment of a centreline."""
        end = self.end_curvature_per_m
        return Segment(self.length_m, self.curvature_per_m, self.curvature_per_m if end is None else end)


class ChangeKeys(RoadFileKeys):
    """A part of the road along which the widths of lanes change."""

    from_m: Station
    to_m: Station
    widths_m: Annotated[list[LaneWidth], Field(min_length=1, max_length=MAX_LANES)]


class LaneKeys(RoadFileKeys):
    """The lanes of the driven direction."""

    widths_m: Annotated[list[LaneWidth], Field(min_length=1, max_length=MAX_LANES)] = [3.5]
    driven: Index = 0
    changes: Annotated[list[ChangeKeys], Field(max_length=MAX_CHANGES)] = []


class ShoulderKeys(RoadFileKeys):
    """The asphalt beyond the lanes."""

    left_m: RunLength = 0.5
    right_m: RunLength = 0.5


class RangeKeys(RoadFileKeys):
    """The stations of both ends; by default the whole road."""

    from_m: Station = -math.inf
    to_m: Station = math.inf


class PavedKeys(RangeKeys):
    """A strip of asphalt."""

    left_m: Offset
    right_m: Offset
    to_left_m: Offset | None = None
    to_right_m: Offset | None = None


class MarkKeys(RangeKeys):
    """A painted line."""

    offset_m: Offset
    kind: Literal["solid", "broken"] = "solid"
    colour: Literal["white", "yellow"] = "white"
    width_m: Width = MARK_WIDTH_M
    dash_m: Dash = DASH_M
    gap_m: Dash = GAP_M
    dash_at_m: Station = 0.0
    to_offset_m: Offset | None = None


class RailKeys(RangeKeys):
    """A rail or a barrier."""

    offset_m: Offset
    kind: Literal["rail", "barrier"] = "rail"


class PartFile(RoadFileKeys):
    """A file whose route lies on the road of another file, and begins at the station `from_m` of that road."""

    title: Title
    part_of: Annotated[str, Field(strict=True, min_length=1)]
    from_m: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0, le=20_000)]
    length_m: RouteLength


class RoadFile(RoadFileKeys):
    """A file with a complete road; every key but `title` and `segments` has a default."""

    title: Title
    segments: Annotated[list[SegmentKeys], Field(min_length=1, max_length=1000)]
    length_m: RouteLength | None = None
    origin: OriginKeys = OriginKeys()
    run_in_m: RunLength = 20.0
    run_out_m: RunLength = 100.0
    lane_keys: LaneKeys = Field(LaneKeys(), alias="lanes")
    shoulders: ShoulderKeys | None = None
    paved: Annotated[list[PavedKeys], Field(max_length=MAX_STRIPS)] | None = None
    marks: Annotated[list[MarkKeys], Field(max_length=MAX_MARKS)] | None = None
    rail_keys: Annotated[list[RailKeys], Field(max_length=100)] = Field([], alias="rails")

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
        keys = self.lane_keys
        changes = (WidthChange(change.from_m, change.to_m, tuple(change.widths_m)) for change in keys.changes)
        return Lanes(tuple(keys.widths_m), keys.driven, tuple(changes))

    @property
    def all_paved(self) -> tuple[PavedArea, ...]:
        """The strips of asphalt, by default the lanes and their shoulders."""
        if self.paved is not None:
            return tuple(PavedArea(**dict(keys)) for keys in self.paved)
        lanes, shoulders = self.lanes, self.shoulders or ShoulderKeys()
        return default_paved(lanes, shoulders.left_m, shoulders.right_m)

    @property
    def all_marks(self) -> tuple[RoadMark, ...]:
        """The marks, by default white: solid at both edges and broken between lanes."""
        if self.marks is not None:
            return tuple(RoadMark(**dict(keys)) for keys in self.marks)
        return default_marks(self.lanes, MARK_WIDTH_M)

    @property
    def rails(self) -> tuple[Rail, ...]:
        """The rails and barriers."""
        return tuple(Rail(**dict(keys)) for keys in self.rail_keys)
