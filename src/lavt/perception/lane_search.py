"""The search for a lane in a single picture: where its lines may be, which paint follows them, and what is believed.

A wall, a kerb or old paint can look like a line. So a search tries several candidates (`start_lanes`), and a lane that
it finds needs two clear parallels (`has_parallel`).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray
from lavt.perception.bird_eye import GroundGrid
from lavt.perception.lane_fit import (
    LANE_WIDTH_RANGE_M,
    OUTLIER_M,
    LaneFit,
    Points,
    Sides,
    evaluate_centre,
    lateral_offset_m,
    line_shares,
)
from lavt.perception.lane_paint import Mask

START_SLOPES = (0.0, 0.05, -0.05, 0.1, -0.1, 0.15, -0.15, 0.2, -0.2, 0.25, -0.25)
"""Slopes that `start_lanes` tries. Straight ahead is the first, so that it wins a tie."""
START_BENDS_PER_M = (0.0, 0.006, -0.006, 0.012, -0.012)
"""Values of c2, which is half the curvature, that `start_lanes` tries: down to a radius of 42 m."""
START_CURVES = np.array([(slope, bend) for bend in START_BENDS_PER_M for slope in START_SLOPES])
"""The tried curves: c1 and c2, (n, 2)."""
START_CELL_M = (0.5, 0.1)
"""Length and width of the coarse cells in which `start_lanes` counts paint. A cell counts once, however much paint it
has: a wide patch is not worth more than a line."""
START_CELL_PAINT = 50
"""The mean of a coarse cell, 0 to 255, above which it is painted: two of its ten cells."""
START_REACH_M = 8.0
"""How far to the side, at the rear axle, straightened paint is counted."""
MIN_START_CELLS = 6
"""With fewer painted coarse cells there is no candidate: two lines of 1.5 m."""
START_WIDTH_STEPS_M = (-0.7, -0.5, -0.3, -0.1, 0.1, 0.3, 0.5, 0.7)
"""Differences from the expected width of a lane that are tried."""
WIDTH_PENALTY_PER_M = 1.2
"""What a difference from the expected width costs. A line that is painted along the whole grid is worth about 7."""
BEND_PENALTY_M = 25.0
"""What a bend (c2) costs."""
NEIGHBOUR_WEIGHT = 0.7
"""The weight of the next lines on both sides of the lane: they make up for a missing line of the lane."""
DIFFERENT_M = 0.5
"""Two candidates differ if their centres do by this much, near or far."""
COMPARED_AT_M = (6.0, 12.0)
"""Distances at which candidates are compared."""
WINDOW_M = (1.0, 0.6)
"""Length of a sliding window along x, and half its width."""
MIN_WINDOW_POINTS = 6
"""A window with fewer points measures no offset."""
MIN_LINE_CLEAR = 0.2
"""Clear share that a line needs to be one of two parallels."""
MIN_PARALLEL_VISIBLE = 0.2
"""Visible share that a parallel needs to be the line of a neighbouring lane."""


class StartLane(NamedTuple):
    """A candidate with which a search begins: centre c0, c1, c2, and width."""

    centre: tuple[float, float, float]
    width_m: float


class _StartPairs(NamedTuple):
    """Pairs of lines around the car, and the bins of their lines and of the next ones."""

    centre_m: FloatArray
    width_m: FloatArray
    line_bins: NDArray[np.intp]
    """(4, n): left and right line, and the lines to the left and to the right of them."""
    bins: int


@lru_cache(maxsize=8)
def _start_pairs(width_m: float) -> _StartPairs:
    bin_m, half = START_CELL_M[1], round(START_REACH_M / START_CELL_M[1])
    narrowest_m, widest_m = LANE_WIDTH_RANGE_M
    widths_m = [width_m + step for step in START_WIDTH_STEPS_M if narrowest_m <= width_m + step <= widest_m]
    pairs = np.array(
        [
            (centre * bin_m, width)
            for width in widths_m or [width_m]
            for centre in range(-half, half + 1)
            if abs(centre * bin_m) <= width / 2 + OUTLIER_M
        ]
    )
    lines_m = pairs[:, 0] + np.array([[0.5], [-0.5], [1.5], [-1.5]]) * pairs[:, 1]
    line_bins = np.clip(np.rint(lines_m / bin_m).astype(np.intp) + half, 0, 2 * half)
    return _StartPairs(pairs[:, 0], pairs[:, 1], line_bins, 2 * half + 1)


def start_lanes(mask: Mask, grid: GroundGrid, width_m: float, count: int) -> list[StartLane]:
    """Return up to `count` different lanes that contain the car, the most likely first; none without paint.

    For several slopes and bends the paint is straightened and counted across the road. A pair of lines is worth the
    root of the paint on each of them, so two broken lines are worth more than one solid wall with the same paint.
    """
    rows, columns = round(START_CELL_M[0] / grid.step_x_m), round(START_CELL_M[1] / grid.step_y_m)
    size = (grid.columns // columns, -(-grid.rows // rows))
    coarse_rows, coarse_columns = np.nonzero(cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > START_CELL_PAINT)
    if len(coarse_rows) < MIN_START_CELLS:
        return []
    x = grid.far_m - (coarse_rows + 0.5) * (grid.far_m - grid.near_m) / size[1]
    y = grid.half_width_m - (coarse_columns + 0.5) * 2 * grid.half_width_m / size[0]
    pairs = _start_pairs(width_m)
    straight_m = y - (START_CURVES[:, :1] + START_CURVES[:, 1:] * x) * x
    bins = np.rint(straight_m / START_CELL_M[1]).astype(np.intp) + pairs.bins // 2
    inside = (bins >= 0) & (bins < pairs.bins)
    flat = (bins + pairs.bins * np.arange(len(START_CURVES))[:, None])[inside]
    counts = np.bincount(flat, minlength=pairs.bins * len(START_CURVES)).reshape(-1, pairs.bins)
    support = counts.astype(np.float64)
    support[:, 1:] += counts[:, :-1]
    support[:, :-1] += counts[:, 1:]
    np.sqrt(support, out=support)
    left, right, next_left, next_right = (support[:, line] for line in pairs.line_bins)
    scores = left + right + NEIGHBOUR_WEIGHT * (next_left + next_right)
    scores -= WIDTH_PENALTY_PER_M * np.abs(pairs.width_m - width_m)
    scores -= BEND_PENALTY_M * np.abs(START_CURVES[:, 1:])
    return _best_different(scores, pairs, count)


def _best_different(scores: FloatArray, pairs: _StartPairs, count: int) -> list[StartLane]:
    """Return the lanes with the highest scores, (curves, pairs), that differ from each other."""
    slopes, bends = START_CURVES[:, :1], START_CURVES[:, 1:]
    centres_m = [pairs.centre_m + (slopes + bends * x) * x for x in COMPARED_AT_M]
    lanes: list[StartLane] = []
    for _ in range(count):
        curve, pair = divmod(int(np.argmax(scores)), scores.shape[1])
        if scores[curve, pair] <= 0:
            break
        centre = (float(pairs.centre_m[pair]), *(float(value) for value in START_CURVES[curve]))
        lanes.append(StartLane((centre[0], centre[1], centre[2]), float(pairs.width_m[pair])))
        near, far = (np.abs(centre_m - centre_m[curve, pair]) < DIFFERENT_M for centre_m in centres_m)
        scores[near & far] = 0.0
    return lanes


def sides_by_windows(
    points: Points, grid: GroundGrid, start: tuple[float, float, float], width_m: float
) -> tuple[Sides, tuple[tuple[float, float], ...]]:
    """Follow both lines from the near end with a pair of sliding windows that move together.

    The windows follow the centre `start`, shifted by the last measured offset. Returns the sides and, for each
    position of the pair, its near end (x) and the offset of its middle to the left of `start`, in metres.
    """
    length_m, half_width_m = WINDOW_M
    start_y_m, _ = evaluate_centre(points.x_m, start)
    offset_m = points.y_m - start_y_m
    middle_m = 0.0
    sides = np.zeros(len(points.x_m), dtype=np.int8)
    windows = []
    for low_m in np.arange(grid.near_m, grid.far_m, length_m):
        inside = (points.x_m >= low_m) & (points.x_m < low_m + length_m)
        measured_offsets_m = []
        windows.append((float(low_m), middle_m))
        for side in (1, -1):
            line_m = middle_m + side * width_m / 2
            in_window = inside & (np.abs(offset_m - line_m) < half_width_m)
            sides[in_window] = side
            if np.count_nonzero(in_window) >= MIN_WINDOW_POINTS:
                measured_offsets_m.append(float(np.mean(offset_m[in_window])) - line_m)
        if measured_offsets_m:
            middle_m += sum(measured_offsets_m) / len(measured_offsets_m)
    return sides, tuple(windows)


def has_parallel(points: Points, fit: LaneFit, grid: GroundGrid) -> bool:
    """Return whether two lines a lane's width apart are to be seen.

    They are both lines of this lane, or one of them and the next line on the other side of it.
    """
    clear_sides = [side for side, share in ((1, fit.left_clear), (-1, fit.right_clear)) if share >= MIN_LINE_CLEAR]
    if len(clear_sides) != 1:
        return len(clear_sides) == 2
    (side,) = clear_sides
    distance_m = np.abs(lateral_offset_m(points, fit.centre) - side * 1.5 * fit.width_m)
    (visible, _), _ = line_shares(points.x_m, distance_m, np.zeros(len(distance_m), dtype=np.bool_), grid)
    return visible >= MIN_PARALLEL_VISIBLE
