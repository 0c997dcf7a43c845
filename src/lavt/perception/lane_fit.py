"""The lane fit: assigns bird's-eye paint to the left and right line, and fits the lane's centre.

Both lines of a lane are fitted together, as two parallels of one centre y = c0 + c1 x + c2 x^2. A broken line (3 m of
paint, 6 m of gap) alone has too little paint to fit a curve, but two lines fill each other's gaps. The distance along y
between a curve of slope m and its parallel at distance d is d sqrt(1 + m^2). If m is taken from an earlier fit, the fit
is therefore linear.
"""

from __future__ import annotations

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
REACH_BINS = round(COVER_REACH_M / COVER_BIN_M)
RUN = np.ones((1, COVER_BINS_TOGETHER), dtype=np.uint8)
"""The bins of a run, and in `RUN_AND_REACH` also those that the run makes visible: kernels of morphology."""
RUN_AND_REACH = np.ones((1, COVER_BINS_TOGETHER + 2 * REACH_BINS), dtype=np.uint8)


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
    line = _line_points(points.x_m[lane_indices], points.y_m[lane_indices], sides[lane_indices])
    fit = _fit_once(line, width_m, np.ones(len(line.x_m))) if expected is None else _CentreFit(expected, width_m)
    for half_weight_m in HALF_WEIGHT_M:
        if fit is None:
            return None
        middle_m, slope_factor = evaluate_centre(line.x_m, fit.centre)
        residual_m = (line.y_m - middle_m) / slope_factor - line.side * (fit.width_m / 2)
        weights = 1 / (1 + (residual_m / half_weight_m) ** 2)
        fit = _fit_once(line, width_m, slope_factor, weights)
    if fit is None:
        return None
    middle_m, slope_factor = evaluate_centre(line.x_m, fit.centre)
    residual_m = (line.y_m - middle_m) / slope_factor - line.side * (fit.width_m / 2)
    on_line = np.flatnonzero(np.abs(residual_m) < OUTLIER_M)
    kept = _line_points(line.x_m[on_line], line.y_m[on_line], line.side[on_line])
    fit = _fit_once(kept, width_m, slope_factor[on_line])
    if fit is None:
        return None
    centre, fitted_width_m = fit
    _, c1, c2 = centre
    if abs(c1) > MAX_SLOPE or 2 * abs(c2) > MAX_CURVATURE_PER_M:
        return None
    offset_m = lateral_offset_m(points, centre)
    outside_m = np.abs(offset_m) - fitted_width_m / 2  # distance beyond the nearer line; negative inside the lane
    line_distance_m = np.abs(outside_m)
    (left_visible, right_visible), (left_clear, right_clear) = line_shares(
        points.x_m, line_distance_m, offset_m < 0, grid
    )
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


class _CentreFit(NamedTuple):
    """A lane's centre c0, c1, c2 and its width."""

    centre: tuple[float, float, float]
    width_m: float


class _LinePoints(NamedTuple):
    """The points of a lane's lines, and what all fits to them share."""

    x_m: FloatArray
    y_m: FloatArray
    side: FloatArray
    """For each point +1: left line, -1: right line."""
    left: int
    right: int
    """The number of points of each line."""
    design: FloatArray
    """Factors of the unknowns, (3 or 4, n): 1, x, x^2 unless the points are too near each other, and a free row."""


def _line_points(x_m: FloatArray, y_m: FloatArray, sides: NDArray[np.int8] | FloatArray) -> _LinePoints:
    left = int(np.count_nonzero(sides > 0))
    is_curved = len(x_m) > 0 and float(x_m.max() - x_m.min()) >= LINEAR_BELOW_M
    design = np.ones((4 if is_curved else 3, len(x_m)))
    design[1] = x_m
    if is_curved:
        np.multiply(x_m, x_m, out=design[2])
    return _LinePoints(x_m, y_m, sides.astype(np.float64), left, len(x_m) - left, design)


def _fit_once(
    line: _LinePoints,
    width_m: float,
    slope_factor: FloatArray,
    weights: FloatArray | None = None,
) -> _CentreFit | None:
    """Fit centre and width by least squares; the slope factors of the lines are those of an earlier centre."""
    if max(line.left, line.right) < MIN_LINE_POINTS:
        return None
    design, y = line.design, line.y_m
    np.multiply(line.side, slope_factor / 2, out=design[-1])
    if min(line.left, line.right) >= MIN_LINE_POINTS:
        solved = _solve(design, y, weights)
        if solved is None:
            return None
        *centre, fitted_width_m = solved
        narrowest_m, widest_m = LANE_WIDTH_RANGE_M
        if narrowest_m <= fitted_width_m <= widest_m:
            return _CentreFit(_centre(centre), float(fitted_width_m))
    # One line, or two that are not a lane's width apart: use the line with more points.
    majority = line.side == (1 if line.left >= line.right else -1)
    of_majority = design[:, majority]
    solved = _solve(
        of_majority[:-1], y[majority] - width_m * of_majority[-1], None if weights is None else weights[majority]
    )
    return None if solved is None else _CentreFit(_centre(solved.tolist()), width_m)


def _solve(design: FloatArray, y: FloatArray, weights: FloatArray | None) -> FloatArray | None:
    """Solve the normal equations for up to four unknowns; None if the points do not determine the unknowns."""
    weighted = design if weights is None else design * weights
    try:
        return np.asarray(np.linalg.solve(weighted @ design.T, weighted @ y), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None


def _centre(coefficients: Sequence[float]) -> tuple[float, float, float]:
    """Return c0, c1, c2; c2 is 0 if it was not fitted."""
    c0, c1, *c2 = map(float, coefficients)
    return c0, c1, c2[0] if c2 else 0.0


def line_shares(
    x_m: FloatArray, distance_m: FloatArray, is_right: NDArray[np.bool_], grid: GroundGrid
) -> tuple[list[float], list[float]]:
    """Return the shares of the grid's length on which two lines, left and right, are visible, and those where clear.

    `distance_m` are the points' distances from their line. Only clean paint makes a line visible: paint where most
    points near the line are on it. The gaps of broken marks are visible, too. A line is not clear where other paint is
    beside it, and less clear as a whole the wider its paint is spread, after points at random have been subtracted.
    """
    near = np.flatnonzero(distance_m < CORRIDOR_M)
    distance_m, line = distance_m[near], is_right[near].astype(np.intp)
    bins = round((grid.far_m - grid.near_m) / COVER_BIN_M)
    bin_of_point = ((x_m[near] - grid.near_m) / COVER_BIN_M).astype(np.intp)
    cell = np.minimum(bin_of_point, bins - 1) + bins * line
    beside = np.bincount(cell, minlength=2 * bins)
    on_line = np.bincount(cell[distance_m < COVER_LINE_M], minlength=2 * bins)
    clean = ((on_line >= MIN_COVER_POINTS) & (on_line >= MIN_CLEAN_SHARE * beside)).reshape(2, bins)
    # A run is COVER_BINS_TOGETHER clean bins. A line is visible over each run and COVER_REACH_M before and behind it.
    starts = cv2.erode(clean.view(np.uint8), RUN, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    visible = cv2.dilate(starts, RUN_AND_REACH, anchor=(RUN_AND_REACH.shape[1] - REACH_BINS - 1, 0)).astype(np.bool_)
    has_other_paint = (beside >= MIN_COVER_POINTS).reshape(2, bins) & ~clean
    clear = np.count_nonzero(visible & ~has_other_paint, axis=1) / bins * _sharpness(distance_m, line)
    return (np.count_nonzero(visible, axis=1) / bins).tolist(), clear.tolist()


def _sharpness(distance_m: FloatArray, line: NDArray[np.intp]) -> FloatArray:
    """Return how sharp two lines are, (2,), 0 to 1, from their points' distances from them, up to `CORRIDOR_M`."""
    is_on_line = distance_m < OUTLIER_M
    line_on, on_line_m = line[is_on_line], distance_m[is_on_line]
    found = np.bincount(line_on, minlength=2)
    random_per_m = (np.bincount(line, minlength=2) - found) / (CORRIDOR_M - OUTLIER_M)
    count = found - random_per_m * OUTLIER_M
    square_m2 = np.bincount(line_on, weights=on_line_m * on_line_m, minlength=2) - random_per_m * OUTLIER_M**3 / 3
    sharp_m, blurred_m = SHARP_SPREAD_M
    spread_m = np.sqrt(np.maximum(square_m2, 0.0) / np.maximum(count, MIN_COVER_POINTS))
    sharpness = np.clip((blurred_m - spread_m) / (blurred_m - sharp_m), 0.0, 1.0)
    return np.where(count < MIN_COVER_POINTS, 0.0, sharpness)
