"""From one picture after another to the lane the car is in: step 9 of the life of a frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lavt.domain import NS_PER_MS, CameraModel, Lane, Picture
from lavt.perception.bird_eye import GroundGrid, bird_eye
from lavt.perception.calibration import CalibratedCamera, calibrated
from lavt.perception.lane_fit import (
    OUTLIER_M,
    LaneFit,
    Points,
    Sides,
    fit_lane,
    has_parallel,
    mark_points,
    sides_by_windows,
    sides_near,
    start_line,
)
from lavt.perception.lane_pixels import Mask, lane_pixels

SMOOTHING = 0.6
"""Weight of the newest picture in the moving average; `lavt.experiment.boundary.delay_margin` reckons with it."""
GRID = GroundGrid()
"""The piece of ground that is looked at."""
LANE_WIDTH_M = 3.5
"""Width of the lane where it cannot be measured yet."""
TRACK_CONFIDENCE = 0.2
"""A fit with less (one line over 40 % of the length) is not followed."""
REFINEMENTS = 2
"""Times that a lane found is followed once more, as from picture to picture: a curve seen near leads far."""
FORGET_AFTER = 3
"""Pictures without a lane after which the search begins anew: a tenth of a second."""
FOLLOWS_FOR_NS = 350 * NS_PER_MS
"""A lane is not followed over a longer gap between pictures: whoever feeds the detector calls `forget`.

In that time a lane that bends at a radius of 42 m moves sideways by `CORRIDOR_M`, 10 m ahead of a car that goes
straight on at 30 km/h: then what lies where a line was may be another one.
"""
LEFT_AT_WIDTHS = 1.0
"""A lane is kept until the car is as many of its widths beside it: then it is in the middle of the next one."""


@dataclass(frozen=True, slots=True)
class DetectionTrace:
    """What one picture gave, step by step: for whoever wants to look at it."""

    mask: Mask
    """The marks from above, (grid.rows, grid.columns)."""
    points: Points
    sides: Sides
    expected: tuple[float, float, float] | None
    """The centre near which the lines were looked for; None where there was nothing to begin at."""
    expected_width_m: float
    windows: tuple[tuple[float, float], ...]
    """The sliding windows of a search, as `sides_by_windows` gives them; none where the lane was followed."""
    fit: LaneFit | None
    """The lane in this picture alone; None when there is none."""


class LaneDetector:
    """Finds the lane by sliding windows at first, then near where it was, and averages over pictures.

    Confidence is (share of the left line seen + share of the right line seen) / 2 x (share of the paint in and beside
    the lane that lies on its lines, put so that speckle gets 0 and clean lines 1); seen paint vouches for 3 m each way.
    It speaks of the newest picture alone: with nothing in it the confidence is 0, and the lane is the one seen last.
    docs/perception.md says what values are to be expected.
    """

    def __init__(
        self,
        camera: CameraModel | CalibratedCamera,
        grid: GroundGrid = GRID,
        lane_width_m: float = LANE_WIDTH_M,
        *,
        stamped: bool = True,
    ) -> None:
        calibration = calibrated(camera) if isinstance(camera, CameraModel) else camera
        self._shape = (calibration.height_px, calibration.width_px, 3)
        self._scale = calibration.scale
        self.bird_eye = bird_eye(calibration, grid, stamped=stamped)
        self.trace: DetectionTrace | None = None
        self._lane_width_m = lane_width_m
        self._lane = Lane((0.0, 0.0, 0.0), lane_width_m, grid.near_m, grid.far_m, 0.0)
        self._misses = FORGET_AFTER

    def forget(self) -> None:
        """Take the next picture as the first one: the lane is where it is nearest, not where it was last seen."""
        self._misses = FORGET_AFTER

    def detect(self, picture_bgr: Picture) -> Lane:
        """Give the lane in the next picture, (height, width, 3) as the camera's model says; else ValueError."""
        if picture_bgr.shape != self._shape:
            raise ValueError(f"a picture of shape {picture_bgr.shape}, not {self._shape}")
        mask = self.bird_eye.from_above(lane_pixels(self.bird_eye.region(picture_bgr), self._scale))
        points = mark_points(mask, self.bird_eye.grid)
        tracked = self._misses < FORGET_AFTER
        self.trace = self._follow(mask, points) if tracked else self._search(mask, points)
        fit = self.trace.fit
        if fit is None or fit.confidence < TRACK_CONFIDENCE:
            self._misses += 1
            self._lane = replace(self._lane, confidence=0.0 if fit is None else fit.confidence)
        else:
            self._misses = 0
            self._lane = average_lane(self._lane, fit) if tracked else average_lane(None, fit)
            if car_has_left(self._lane):
                self.forget()
        return self._lane

    def _follow(self, mask: Mask, points: Points) -> DetectionTrace:
        sides = sides_near(points, self._lane.centre, self._lane.width_m)
        fit = fit_lane(points, sides, self.bird_eye.grid, self._lane.width_m, self._lane.centre)
        return DetectionTrace(mask, points, sides, self._lane.centre, self._lane.width_m, (), fit)

    def _search(self, mask: Mask, points: Points) -> DetectionTrace:
        grid = self.bird_eye.grid
        start = start_line(points, grid, self._lane_width_m)
        if start is None:
            return DetectionTrace(
                mask, points, np.zeros(len(points.x_m), dtype=np.int8), None, self._lane_width_m, (), None
            )
        sides, windows = sides_by_windows(points, grid, start, self._lane_width_m)
        # The windows follow any curve, also that of a line which leads aside; the start is rough, but of all the paint.
        fits = (
            self._refine(points, fit_lane(points, sides, grid, self._lane_width_m)),
            self._refine(points, self._fit_near(points, start, self._lane_width_m)),
        )
        lanes = [fit for fit in fits if fit is not None and has_parallel(points, fit, grid) and contains_car(fit)]
        found = max(lanes, key=lambda fit: fit.confidence, default=None)
        return DetectionTrace(mask, points, sides, start, self._lane_width_m, windows, found)

    def _fit_near(self, points: Points, centre: tuple[float, float, float], width_m: float) -> LaneFit | None:
        return fit_lane(points, sides_near(points, centre, width_m), self.bird_eye.grid, width_m, centre)

    def _refine(self, points: Points, fit: LaneFit | None) -> LaneFit | None:
        for _ in range(REFINEMENTS):
            if fit is not None:
                fit = self._fit_near(points, fit.centre, fit.width_m)
        return fit


def contains_car(lane: LaneFit) -> bool:
    """Tell whether the car stands in a lane, as far as a fit can tell; on a line it stands in both."""
    return _lateral_distance_m(lane.centre) <= lane.width_m / 2 + OUTLIER_M


def car_has_left(lane: Lane) -> bool:
    """Tell whether the car is so far beside a lane that it is in the middle of the next one, or beyond."""
    return _lateral_distance_m(lane.centre) > LEFT_AT_WIDTHS * lane.width_m


def _lateral_distance_m(centre: tuple[float, float, float]) -> float:
    c0, c1, _ = centre
    return abs(c0) / math.hypot(1.0, c1)


def average_lane(before: Lane | None, fit: LaneFit | Lane) -> Lane:
    """Move the lane seen before towards the newest one; the first fit after a loss stands alone."""
    if before is None:
        return Lane(fit.centre, fit.width_m, fit.near_m, fit.far_m, fit.confidence)
    c0, c1, c2 = (old + SMOOTHING * (new - old) for old, new in zip(before.centre, fit.centre, strict=True))
    width_m = before.width_m + SMOOTHING * (fit.width_m - before.width_m)
    return Lane((c0, c1, c2), width_m, fit.near_m, fit.far_m, fit.confidence)
