"""A road as data: the centre of the driven lane as lines and arcs, and what lies across it.

The reference is the centre of the driven lane. A station `s_m` is a distance along it, 0 at the route's start; a
lateral offset is across it, left positive. Roads are flat. Their files are `lavt/data/roads/<name>.yaml`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import Literal

import numpy as np
import yaml
from numpy.typing import ArrayLike
from pydantic import TypeAdapter, ValidationError

from lavt.domain import FloatArray
from lavt.errors import UserError

PROJECTION_WINDOW_M = 15.0
"""How far from the last known station a projection looks: a search of the whole road may jump to a far carriageway."""

_STRICT = {"extra": "forbid"}


@dataclass(frozen=True)
class Origin:
    """Where the first segment begins, in the world's frame."""

    __pydantic_config__ = _STRICT
    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True)
class Segment:
    """A piece of constant curvature: a line (0) or an arc (left positive)."""

    __pydantic_config__ = _STRICT
    length_m: float
    curvature_per_m: float


@dataclass(frozen=True)
class Lanes:
    """The lanes of the driven direction, from the left; `driven` is the index of the one the reference runs in."""

    __pydantic_config__ = _STRICT
    left_edge_m: float
    widths_m: tuple[float, ...]
    driven: int

    @cached_property
    def edges_m(self) -> tuple[float, ...]:
        """Lateral offsets of all edges of lanes, from the right to the left."""
        edges = [self.left_edge_m]
        for width_m in self.widths_m:
            edges.append(edges[-1] - width_m)
        return tuple(reversed(edges))


@dataclass(frozen=True)
class Paved:
    """A strip of asphalt, between two lateral offsets."""

    __pydantic_config__ = _STRICT
    left_m: float
    right_m: float


@dataclass(frozen=True)
class RoadMark:
    """A painted line along the road, from one station to another."""

    __pydantic_config__ = _STRICT
    offset_m: float
    kind: Literal["solid", "broken"]
    colour: Literal["white", "yellow"]
    width_m: float
    from_m: float = -math.inf
    to_m: float = math.inf


@dataclass(frozen=True)
class Rail:
    """Something along the road that stops a car: a steel guard rail or a concrete barrier."""

    __pydantic_config__ = _STRICT
    offset_m: float
    kind: Literal["rail", "barrier"]
    from_m: float = -math.inf
    to_m: float = math.inf


@dataclass(frozen=True)
class Road:
    """A road and the route on it.

    The route is stations 0 to `length_m`; the segments begin at station `first_m`, before the start, and go on beyond
    the end. Beyond both ends the first and the last segment are continued.
    """

    __pydantic_config__ = _STRICT
    title: str
    origin: Origin
    first_m: float
    length_m: float
    segments: tuple[Segment, ...]
    lanes: Lanes
    paved: tuple[Paved, ...]
    marks: tuple[RoadMark, ...]
    rails: tuple[Rail, ...]

    @cached_property
    def last_m(self) -> float:
        """Station where the last segment ends."""
        return self.first_m + sum(segment.length_m for segment in self.segments)

    @cached_property
    def start(self) -> tuple[float, float, float]:
        """x, y (m) and heading (rad) of the route's start, in the world's frame."""
        x_m, y_m, heading_rad, _ = self.point(0.0)
        return float(x_m), float(y_m), float(heading_rad)

    def point(self, s_m: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Tell x, y (m), heading (rad) and curvature (1/m) of the lane's centre at the stations `s_m`, any shape."""
        station = np.asarray(s_m, dtype=np.float64)
        table = np.array(self._pieces)
        piece = table[np.clip(np.searchsorted(table[:, 0], station, side="right") - 1, 0, len(table) - 1)]
        along = station - piece[..., 0]
        half_turn = piece[..., 5] * along / 2
        chord = along * np.sinc(half_turn / np.pi)
        direction = piece[..., 4] + half_turn
        return (
            piece[..., 2] + chord * np.cos(direction),
            piece[..., 3] + chord * np.sin(direction),
            direction + half_turn,
            piece[..., 5],
        )

    def across(self, s_m: ArrayLike, offset_m: ArrayLike) -> FloatArray:
        """World x, y (m) of the points at stations `s_m` and lateral offsets `offset_m`: shape (..., 2)."""
        x_m, y_m, heading_rad, _ = self.point(s_m)
        offset = np.asarray(offset_m, dtype=np.float64)
        return np.stack([x_m - offset * np.sin(heading_rad), y_m + offset * np.cos(heading_rad)], axis=-1)

    def project(self, x_m: float, y_m: float, near_s_m: float) -> tuple[float, float, float]:
        """Find the point of the lane's centre nearest to a place.

        Only stations within `PROJECTION_WINDOW_M` of `near_s_m` are looked at. Returns the point's station (m), the
        place's lateral offset (m, left positive) and the lane's heading (rad) there.
        """
        best = (near_s_m, math.inf, 0.0)
        best_distance_m = math.inf
        first_m, last_m = near_s_m - PROJECTION_WINDOW_M, near_s_m + PROJECTION_WINDOW_M
        for low_s_m, high_s_m, s0_m, x0_m, y0_m, heading0_rad, curvature_per_m, cosine, sine in self._searched:
            if high_s_m < first_m or low_s_m > last_m:
                continue
            low_m, high_m = max(low_s_m, first_m) - s0_m, min(high_s_m, last_m) - s0_m
            dx_m, dy_m = x_m - x0_m, y_m - y0_m
            ahead_m, left_m = dx_m * cosine + dy_m * sine, dy_m * cosine - dx_m * sine
            along_m = _foot_m(ahead_m, left_m, curvature_per_m, (low_m + high_m) / 2)
            along_m = min(max(along_m, low_m), high_m)
            if curvature_per_m == 0.0:
                turn_rad, ahead_m, lateral_m = 0.0, ahead_m - along_m, left_m
            else:
                turn_rad = curvature_per_m * along_m
                turn_cosine, turn_sine = math.cos(turn_rad), math.sin(turn_rad)
                ahead_m -= turn_sine / curvature_per_m
                left_m -= (1.0 - turn_cosine) / curvature_per_m
                lateral_m = left_m * turn_cosine - ahead_m * turn_sine
                ahead_m = ahead_m * turn_cosine + left_m * turn_sine
            distance_m = math.hypot(ahead_m, lateral_m)
            if distance_m < best_distance_m:
                best_distance_m = distance_m
                best = (s0_m + along_m, lateral_m, heading0_rad + turn_rad)
        return best

    @cached_property
    def _searched(self) -> list[tuple[float, ...]]:
        """For each segment: stations between which it serves, the table's row without its end, cosine and sine."""
        found: list[tuple[float, ...]] = []
        for index, (s0_m, s1_m, x_m, y_m, heading_rad, curvature_per_m) in enumerate(self._pieces):
            low_m = s0_m if index else -math.inf
            high_m = s1_m if index < len(self._pieces) - 1 else math.inf
            place = (s0_m, x_m, y_m, heading_rad, curvature_per_m)
            found.append((low_m, high_m, *place, math.cos(heading_rad), math.sin(heading_rad)))
        return found

    @cached_property
    def _pieces(self) -> list[tuple[float, float, float, float, float, float]]:
        """For each segment: first and last station, x, y and heading of its beginning, curvature."""
        pieces = []
        s_m, x_m, y_m, heading_rad = self.first_m, self.origin.x_m, self.origin.y_m, self.origin.heading_rad
        for segment in self.segments:
            length_m, curvature_per_m = segment.length_m, segment.curvature_per_m
            pieces.append((s_m, s_m + length_m, x_m, y_m, heading_rad, curvature_per_m))
            half_turn_rad = curvature_per_m * length_m / 2
            chord_m = length_m * float(np.sinc(half_turn_rad / np.pi))
            s_m += length_m
            x_m += chord_m * math.cos(heading_rad + half_turn_rad)
            y_m += chord_m * math.sin(heading_rad + half_turn_rad)
            heading_rad += 2 * half_turn_rad
        return pieces


def _foot_m(ahead_m: float, left_m: float, curvature_per_m: float, middle_m: float) -> float:
    """Arc length to the foot of a point given in the frame of an arc's beginning; of all turns that at `middle_m`."""
    if curvature_per_m == 0.0:
        return ahead_m
    sign = math.copysign(1.0, curvature_per_m)
    turn_rad = math.atan2(sign * ahead_m, sign * (1.0 / curvature_per_m - left_m))
    middle_rad = curvature_per_m * middle_m
    return (middle_rad + math.remainder(turn_rad - middle_rad, 2 * math.pi)) / curvature_per_m


def road_names() -> list[str]:
    """Names of the roads that come with the package, sorted."""
    folder = resources.files("lavt") / "data" / "roads"
    return sorted(file.name.removesuffix(".yaml") for file in folder.iterdir() if file.name.endswith(".yaml"))


def load_road(name: str) -> Road:
    """Read the road `name`; `UserError` when there is none of that name."""
    if name not in road_names():
        raise UserError(f"there is no road {name!r}; known are: {', '.join(road_names())}")
    file = resources.files("lavt") / "data" / "roads" / f"{name}.yaml"
    return parse_road(file.read_text(encoding="utf-8"), source=f"{name}.yaml")


def parse_road(text: str, *, source: str) -> Road:
    """Read a road from YAML text; `UserError` that names `source` and the key when a key or a value is wrong."""
    try:
        return TypeAdapter(Road).validate_python(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise UserError(f"{source} is not YAML: {error}") from error
    except ValidationError as error:
        places = (f"{'.'.join(str(part) for part in each['loc'])}: {each['msg']}" for each in error.errors())
        raise UserError(f"{source} is not a road, correct these keys: {'; '.join(places)}") from error
