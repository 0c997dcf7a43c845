"""The lanes, the asphalt and the marks beside a path along lanes of an OpenDRIVE map, as keys of a road file."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavt.domain import FloatArray
from lavt.opendrive.lane_path import LanePath, PathStep
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.road.road_keys import MARK_WIDTH_M, MAX_LANES

Keys = dict[str, Any]

STEP_M = 0.5
TOLERANCE_M = 0.02
"""Offsets and widths are approximated by linear pieces that deviate by at most this."""

JUMP_M = 0.5
"""A lane that begins or ends at once does so from this distance before the place to this distance after it."""

MAX_REACH_M = 100.0
"""Lanes farther from the driven lane are left out."""

MAX_INNER_REACH = 0.85
"""In a curve, the surroundings reach at most this share of the radius to the inside."""

_PAVED_MARGIN_M = 0.05
_NO_WIDTH_M = 0.05
_DRIVEN_KINDS = frozenset(
    {"driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane", "bidirectional"}
    | {"bus", "taxi", "HOV", "mwyEntry", "mwyExit"}
)
_PAVED_KINDS = _DRIVEN_KINDS | {"shoulder", "border", "stop", "parking", "biking", "restricted", "roadWorks"}


@dataclass(frozen=True)
class _Samples:
    """Positions along one step of a path, with the offsets of all edges of lanes there."""

    step: PathStep
    path_m: FloatArray
    s_m: FloatArray
    """The stations on the road."""
    edges_m: dict[int, FloatArray]
    """The outer edge of each lane, and lane 0."""

    def is_paved(self, lane: int) -> bool:
        """Return whether a lane is asphalt; the driven one always is."""
        return lane == self.step.lane or self.step.section.lanes[lane].kind in _PAVED_KINDS

    def between(self, first_m: float, last_m: float, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the stations and values of a part of the step, with its ends."""
        inside = (self.path_m > first_m) & (self.path_m < last_m)
        path_m = np.concatenate([[first_m], self.path_m[inside], [last_m]])
        return np.interp(path_m, self.path_m, self.s_m), np.interp(path_m, self.path_m, values)


class Surroundings:
    """What lies beside a path; `road` has its centre line, `stations_m` the road's stations at `path_m`."""

    def __init__(self, path: LanePath, road: Road, path_m: FloatArray, stations_m: FloatArray) -> None:
        self._road = road
        self._ends_m = np.cumsum([road.first_m, *(segment.length_m for segment in road.segments)])
        curvatures = [(segment.curvature_per_m, segment.end_curvature_per_m) for segment in road.segments]
        self._highest_per_m, self._lowest_per_m = np.max(curvatures, axis=1), np.min(curvatures, axis=1)
        self._samples = [_sample(step, path_m, stations_m) for step in path.steps]

    def lanes(self) -> Keys:
        """Return the key `lanes`: the driven lane and the lanes of the same direction beside it."""
        sides = [_neighbours(samples) for samples in self._samples]
        left, right = (min(max(len(side[i]) for side in sides), (MAX_LANES - 1) // 2) for i in (0, 1))
        stations_m: list[FloatArray] = []
        rows: list[FloatArray] = []
        for samples, (lefts, rights) in zip(self._samples, sides, strict=True):
            widths_m = self._limited_widths_m(samples, lefts[:left], rights[:right], left, right)
            begin = 0
            before = rows[-1][-1] if rows else widths_m[:, 0]
            if np.abs(widths_m[:, 0] - before).max() > TOLERANCE_M:
                stations_m[-1] = np.minimum(stations_m[-1], samples.s_m[0] - JUMP_M)
                begin = int(np.searchsorted(samples.s_m[:-1], samples.s_m[0] + JUMP_M))
            stations_m.append(samples.s_m[begin:])
            rows.append(widths_m[:, begin:].T)
        s_m, widths = np.maximum.accumulate(np.concatenate(stations_m)), np.concatenate(rows)
        return {"driven": left, **_width_keys(s_m, widths)}

    def _limited_widths_m(
        self, samples: _Samples, lefts: Sequence[FloatArray], rights: Sequence[FloatArray], left: int, right: int
    ) -> FloatArray:
        """Return the widths of all lanes, the leftmost first, limited to the inside of curves: (lanes, n)."""
        own_m = _width_of(samples, samples.step.lane)
        limits_m = np.array([self._reach_m(s_m - 1.0, s_m + 1.0) for s_m in samples.s_m.tolist()])
        rows = [own_m]
        for side, (widths, count) in enumerate(((lefts, left), (rights, right))):
            reach_m = own_m / 2
            for lane in range(count):
                width_m = widths[lane] if lane < len(widths) else np.zeros_like(own_m)
                width_m = np.clip(width_m, 0.0, np.maximum(limits_m[:, side] - reach_m, 0.0))
                reach_m = reach_m + width_m
                rows = [width_m, *rows] if side == 0 else [*rows, width_m]
        return np.array(rows)

    def paved(self) -> list[Keys]:
        """Return the key `paved`: one strip for lanes of asphalt side by side, in linear pieces."""
        strips: list[Keys] = []
        previous: tuple[float, float, float] | None = None
        for number, samples in enumerate(self._samples):
            for lanes in _paved_groups(samples):
                left_m, right_m = _outer_edges(samples, lanes)
                if float((left_m - right_m).max()) < 2 * _NO_WIDTH_M:
                    continue
                values = np.array([left_m + _PAVED_MARGIN_M, right_m - _PAVED_MARGIN_M])
                s_m, values = self._extend(number, samples.s_m, values)
                strips += self._strips(s_m, values)
                if samples.step.lane in lanes:
                    if previous is not None:
                        at_m, before_left_m, before_right_m = previous
                        left = max(before_left_m, float(values[0, 0]))
                        right = min(before_right_m, float(values[1, 0]))
                        bridge = np.array([[left, left], [right, right]])
                        ends_m = np.array([at_m - 1.2 * JUMP_M, at_m + 1.2 * JUMP_M])
                        strips += self._strips(ends_m, bridge)
                    previous = float(samples.s_m[-1]), float(values[0, -1]), float(values[1, -1])
        return _join(strips, ("left_m", "right_m"), ("to_left_m", "to_right_m"))

    def _strips(self, s_m: FloatArray, values: FloatArray) -> Iterator[Keys]:
        for first, last in itertools.pairwise(_knots(s_m, values)):
            left_limit_m, right_limit_m = self._reach_m(float(s_m[first]), float(s_m[last]))
            left, to_left = np.minimum(values[0, [first, last]], left_limit_m).tolist()
            right, to_right = np.maximum(values[1, [first, last]], -right_limit_m).tolist()
            if left > right and to_left >= to_right:
                yield {
                    "left_m": round(left, 3),
                    "right_m": round(right, 3),
                    **_ends(float(s_m[first]), float(s_m[last])),
                    **_taper("to_left_m", left, to_left),
                    **_taper("to_right_m", right, to_right),
                }

    def marks(self) -> list[Keys]:
        """Return the key `marks`: the marks of all lanes, in linear pieces."""
        marks: list[Keys] = []
        for number, samples in enumerate(self._samples):
            for lane, first_m, last_m, style in _painted(samples):
                if lane and float(_width_of(samples, lane).max()) < _NO_WIDTH_M:
                    continue
                s_m, offsets_m = samples.between(first_m, last_m, samples.edges_m[lane])
                s_m, values = self._extend(number, s_m, offsets_m[None])
                for first, last in itertools.pairwise(_knots(s_m, values)):
                    begin, end = values[0, [first, last]].tolist()
                    left_limit_m, right_limit_m = self._reach_m(float(s_m[first]), float(s_m[last]))
                    if max(begin, end) < left_limit_m and min(begin, end) > -right_limit_m:
                        ends = _ends(float(s_m[first]), float(s_m[last]))
                        marks.append(
                            {"offset_m": round(begin, 3), **style, **ends, **_taper("to_offset_m", begin, end)}
                        )
        return _join(marks, ("offset_m",), ("to_offset_m",))

    def _extend(self, number: int, s_m: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Continue what begins or ends with the path along the straight parts of the road beyond."""
        if number == 0 and s_m[0] <= self._samples[0].s_m[0]:
            s_m, values = np.concatenate([[self._road.first_m], s_m]), np.column_stack([values[:, :1], values])
        if number == len(self._samples) - 1 and s_m[-1] >= self._samples[-1].s_m[-1]:
            s_m, values = np.concatenate([s_m, [self._road.last_m]]), np.column_stack([values, values[:, -1:]])
        return s_m, values

    def _reach_m(self, first_m: float, last_m: float) -> tuple[float, float]:
        """Return how far something between two stations may reach to the left and to the right."""
        begin = max(int(np.searchsorted(self._ends_m, first_m)) - 1, 0)
        end = max(int(np.searchsorted(self._ends_m, last_m)), begin + 1)
        highest, lowest = float(self._highest_per_m[begin:end].max()), float(self._lowest_per_m[begin:end].min())
        left_m = MAX_INNER_REACH / highest if highest > 0.0 else math.inf
        right_m = MAX_INNER_REACH / -lowest if lowest < 0.0 else math.inf
        return min(left_m, MAX_REACH_M), min(right_m, MAX_REACH_M)


def _sample(step: PathStep, path_m: FloatArray, stations_m: FloatArray) -> _Samples:
    own_m = np.linspace(step.begin_m, step.end_m, int((step.end_m - step.begin_m) / STEP_M) + 2)
    rows = [step.edge_offsets_m(at_m) for at_m in own_m.tolist()]
    edges_m = {lane: np.array([row[lane] for row in rows]) for lane in rows[0]}
    return _Samples(step, own_m, np.interp(own_m, path_m, stations_m), edges_m)


def _width_of(samples: _Samples, lane: int) -> FloatArray:
    inner = lane - 1 if lane > 0 else lane + 1
    return np.abs(samples.edges_m[lane] - samples.edges_m[inner])


def _neighbours(samples: _Samples) -> tuple[list[FloatArray], list[FloatArray]]:
    """Return the widths of the lanes of the same direction to the left and to the right, the nearest first."""
    lanes, own = samples.step.section.lanes, samples.step.lane
    outwards = 1 if own > 0 else -1

    def walk(direction: int) -> list[FloatArray]:
        widths_m, lane = [], own + direction
        while lane != 0 and lane in lanes and lanes[lane].kind in _DRIVEN_KINDS:
            widths_m.append(_width_of(samples, lane))
            lane += direction
        return widths_m

    inner, outer = walk(-outwards), walk(outwards)
    return (outer, inner) if samples.step.road.left_hand_traffic else (inner, outer)


def _paved_groups(samples: _Samples) -> Iterator[list[int]]:
    """Yield the numbers of lanes of asphalt side by side, from the highest number down."""
    numbers = sorted((lane for lane in samples.edges_m if lane), reverse=True)
    for paved, group in itertools.groupby(numbers, samples.is_paved):
        if paved:
            yield list(group)


def _outer_edges(samples: _Samples, lanes: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Return the left and the right edge of lanes side by side, whose numbers are in falling order."""
    highest, lowest = lanes[0], lanes[-1]
    one = samples.edges_m[highest if highest > 0 else highest + 1]
    other = samples.edges_m[lowest if lowest < 0 else lowest - 1]
    return np.maximum(one, other), np.minimum(one, other)


def _painted(samples: _Samples) -> Iterator[tuple[int, float, float, Keys]]:
    """Yield each painted mark: its lane, the ends on the path, and the keys of its style."""
    section, step = samples.step.section, samples.step
    for lane, item in section.lanes.items():
        begins_m = [min(max(mark.offset_m, 0.0), section.end_m - section.s_m) for mark in item.marks]
        for mark, begin_m, end_m in zip(
            item.marks, begins_m, [*begins_m, section.end_m - section.s_m][1:], strict=True
        ):
            kind = _kind_of(mark.kind)
            if kind is not None and end_m - begin_m > MARK_WIDTH_M:
                ends_m = sorted((step.path_m(section.s_m + begin_m), step.path_m(section.s_m + end_m)))
                style: Keys = {} if kind == "solid" else {"kind": kind}
                if mark.colour in {"yellow", "orange"}:
                    style["colour"] = "yellow"
                if mark.width_m is not None and 0.02 <= mark.width_m <= 1.0 and mark.width_m != MARK_WIDTH_M:
                    style["width_m"] = round(mark.width_m, 3)
                yield lane, ends_m[0], ends_m[1], style


def _kind_of(kind: str) -> str | None:
    """Return the kind of a mark in a road file, or None if nothing is painted there; double lines are one line."""
    if "solid" in kind or kind == "edge":
        return "solid"
    return "broken" if "broken" in kind or kind == "botts dots" else None


def _width_keys(s_m: FloatArray, widths_m: FloatArray) -> Keys:
    """Return the keys `widths_m` and `changes` of widths (n, lanes) at stations (n,)."""
    knots = _knots(s_m, widths_m.T)
    current = _rounded(widths_m[0])
    keys: Keys = {"widths_m": current}
    changes = []
    for first, last in itertools.pairwise(knots):
        widths = _rounded(widths_m[last])
        if max(abs(a - b) for a, b in zip(widths, current, strict=True)) > TOLERANCE_M / 4:
            changes.append({**_ends(float(s_m[first]), float(s_m[last])), "widths_m": widths})
            current = widths
    return {**keys, "changes": changes} if changes else keys


def _knots(s_m: FloatArray, values: FloatArray) -> list[int]:
    """Return indices between which values (m, n) at stations (n,) are linear within the tolerance."""
    knots, last = [0], len(s_m) - 1
    while knots[-1] < last:
        begin = knots[-1]
        good, step = begin + 1, 1
        while good < last and _is_linear(s_m, values, begin, min(good + step, last)):
            good, step = min(good + step, last), 2 * step
        bad = min(good + step, last + 1)
        while bad - good > 1:
            middle = (good + bad) // 2
            good, bad = (middle, bad) if _is_linear(s_m, values, begin, middle) else (good, middle)
        knots.append(good)
    return [knot for knot, following in zip(knots, [*knots[1:], None], strict=True) if _is_apart(s_m, knot, following)]


def _is_apart(s_m: FloatArray, knot: int, following: int | None) -> bool:
    return following is None or float(s_m[following] - s_m[knot]) > 0.001


def _is_linear(s_m: FloatArray, values: FloatArray, begin: int, end: int) -> bool:
    length_m = float(s_m[end] - s_m[begin])
    if length_m <= 0.0:
        return True
    share = (s_m[begin : end + 1] - s_m[begin]) / length_m
    line = values[:, begin : begin + 1] + share * (values[:, end : end + 1] - values[:, begin : begin + 1])
    return bool(np.abs(values[:, begin : end + 1] - line).max() <= TOLERANCE_M)


def _join(pieces: list[Keys], offsets: tuple[str, ...], tapers: tuple[str, ...]) -> list[Keys]:
    """Join constant pieces of the same offsets and style that follow each other, and sort all by their beginning."""
    joined: list[Keys] = []
    open_pieces: dict[tuple[object, ...], Keys] = {}
    for piece in sorted(pieces, key=lambda piece: (piece["from_m"], *(piece[key] for key in offsets))):
        if any(key in piece for key in tapers):
            joined.append(piece)
            continue
        style = tuple(value for key, value in piece.items() if key not in {"from_m", "to_m"})
        before = open_pieces.get(style)
        if before is not None and piece["from_m"] <= before["to_m"] + 0.02:
            before["to_m"] = max(before["to_m"], piece["to_m"])
        else:
            open_pieces[style] = dict(piece)
            joined.append(open_pieces[style])
    return joined


def _ends(from_m: float, to_m: float) -> Keys:
    return {"from_m": round(from_m, 3), "to_m": round(to_m, 3)}


def _taper(key: str, begin: float, end: float) -> Keys:
    return {key: round(end, 3)} if abs(end - begin) > TOLERANCE_M / 4 else {}


def _rounded(widths_m: FloatArray) -> list[float]:
    return [round(width_m, 3) for width_m in widths_m.tolist()]
