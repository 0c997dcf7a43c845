"""From paint seen from above to the lane's centre: which points are whose, and the curve through them.

Both lines of a lane are fitted at once, as two parallels of one centre y = c0 + c1 x + c2 x^2: broken marks (3 m of
paint, 6 m of gap) leave either line alone too little to fit a curve to, but they fill each other's gaps. A parallel at
distance d of a curve with slope m lies d sqrt(1 + m^2) from it along y, so the fit stays linear when the slope of a
fit before is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray
from lavt.perception.bird_eye import GroundGrid
from lavt.perception.lane_pixels import Mask

Sides = NDArray[np.int8]
"""For each point +1: of the left line, -1: of the right line, 0: of neither."""

PAINT_AT_LEAST = 128  # a cell of the bird's-eye mask is paint when half of it is
CORRIDOR_M = 0.7  # beside the line expected: far more than a car moves in one frame, far less than half a lane
OUTLIER_M = 0.25  # off the first fit: two widths of a mark
POINTS_AT_LEAST = 25  # of a line: a quarter of a metre of paint at full width
LINEAR_BELOW_M = 6.0  # of length seen: the curvature of less is noise
WIDTH_WITHIN_M = (2.6, 4.4)  # a lane's width
COLUMN_BIN_M = 0.1
START_LENGTH_M = 12.0  # the first paint is looked for within more than one period of broken marks
START_SLOPES = (0.0, 0.05, -0.05, 0.1, -0.1, 0.15, -0.15, 0.2, -0.2, 0.25, -0.25)  # straight first: it wins a tie
START_BENDS_PER_M = (0.0, 0.006, -0.006, 0.012, -0.012)  # half the curvature, down to a radius of 42 m
WINDOW_M = (1.0, 0.6)  # a sliding window's length along x, and half its width
WINDOW_POINTS_AT_LEAST = 6
COVER_BIN_M = 0.5
COVER_POINTS_AT_LEAST = 2
COVER_REACH_M = 3.0  # half the gap of broken marks: seen paint vouches for as much road before and behind it


@dataclass(frozen=True, slots=True)
class Points:
    """Middles of the cells that are paint, in the vehicle's frame."""

    x_m: FloatArray
    y_m: FloatArray


@dataclass(frozen=True, slots=True)
class LaneFit:
    """A lane fitted to one picture, or the average of several."""

    centre: tuple[float, float, float]
    width_m: float
    near_m: float
    far_m: float
    left_seen: float
    """Share of the length looked at in which the left line is seen, 0 to 1."""
    right_seen: float
    fitting: float
    """Share of the points taken for this lane's that lie on its lines, 0 to 1."""

    @property
    def confidence(self) -> float:
        """Mean share of the two lines seen, times how much better than by chance the points fit."""
        by_chance = OUTLIER_M / CORRIDOR_M
        return (self.left_seen + self.right_seen) / 2 * max(self.fitting - by_chance, 0.0) / (1 - by_chance)


def mark_points(mask: Mask, grid: GroundGrid) -> Points:
    """Give the cells of a bird's-eye mask that are paint as points on the ground."""
    rows, columns = np.nonzero(mask >= PAINT_AT_LEAST)
    return Points(grid.row_x_m()[rows], grid.column_y_m()[columns])


def sides_near(points: Points, centre: tuple[float, float, float], width_m: float) -> Sides:
    """Tell which points lie near the lines of a lane that is known from before."""
    middle, slope_factor = _along(points.x_m, centre)
    offset = points.y_m - middle
    line = width_m / 2 * slope_factor
    sides = np.where(offset > 0, 1, -1)
    return np.where(np.abs(np.abs(offset) - line) < CORRIDOR_M, sides, 0).astype(np.int8)


def start_line(points: Points, grid: GroundGrid, width_m: float) -> tuple[float, float, float] | None:
    """Guess the centre of the lane the car stands in as c0, c1, c2; None without paint.

    For a few slopes and bends the paint is straightened and counted along y modulo the lane's width, which brings both
    lines of the lane, and those of its neighbours, to the same place; the sharpest peak wins. Lanes repeat every
    `width_m`, so that just one of them has its centre within half of it.
    """
    near = points.x_m < grid.near_m + START_LENGTH_M
    x, y = points.x_m[near], points.y_m[near]
    bins = round(width_m / COLUMN_BIN_M)
    best_score, best = WINDOW_POINTS_AT_LEAST, None
    for bend in START_BENDS_PER_M:
        for slope in START_SLOPES:
            folded = ((y - (slope + bend * x) * x) / width_m * bins).astype(np.int64) % bins
            counts = np.bincount(folded, minlength=bins)
            scores = counts + np.roll(counts, 1) + np.roll(counts, -1)
            if scores.max() > best_score:
                line_m = (float(np.argmax(scores)) + 0.5) / bins * width_m  # between 0 and the width: one of the lines
                best_score, best = int(scores.max()), (line_m - width_m / 2, slope, bend)
    return best


def sides_by_windows(points: Points, grid: GroundGrid, start: tuple[float, float, float], width_m: float) -> Sides:
    """Follow both lines from the near end with a pair of sliding windows that move as one.

    They follow the centre `start`, moved by how far off it they were seen to be last.
    """
    length_m, half_width_m = WINDOW_M
    offset_m = points.y_m - _along(points.x_m, start)[0]
    off_m = 0.0
    sides = np.zeros(len(points.x_m), dtype=np.int8)
    for low_m in np.arange(grid.near_m, grid.far_m, length_m):
        inside = (points.x_m >= low_m) & (points.x_m < low_m + length_m)
        seen_m = []
        for side in (1, -1):
            line_m = off_m + side * width_m / 2
            caught = inside & (np.abs(offset_m - line_m) < half_width_m)
            sides[caught] = side
            if np.count_nonzero(caught) >= WINDOW_POINTS_AT_LEAST:
                seen_m.append(float(np.mean(offset_m[caught])) - line_m)
        if seen_m:
            off_m += sum(seen_m) / len(seen_m)
    return sides


def fit_lane(points: Points, sides: Sides, grid: GroundGrid, width_m: float) -> LaneFit | None:
    """Fit a lane to the points of its lines, leave out what lies off it, and fit again; None when too few are left.

    `width_m` is the width expected; it is used where only one line is seen, or where what is seen is not a lane's.
    """
    of_lane = sides != 0
    chosen, side = Points(points.x_m[of_lane], points.y_m[of_lane]), sides[of_lane]
    first = _fit_once(chosen, side, width_m, slopes_of=(0.0, 0.0, 0.0))
    if first is None:
        return None
    fits = np.abs(_residual_m(chosen, side, *first)) < 2 * OUTLIER_M  # parallels were taken as if straight
    refined = _fit_once(Points(chosen.x_m[fits], chosen.y_m[fits]), side[fits], width_m, slopes_of=first[0])
    if refined is None:
        return None
    fits = np.abs(_residual_m(chosen, side, *refined)) < OUTLIER_M
    kept, kept_side = Points(chosen.x_m[fits], chosen.y_m[fits]), side[fits]
    last = _fit_once(kept, kept_side, width_m, slopes_of=refined[0])
    if last is None:
        return None
    return LaneFit(
        centre=last[0],
        width_m=last[1],
        near_m=float(kept.x_m.min()),
        far_m=float(kept.x_m.max()),
        left_seen=_share_seen(kept.x_m[kept_side > 0], grid),
        right_seen=_share_seen(kept.x_m[kept_side < 0], grid),
        fitting=float(np.mean(fits)),
    )


def _along(x_m: FloatArray, centre: tuple[float, float, float]) -> tuple[FloatArray, FloatArray]:
    """Give y of a centre line at x, and how much farther its parallels lie along y than across."""
    c0, c1, c2 = centre
    slope = c1 + 2 * c2 * x_m
    return c0 + (c1 + c2 * x_m) * x_m, np.sqrt(1 + slope * slope)


def _residual_m(points: Points, side: Sides, centre: tuple[float, float, float], width_m: float) -> FloatArray:
    middle, slope_factor = _along(points.x_m, centre)
    return (points.y_m - middle) / slope_factor - side * width_m / 2


def _fit_once(
    points: Points, side: Sides, width_m: float, slopes_of: tuple[float, float, float]
) -> tuple[tuple[float, float, float], float] | None:
    """Least squares for centre and width; the parallels' slopes are those of an earlier centre."""
    left, right = int(np.count_nonzero(side > 0)), int(np.count_nonzero(side < 0))
    if max(left, right) < POINTS_AT_LEAST:
        return None
    x, y = points.x_m, points.y_m
    half_lane = side * _along(x, slopes_of)[1] / 2
    curve = [np.ones_like(x), x]
    if float(np.ptp(x)) >= LINEAR_BELOW_M:
        curve.append(x * x)
    if min(left, right) >= POINTS_AT_LEAST:
        solved = _solve([*curve, half_lane], y)
        if solved is None:
            return None
        if WIDTH_WITHIN_M[0] <= solved[-1] <= WIDTH_WITHIN_M[1]:
            return _centre(solved[:-1]), float(solved[-1])
    # One line, or two that are not a lane apart: believe the one of which more is seen.
    better = side == (1 if left >= right else -1)
    solved = _solve([column[better] for column in curve], (y - width_m * half_lane)[better])
    return None if solved is None else (_centre(solved), width_m)


def _solve(columns: list[FloatArray], y: FloatArray) -> FloatArray | None:
    """Solve the normal equations: hundreds of points, four unknowns; None when the points do not determine them."""
    design = np.stack(columns)
    try:
        return np.asarray(np.linalg.solve(design @ design.T, design @ y), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None


def _centre(solved: FloatArray) -> tuple[float, float, float]:
    return float(solved[0]), float(solved[1]), float(solved[2]) if len(solved) > 2 else 0.0


def _share_seen(x_m: FloatArray, grid: GroundGrid) -> float:
    """Give the share of the grid's length within reach of paint, so that a broken line counts almost as a solid one."""
    bins = round((grid.far_m - grid.near_m) / COVER_BIN_M)
    counts = np.histogram(x_m, bins, (grid.near_m, grid.far_m))[0]
    reach = round(COVER_REACH_M / COVER_BIN_M)
    seen = np.convolve(counts >= COVER_POINTS_AT_LEAST, np.ones(2 * reach + 1), mode="same") > 0
    return float(np.mean(seen))
