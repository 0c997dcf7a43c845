"""From one picture after another to the lane the car is in: step 9 of the life of a frame."""

from __future__ import annotations

from dataclasses import replace

from lavt.domain import CameraModel, Lane, Picture
from lavt.perception.bird_eye import GroundGrid, bird_eye
from lavt.perception.calibration import CalibratedCamera, calibrated
from lavt.perception.lane_fit import LaneFit, Points, fit_lane, mark_points, sides_by_windows, sides_near, start_line
from lavt.perception.lane_pixels import lane_pixels

SMOOTHING = 0.6
"""Weight of the newest picture in the moving average; `lavt.experiment.theory` reckons with it."""
GRID = GroundGrid()
"""The piece of ground that is looked at."""
LANE_WIDTH_M = 3.5
"""Width of the lane where it cannot be measured yet."""
TRACK_CONFIDENCE = 0.2
"""A fit with less (one line over 40 % of the length) is not followed."""
FORGET_AFTER = 3
"""Pictures without a lane after which the search begins anew: a tenth of a second."""


class LaneDetector:
    """Finds the lane by sliding windows at first, then near where it was, and averages over pictures.

    Confidence is (share of the left line seen + share of the right line seen) / 2 x (share of the paint near the lines
    that lies on them, put so that speckle gets 0 and clean lines 1); seen paint vouches for 3 m to either side. It
    speaks of the newest picture alone: with nothing in it the confidence is 0, and the lane is the one seen last.
    """

    def __init__(
        self,
        camera: CameraModel | CalibratedCamera,
        grid: GroundGrid = GRID,
        lane_width_m: float = LANE_WIDTH_M,
        *,
        stamped: bool = True,
    ) -> None:
        known = calibrated(camera) if isinstance(camera, CameraModel) else camera
        self._shape = (known.height_px, known.width_px, 3)
        self._scale = known.scale
        self._view = bird_eye(known, grid, stamped=stamped)
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
        mask = self._view.from_above(lane_pixels(self._view.region(picture_bgr), self._scale))
        points = mark_points(mask, self._view.grid)
        tracked = self._misses < FORGET_AFTER
        fit = self._near_last(points) if tracked else self._anywhere(points)
        if fit is None or fit.confidence < TRACK_CONFIDENCE:
            self._misses += 1
            self._lane = replace(self._lane, confidence=0.0 if fit is None else fit.confidence)
        else:
            self._misses = 0
            self._lane = averaged(self._lane, fit) if tracked else averaged(None, fit)
        return self._lane

    def _near_last(self, points: Points) -> LaneFit | None:
        sides = sides_near(points, self._lane.centre, self._lane.width_m)
        return fit_lane(points, sides, self._view.grid, self._lane.width_m)

    def _anywhere(self, points: Points) -> LaneFit | None:
        start = start_line(points, self._view.grid, self._lane_width_m)
        if start is None:
            return None
        sides = sides_by_windows(points, self._view.grid, start, self._lane_width_m)
        return fit_lane(points, sides, self._view.grid, self._lane_width_m)


def averaged(before: Lane | None, fit: LaneFit) -> Lane:
    """Move the lane seen before towards the newest fit; the first fit after a loss stands alone."""
    if before is None:
        return Lane(fit.centre, fit.width_m, fit.near_m, fit.far_m, fit.confidence)
    c0, c1, c2 = (old + SMOOTHING * (new - old) for old, new in zip(before.centre, fit.centre, strict=True))
    width_m = before.width_m + SMOOTHING * (fit.width_m - before.width_m)
    return Lane((c0, c1, c2), width_m, fit.near_m, fit.far_m, fit.confidence)
