"""The content of an OpenDRIVE map as plain data.

A station s is a distance along a road's reference line, a lateral position t a distance from it, left positive, both in
metres. Lane 0 has no width; lanes to its left have positive numbers, lanes to its right negative ones.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from lavt.errors import UserError
from lavt.opendrive.geometry import Cubic, PlanElement

STATION_TOLERANCE_M = 1e-6
"""A station this far beyond an end of a road is still accepted, as the end."""


@dataclass(frozen=True)
class CubicPieces:
    """Cubic polynomials one after the other; each holds from its beginning on. Before the first, the value is 0."""

    begins_m: tuple[float, ...] = ()
    cubics: tuple[Cubic, ...] = ()

    def value_and_slope(self, along_m: float) -> tuple[float, float]:
        """Return the value and the first derivative."""
        index = bisect_right(self.begins_m, along_m) - 1
        if index < 0:
            return 0.0, 0.0
        cubic, x = self.cubics[index], along_m - self.begins_m[index]
        return cubic.value(x), cubic.slope(x)

    @property
    def is_zero(self) -> bool:
        """Whether the value is 0 everywhere."""
        return all(cubic == Cubic(0.0) for cubic in self.cubics)


@dataclass(frozen=True, slots=True)
class LaneMark:
    """The mark on the outer edge of a lane (of lane 0: on the lane itself), from `offset_m` of the section on."""

    offset_m: float
    kind: str
    colour: str
    width_m: float | None
    """The width, if the map states one."""


@dataclass(frozen=True, slots=True)
class MapLane:
    """A lane within a lane section."""

    number: int
    kind: str
    """The standard's lane type, such as `driving`."""
    widths: CubicPieces
    """The width, or nothing if the lane has borders."""
    borders: CubicPieces
    """The lateral position of the outer edge, for lanes that have no widths."""
    marks: tuple[LaneMark, ...]
    predecessor: int | None
    successor: int | None


@dataclass(frozen=True)
class LaneSection:
    """A part of a road with a constant number of lanes."""

    s_m: float
    end_m: float
    lanes: Mapping[int, MapLane]


@dataclass(frozen=True, slots=True)
class RoadLink:
    """What an end of a road joins: an end of another road, or a junction."""

    kind: Literal["road", "junction"]
    target: str
    contact: Literal["start", "end"] | None
    """The end of the other road; None for a junction."""


@dataclass(frozen=True)
class MapRoad:
    """A road of a map."""

    number: str
    """The road's id, which need not be a number."""
    length_m: float
    junction: str | None
    """The junction to which a connecting road belongs."""
    left_hand_traffic: bool
    plan: tuple[PlanElement, ...]
    lane_offsets: CubicPieces
    sections: tuple[LaneSection, ...]
    predecessor: RoadLink | None
    successor: RoadLink | None

    @cached_property
    def _plan_begins_m(self) -> list[float]:
        return [element.s_m for element in self.plan]

    @cached_property
    def _section_begins_m(self) -> list[float]:
        return [section.s_m for section in self.sections]

    def shape_breaks_m(self, begin_m: float, end_m: float) -> list[float]:
        """Return the stations between two others at which an element of the plan view or a lane offset begins."""
        return [
            s_m
            for begins_m in (self._plan_begins_m, self.lane_offsets.begins_m)
            for s_m in begins_m[bisect_right(begins_m, begin_m) : bisect_left(begins_m, end_m)]
        ]

    def plan_element(self, s_m: float) -> PlanElement:
        """Return the element of the plan view at a station."""
        return self.plan[max(bisect_right(self._plan_begins_m, self.check_station(s_m)) - 1, 0)]

    def section_index(self, s_m: float) -> int:
        """Return the index of the lane section at a station; where two meet, of the second."""
        return max(bisect_right(self._section_begins_m, self.check_station(s_m)) - 1, 0)

    def check_station(self, s_m: float) -> float:
        """Return a station, or raise UserError if the road does not have it."""
        if not -STATION_TOLERANCE_M <= s_m <= self.length_m + STATION_TOLERANCE_M:
            raise UserError(f"road {self.number} has no s={s_m:.3f} m: it runs from 0 to {self.length_m:.3f} m")
        return min(max(s_m, 0.0), self.length_m)

    def drives_forward(self, lane: int) -> bool:
        """Return whether vehicles in a lane drive towards larger stations."""
        return (lane > 0) == self.left_hand_traffic


@dataclass(frozen=True, slots=True)
class JunctionConnection:
    """A way through a junction, from an incoming road to a connecting one."""

    incoming: str
    connecting: str
    contact: Literal["start", "end"]
    """The end of the connecting road at which it is entered."""
    lane_links: tuple[tuple[int, int], ...]
    """Lanes of the incoming road with lanes of the connecting road."""


@dataclass(frozen=True)
class OpenDriveMap:
    """A map: roads and junctions by their ids."""

    source: str
    """The name of the file, for messages."""
    roads: Mapping[str, MapRoad]
    junctions: Mapping[str, tuple[JunctionConnection, ...]]
    ignored: tuple[str, ...]
    """A sentence about each kind of content that LAVT ignores in this map."""

    def road(self, number: str) -> MapRoad:
        """Return a road; raise UserError if the map does not have it."""
        if number not in self.roads:
            some = ", ".join([*list(self.roads)[:10], *(["..."] if len(self.roads) > 10 else [])])
            raise UserError(f"{self.source} has no road {number}: name one of its {len(self.roads)} roads ({some})")
        return self.roads[number]

    def connections(self, junction: str, incoming: str) -> Sequence[JunctionConnection]:
        """Return the connections of a junction that begin on a road."""
        return self._connections.get((junction, incoming), ())

    @cached_property
    def _connections(self) -> Mapping[tuple[str, str], Sequence[JunctionConnection]]:
        found: dict[tuple[str, str], list[JunctionConnection]] = {}
        for junction, connections in self.junctions.items():
            for connection in connections:
                found.setdefault((junction, connection.incoming), []).append(connection)
        return found
