"""The lane fit: assigns bird's-eye paint to the left and right line, and fits the lane's centre.

Both lines of a lane are fitted together, as two parallels of one centre y = c0 + c1 x + c2 x^2. A broken line (3 m of
paint, 6 m of gap) alone has too little paint to fit a curve, but two lines fill each other's gaps. The distance along y
between a curve of slope m and its parallel at distance d is d sqrt(1 + m^2). If m is taken from an earlier fit, the fit
is therefore linear.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray
from lavt.perception.bird_eye import GroundGrid
from lavt.perception.lane_paint import Mask

Sides = NDArray[np.int8]
"""For each point +1: left line, -1: right line, 0: neither."""

MIN_PAINT = 128
"""A cell of the bird's-eye mask, 0 to 255, is paint from this value on: half of the cell is covered by paint."""
CORRIDOR_M = 0.7
"""Half the width of the corridor around an expected line: far more than a car moves in one frame, far less than half a
lane."""
OUTLIER_M = 0.25
"""Paint that is farther than this from the last but one fit is left out of the last fit. It is two widths of a mark."""
HALF_WEIGHT_M = (0.3, 0.15)
"""In two weighted fits, paint at this distance from the previous fit has half weight, so that the majority wins."""
MIN_LINE_POINTS = 25
"""Fewer points are not a line: about a metre of a mark at full width has this many cells."""
LINEAR_BELOW_M = 6.0
"""A shorter visible length is fitted without curvature, which would be noise."""
LANE_WIDTH_RANGE_M = (2.6, 4.4)
"""Smallest and largest width of a lane."""
MAX_SLOPE = 0.5
"""Largest slope of the lane relative to the car: a steeper line crosses the lane."""
MAX_CURVATURE_PER_M = 1 / 15
"""Largest curvature of a lane: a car at walking pace could just follow it."""
COVER_BIN_M = 0.5
"""Length of the bins in which the visible share of a line is counted."""
MIN_COVER_POINTS = 4
"""A bin with fewer points on the line shows no paint: a third of the points of a full mark."""
COVER_LINE_M = 0.15
"""Paint this near is on the line: half the width of a mark, plus slightly more for the error of the curve."""
MIN_CLEAN_SHARE = 0.6
"""Minimum share of the paint in the corridor (`CORRIDOR_M`) that is on the line. By chance it would be 0.2."""
SHARP_SPREAD_M = (0.08, 0.144)
"""A line is sharp, or not at all, if its paint has this root mean square distance from it. A mark of 0.15 m has 0.04 m,
a double line 0.12 m, and paint at random within `OUTLIER_M` 0.144 m."""
COVER_BINS_TOGETHER = 2
"""Number of adjacent bins that must show paint: paint shorter than a metre is a spot."""
COVER_REACH_M = 3.0
"""Half the gap of broken marks: paint makes this much of the line before and behind it visible."""


@dataclass(frozen=True, slots=True)
class Points:
    """The centres of paint cells, in the vehicle's frame."""

    x_m: FloatArray
    y_m: FloatArray


@dataclass(frozen=True, slots=True)
class LaneFit:
    """A lane fitted to one picture."""

    centre: tuple[float, float, float]
    width_m: float
    near_m: float
    far_m: float
    left_visible: float
    """Share of the grid's length over which the left line is visible, 0 to 1."""
    right_visible: float
    on_line_share: float
    """Share of the paint in and beside the lane that is on its lines, 0 to 1."""
    left_clear: float
    """Share of the grid's length over which the left line is visible without other paint beside it, times its
    sharpness, 0 to 1."""
    right_clear: float

    @property
    def clearness(self) -> float:
        """The confidence by stricter rules, which a search needs: by the clear shares instead of the visible ones."""
        return (self.left_clear + self.right_clear) / 2 * self._fitting

    @property
    def confidence(self) -> float:
        """The mean visible share of the two lines, times the share of paint on the lines in excess of chance."""
        return (self.left_visible + self.right_visible) / 2 * self._fitting

    @property
    def _fitting(self) -> float:
        by_chance = 4 * OUTLIER_M / (self.width_m + 2 * CORRIDOR_M)
        return max(self.on_line_share - by_chance, 0.0) / (1 - by_chance)


def mark_points(mask: Mask, grid: GroundGrid) -> Points:
    """Return the paint cells of a bird's-eye mask as points on the ground."""
    found: Any = cv2.findNonZero(cv2.threshold(mask, MIN_PAINT - 1, 255, cv2.THRESH_BINARY)[1])
    cells = np.empty((0, 2), dtype=np.int32) if found is None else np.reshape(found, (-1, 2))
    return Points(grid.row_x_m()[cells[:, 1]], grid.column_y_m()[cells[:, 0]])


def sides_near(points: Points, centre: tuple[float, float, float], width_m: float) -> Sides:
    """Assign each point that is near a line of a known lane to that line."""
    middle, slope_factor = evaluate_centre(points.x_m, centre)
    offset = points.y_m - middle
    line = width_m / 2 * slope_factor
    sides = np.where(offset > 0, 1, -1)
    return np.where(np.abs(np.abs(offset) - line) < CORRIDOR_M, sides, 0).astype(np.int8)


def fit_lane(
    points: Points, sides: Sides, grid: GroundGrid, width_m: float, expected: tuple[float, float, float] | None = None
) -> LaneFit | None:
    """Fit a lane to the points of its lines, iteratively reweighted by their residuals; None when there is none.

    `width_m` is the expected width, which is used if only one line is visible or the measured width is not a lane's.
    `expected` is the expected centre, if there is one.
    """
    lane_indices = np.flatnonzero(sides)
    line_points, side = Points(points.x_m[lane_indices], points.y_m[lane_indices]), sides[lane_indices]
    fit: _CentreFit | None
    if expected is None:
        fit = _fit_once(line_points, side, width_m, slope_centre=(0.0, 0.0, 0.0))
    else:
        fit = _CentreFit(expected, width_m)
    for half_weight_m in HALF_WEIGHT_M:
        if fit is None:
            return None
        weights = 1 / (1 + (_residual_m(line_points, side, *fit) / half_weight_m) ** 2)
        fit = _fit_once(line_points, side, width_m, slope_centre=fit.centre, weights=weights)
    if fit is None:
        return None
    is_on_line = np.abs(_residual_m(line_points, side, *fit)) < OUTLIER_M
    kept, kept_side = Points(line_points.x_m[is_on_line], line_points.y_m[is_on_line]), side[is_on_line]
    fit = _fit_once(kept, kept_side, width_m, slope_centre=fit.centre)
    if fit is None:
        return None
    centre, fitted_width_m = fit
    _, c1, c2 = centre
    if abs(c1) > MAX_SLOPE or 2 * abs(c2) > MAX_CURVATURE_PER_M:
        return None
    offset_m = lateral_offset_m(points, centre)
    outside_m = np.abs(offset_m) - fitted_width_m / 2  # distance beyond the nearer line; negative inside the lane
    line_distance_m = np.abs(outside_m)
    left_visible, left_clear = line_shares(points.x_m[offset_m > 0], line_distance_m[offset_m > 0], grid)
    right_visible, right_clear = line_shares(points.x_m[offset_m < 0], line_distance_m[offset_m < 0], grid)
    return LaneFit(
        centre=centre,
        width_m=fitted_width_m,
        near_m=float(kept.x_m.min()),
        far_m=float(kept.x_m.max()),
        left_visible=left_visible,
        right_visible=right_visible,
        left_clear=left_clear,
        right_clear=right_clear,
        on_line_share=float(np.count_nonzero(line_distance_m < OUTLIER_M))
        / max(int(np.count_nonzero(outside_m < CORRIDOR_M)), 1),
    )


def evaluate_centre(x_m: FloatArray, centre: tuple[float, float, float]) -> tuple[FloatArray, FloatArray]:
    """Return y of a centre at x, and the distance to a parallel along y divided by the perpendicular distance."""
    c0, c1, c2 = centre
    slope = c1 + 2 * c2 * x_m
    return c0 + (c1 + c2 * x_m) * x_m, np.sqrt(1 + slope * slope)


def lateral_offset_m(points: Points, centre: tuple[float, float, float]) -> FloatArray:
    """Return the offsets of points to the left of a centre."""
    middle, slope_factor = evaluate_centre(points.x_m, centre)
    return (points.y_m - middle) / slope_factor


def _residual_m(points: Points, side: Sides, centre: tuple[float, float, float], width_m: float) -> FloatArray:
    return lateral_offset_m(points, centre) - side * width_m / 2


class _CentreFit(NamedTuple):
    """A lane's centre c0, c1, c2 and its width."""

    centre: tuple[float, float, float]
    width_m: float


def _fit_once(
    points: Points,
    side: Sides,
    width_m: float,
    slope_centre: tuple[float, float, float],
    weights: FloatArray | None = None,
) -> _CentreFit | None:
    """Fit centre and width by least squares; the slopes of the lines are those of an earlier centre."""
    left = int(np.count_nonzero(side > 0))
    right = len(side) - left
    if max(left, right) < MIN_LINE_POINTS:
        return None
    x, y = points.x_m, points.y_m
    _, slope_factor = evaluate_centre(x, slope_centre)
    half_lane = side * slope_factor / 2
    curve = [np.ones_like(x), x]
    if float(np.ptp(x)) >= LINEAR_BELOW_M:
        curve.append(x * x)
    weight = curve[0] if weights is None else weights
    if min(left, right) >= MIN_LINE_POINTS:
        solved = _solve([*curve, half_lane], y, weight)
        if solved is None:
            return None
        *centre, fitted_width_m = solved
        narrowest_m, widest_m = LANE_WIDTH_RANGE_M
        if narrowest_m <= fitted_width_m <= widest_m:
            return _CentreFit(_centre(centre), float(fitted_width_m))
    # One line, or two that are not a lane's width apart: use the line with more points.
    majority = side == (1 if left >= right else -1)
    solved = _solve([column[majority] for column in curve], (y - width_m * half_lane)[majority], weight[majority])
    return None if solved is None else _CentreFit(_centre(solved.tolist()), width_m)


def _solve(columns: list[FloatArray], y: FloatArray, weight: FloatArray) -> FloatArray | None:
    """Solve the normal equations for up to four unknowns; None if the points do not determine the unknowns."""
    design = np.stack(columns)
    weighted = design * weight
    try:
        return np.asarray(np.linalg.solve(weighted @ design.T, weighted @ y), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None


def _centre(coefficients: Sequence[float]) -> tuple[float, float, float]:
    """Return c0, c1, c2; c2 is 0 if it was not fitted."""
    c0, c1, *c2 = map(float, coefficients)
    return c0, c1, c2[0] if c2 else 0.0


def line_shares(x_m: FloatArray, distance_m: FloatArray, grid: GroundGrid) -> tuple[float, float]:
    """Return the shares of the grid's length on which a line is visible and clear; gaps of broken marks are, too.

    `distance_m` are the points' distances from the line. Only clean paint makes a line visible: paint where most points
    near the line are on it. A line is not clear where other paint is beside it, and less clear as a whole the wider
    its paint is spread, after points at random have been subtracted.
    """
    bins = round((grid.far_m - grid.near_m) / COVER_BIN_M)
    bin_of_point = np.minimum(((x_m - grid.near_m) / COVER_BIN_M).astype(np.int64), bins - 1)
    on_line = np.bincount(bin_of_point[distance_m < COVER_LINE_M], minlength=bins)
    beside = np.bincount(bin_of_point[distance_m < CORRIDOR_M], minlength=bins)
    clean = (on_line >= MIN_COVER_POINTS) & (on_line >= MIN_CLEAN_SHARE * beside)
    runs = np.convolve(clean, np.ones(COVER_BINS_TOGETHER), mode="full") == COVER_BINS_TOGETHER
    # A run is COVER_BINS_TOGETHER clean bins. The line is visible over each run and COVER_REACH_M before and behind it.
    reach = round(COVER_REACH_M / COVER_BIN_M)
    ends = np.flatnonzero(runs)  # the last bins of runs
    visibility_steps = np.zeros(bins + 1)
    np.add.at(visibility_steps, np.maximum(ends - COVER_BINS_TOGETHER + 1 - reach, 0), 1)
    np.add.at(visibility_steps, np.minimum(ends + reach + 1, bins), -1)
    visible = np.cumsum(visibility_steps)[:bins] > 0
    has_other_paint = (beside >= MIN_COVER_POINTS) & ~clean
    return float(np.mean(visible)), float(np.mean(visible & ~has_other_paint)) * _sharpness(distance_m)


def _sharpness(distance_m: FloatArray) -> float:
    """Return how sharp a line is, 0 to 1, from the points' distances from it."""
    on_line_m = distance_m[distance_m < OUTLIER_M]
    others = np.count_nonzero(distance_m < CORRIDOR_M) - len(on_line_m)
    random_per_m = others / (CORRIDOR_M - OUTLIER_M)
    count = len(on_line_m) - random_per_m * OUTLIER_M
    if count < MIN_COVER_POINTS:
        return 0.0
    square_m2 = max(float(on_line_m @ on_line_m) - random_per_m * OUTLIER_M**3 / 3, 0.0) / count
    sharp_m, blurred_m = SHARP_SPREAD_M
    return min(max((blurred_m - math.sqrt(square_m2)) / (blurred_m - sharp_m), 0.0), 1.0)
