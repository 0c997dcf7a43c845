"""Approximate the centre line of lanes by lines, arcs and clothoids that are joined without a kink.

The centre of a lane beside a clothoid or a cubic curve is none of these curves. Between two of its points lies one
clothoid that has their positions and headings (E. Bertolazzi and M. Frego, "G1 fitting with clothoids", 2015). If it is
too far from the centre line, the interval is halved.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from lavt.errors import UserError
from lavt.opendrive.geometry import Clothoid
from lavt.opendrive.lane_path import LanePath, PathPose

TOLERANCE_M = 0.005
"""A clothoid farther from the centre line is halved, if it is long enough."""

MAX_DEVIATION_M = 0.04
"""The largest distance from the centre line, which is needed only where the map has a gap or a kink."""

MIN_PIECE_M = 0.5
SMOOTH_M = 8.0
"""A gap or a kink is smoothed over at most this length."""

MAX_PIECE_TURN_RAD = 1.5
MAX_PIECES = 1000

_SAMPLES = 17
_MAX_STEPS = 20
_STRAIGHT_PER_M = 1e-9
_SAME_TURN_RAD = 1e-7
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)
_SHARES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


class _Fit(NamedTuple):
    """Clothoids with their largest distance from the centre line; infinite if one is too tight."""

    clothoids: list[Clothoid]
    deviation_m: float


class _Fitter:
    """The approximation of one path."""

    def __init__(self, path: LanePath, max_curvature_per_m: float) -> None:
        self._path = path
        self._max_curvature_per_m = max_curvature_per_m
        self._made = 0
        self.tightest_per_m = 0.0
        """The largest curvature of a clothoid that is near enough to the centre line, but too tight."""
        self.failed_at_m = 0.0
        """The middle of the last short interval without a clothoid."""

    def fit(self, begin_m: float, end_m: float) -> _Fit | None:
        """Return clothoids from one distance along the path to another, or None if there are none.

        Where the map has a gap, short clothoids would be nearer to it, but would swerve.
        """
        self._made += 1
        if self._made > 4 * MAX_PIECES:
            raise UserError(f"the lanes need more than {MAX_PIECES} lines, arcs and clothoids: import fewer lanes")
        whole = self._single(begin_m, end_m)
        if whole.deviation_m <= TOLERANCE_M:
            return whole
        halves = None
        if end_m - begin_m >= 2 * MIN_PIECE_M:
            middle_m = (begin_m + end_m) / 2
            first = self.fit(begin_m, middle_m)
            second = None if first is None else self.fit(middle_m, end_m)
            if first is not None and second is not None:
                deviation_m = max(first.deviation_m, second.deviation_m)
                halves = _Fit(first.clothoids + second.clothoids, deviation_m)
                if deviation_m <= TOLERANCE_M or end_m - begin_m > SMOOTH_M:
                    return halves
        if whole.deviation_m <= MAX_DEVIATION_M:
            return whole
        if halves is None and end_m - begin_m < 2 * MIN_PIECE_M:
            self.failed_at_m = (begin_m + end_m) / 2
        return halves

    def _single(self, begin_m: float, end_m: float) -> _Fit:
        path = self._path
        begin, end = path.mean_pose(begin_m), path.mean_pose(end_m)
        clothoid = clothoid_between(begin, end)
        tightest_per_m = max(abs(clothoid.curvature_per_m), abs(clothoid.end_curvature_per_m))
        samples = [path.pose(at_m) for at_m in np.linspace(begin_m, end_m, _SAMPLES)[1:-1].tolist()]
        headings = [begin.heading_rad, *(pose.heading_rad for pose in samples), end.heading_rad]
        turned_rad = sum(abs(math.remainder(b - a, 2 * math.pi)) for a, b in itertools.pairwise(headings))
        if turned_rad > MAX_PIECE_TURN_RAD or not clothoid.length_m > 0.0:
            return _Fit([clothoid], math.inf)
        deviation_m = max(_distance_m(clothoid, begin, pose) for pose in samples)
        if tightest_per_m > self._max_curvature_per_m:
            if deviation_m <= TOLERANCE_M:
                self.tightest_per_m = max(self.tightest_per_m, tightest_per_m)
            return _Fit([clothoid], math.inf)
        return _Fit([clothoid], deviation_m)


def fit_clothoids(path: LanePath, max_curvature_per_m: float) -> list[Clothoid]:
    """Return lines, arcs and clothoids along a path; raise UserError if it has gaps or kinks, or is too tight."""
    knots_m = [0.0]
    for at_m in path.breaks_m():
        if at_m - knots_m[-1] >= MIN_PIECE_M:
            knots_m.append(at_m)
    if path.length_m - knots_m[-1] < MIN_PIECE_M and len(knots_m) > 1:
        knots_m.pop()
    if knots_m[-1] < path.length_m:
        knots_m.append(path.length_m)
    fitter = _Fitter(path, max_curvature_per_m)
    clothoids: list[Clothoid] = []
    for begin_m, end_m in itertools.pairwise(knots_m):
        fitted = fitter.fit(begin_m, end_m)
        if fitted is None:
            raise UserError(_why_not(path, fitter.failed_at_m, fitter.tightest_per_m, max_curvature_per_m))
        clothoids += fitted.clothoids
    clothoids = _join_equal(clothoids)
    if len(clothoids) > MAX_PIECES:
        raise UserError(f"the lanes need more than {MAX_PIECES} lines, arcs and clothoids: import fewer lanes")
    return clothoids


def _why_not(path: LanePath, at_m: float, tightest_per_m: float, max_curvature_per_m: float) -> str:
    """Return the sentence about a part that cannot be approximated."""
    step = path.step(at_m)
    where = f"road {step.road.number} lane {step.lane} near s={step.station_m(at_m):.1f} m"
    if tightest_per_m > 0.0:
        radii = f"a radius of {1 / tightest_per_m:.1f} m, and a road of LAVT at least {1 / max_curvature_per_m:g} m"
        return f"{where}: the lane's centre has {radii}: choose lanes with wider curves"
    return f"{where}: the lane's centre has a gap or a kink: correct the map or choose other lanes"


def _join_equal(clothoids: list[Clothoid]) -> list[Clothoid]:
    """Join neighbouring lines, and neighbouring arcs of the same radius."""
    joined: list[Clothoid] = []
    for clothoid in clothoids:
        ends_per_m = (clothoid.curvature_per_m, clothoid.end_curvature_per_m)
        if joined:
            last = joined[-1]
            curvatures_per_m = (last.curvature_per_m, last.end_curvature_per_m, *ends_per_m)
            length_m = last.length_m + clothoid.length_m
            if (max(curvatures_per_m) - min(curvatures_per_m)) * length_m < _SAME_TURN_RAD:
                turn_rad = last.length_m * last.curvature_per_m + clothoid.length_m * clothoid.curvature_per_m
                joined[-1] = Clothoid(length_m, turn_rad / length_m, turn_rad / length_m)
                continue
        joined.append(clothoid)
    return joined


def clothoid_between(begin: PathPose, end: PathPose) -> Clothoid:
    """Return the clothoid that joins two poses; its length is 0 if there is none."""
    ahead_m, left_m = end.x_m - begin.x_m, end.y_m - begin.y_m
    chord_m, direction_rad = math.hypot(ahead_m, left_m), math.atan2(left_m, ahead_m)
    first_rad = math.remainder(begin.heading_rad - direction_rad, 2 * math.pi)
    last_rad = math.remainder(end.heading_rad - direction_rad, 2 * math.pi)
    turn_rad = last_rad - first_rad
    # The heading, relative to the chord, is first + (turn - bend) t + bend t² at the share t of the length.
    bend_rad = 3.0 * (first_rad + last_rad)
    for _ in range(_MAX_STEPS):
        angles = first_rad + _SHARES * (turn_rad - bend_rad + bend_rad * _SHARES)
        error = float(_WEIGHTS @ np.sin(angles))
        slope = float(_WEIGHTS @ (np.cos(angles) * _SHARES * (_SHARES - 1.0)))
        if abs(error) < 1e-14 or slope == 0.0:
            break
        bend_rad -= error / slope
    share = float(_WEIGHTS @ np.cos(first_rad + _SHARES * (turn_rad - bend_rad + bend_rad * _SHARES)))
    if not share > 0.1 or not abs(bend_rad) < 20.0:  # no solution, or one that makes a loop
        return Clothoid(0.0)
    length_m = chord_m / share
    if length_m == 0.0:
        return Clothoid(0.0)
    curvature, end_curvature = (turn_rad - bend_rad) / length_m, (turn_rad + bend_rad) / length_m
    if abs(end_curvature - curvature) < _STRAIGHT_PER_M:
        curvature = end_curvature = turn_rad / length_m
    if max(abs(curvature), abs(end_curvature)) < _STRAIGHT_PER_M:
        curvature = end_curvature = 0.0
    return Clothoid(length_m, curvature, end_curvature)


def _distance_m(clothoid: Clothoid, begin: PathPose, pose: PathPose) -> float:
    """Return the distance of a point from a clothoid that begins at a pose."""
    cosine, sine = math.cos(begin.heading_rad), math.sin(begin.heading_rad)
    dx_m, dy_m = pose.x_m - begin.x_m, pose.y_m - begin.y_m
    ahead_m, left_m = dx_m * cosine + dy_m * sine, dy_m * cosine - dx_m * sine
    along_m = min(math.hypot(ahead_m, left_m), clothoid.length_m)
    for _ in range(4):
        foot = clothoid.point(along_m)
        beyond_m = (ahead_m - foot.ahead_m) * math.cos(foot.turn_rad) + (left_m - foot.left_m) * math.sin(foot.turn_rad)
        along_m = min(max(along_m + beyond_m, 0.0), clothoid.length_m)
    foot = clothoid.point(along_m)
    return math.hypot(ahead_m - foot.ahead_m, left_m - foot.left_m)
