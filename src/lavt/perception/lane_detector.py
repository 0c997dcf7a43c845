"""The lane detectors: one for pictures, and one for the true lanes of a camera without pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from lavt.domain import NS_PER_MS, CameraModel, Lane, Picture, SeenLane
from lavt.errors import UserError
from lavt.perception.bird_eye import GroundGrid, make_bird_eye
from lavt.perception.calibration import CalibratedCamera, calibrated_pinhole_camera
from lavt.perception.detection import LANE_WIDTH_M, TRACK_CONFIDENCE, PaintFinder
from lavt.perception.lane_fit import (
    OUTLIER_M,
    LaneFit,
    Points,
    Sides,
    evaluate_centre,
    fit_lane,
    mark_points,
    sides_near,
)
from lavt.perception.lane_paint import Mask, lane_paint
from lavt.perception.lane_search import has_parallel, sides_by_windows, start_lanes

SMOOTHING = 0.6
"""Weight of the newest picture in the moving average; `lavt.experiment.boundary.delay_margin` depends on it."""
GRID = GroundGrid()
"""The ground searched for the lane."""
MIN_CLEARNESS = 0.35
"""A search finds no lane with less clearness (`LaneFit.clearness`): there is no earlier picture that supports it."""
START_LANES = 3
"""How many candidates a search fits."""
CLEAR_ENOUGH = 0.7
"""A search ends at a lane with this clearness, and does not try the other candidates."""
REFINEMENTS = 2
"""How often a lane that a search found is fitted again: each fit brings the curve nearer to the far paint, so that the
next fit uses more of this paint."""
FORGET_AFTER_PICTURES = 3
"""After this many pictures without a lane, a tenth of a second, the search restarts."""
LONGEST_GAP_NS = 350 * NS_PER_MS
"""The longest gap between pictures over which a lane is tracked; after a longer one the caller calls `forget`.

In this time a car drives 2.9 m at 30 km/h. If it drives straight and the lane has a radius of 42 m, the lane 10 m ahead
of the car moves sideways by 0.7 m, the tracking range (`CORRIDOR_M` in `lane_fit.py`). After a longer gap another line
could be at the old position.
"""
BOTH_SEEN = 0.6
SINGLE_LINE = 0.2
"""If both lines were visible over the first share of the range, and in the next picture one of them over less than the
second share, then a line has vanished at once."""
SHIFT_M = 0.25
TURN_RAD = 0.05
"""When a line vanishes at once, the other one must not have moved and turned by more than this.

A car at 30 km/h that slides aside at 1 m/s and turns at 0.7 rad/s moves it by 0.03 m and turns it by 0.02 rad in a
thirtieth of a second, and the averaged lane lags by two thirds of that.
"""
COMPARED_AT_M = np.array([5.0, 10.0, 15.0])
"""Distances at which the line is compared."""
DROP_LANE_AT_WIDTHS = 1.0
"""A lane is dropped when the car is this many lane widths off its centre: the car is then in the middle of the next
lane."""


@dataclass(frozen=True, slots=True)
class DetectionTrace:
    """The results of all steps of lane detection in one picture, for inspection."""

    mask: Mask
    """The paint in the bird's-eye view, (grid.rows, grid.columns)."""
    points: Points
    sides: Sides
    expected: tuple[float, float, float] | None
    """The centre near which the lines were looked for: of the previous lane, or in a search the first candidate of
    `start_lanes`; None if it found no paint."""
    expected_width_m: float
    windows: tuple[tuple[float, float], ...]
    """The sliding windows of a search, as `sides_by_windows` returns them; empty if the lane was tracked."""
    fit: LaneFit | None
    """The lane in this picture alone; None if there is none, or none that is believed."""

    @property
    def is_search(self) -> bool:
        """Whether the lane was searched, and not tracked from the last picture."""
        return bool(self.windows) or self.expected is None


class LaneDetector:
    """A lane detector that searches with sliding windows at first, then tracks the lane, and averages over pictures.

    Confidence is (visible share of the left line + visible share of the right line) / 2 x (share of the paint in and
    beside the lane that is on its lines, scaled to 0 for speckle and 1 for clean lines). A line is visible where it has
    paint, and 3 m before and behind. Confidence refers to the newest picture alone: without a lane in it the confidence
    is 0 and the lane is the last one detected. docs/perception.md lists the values to expect. `paint_finder` replaces
    LAVT's own test for paint.
    """

    def __init__(
        self,
        camera: CameraModel | CalibratedCamera,
        grid: GroundGrid = GRID,
        lane_width_m: float = LANE_WIDTH_M,
        *,
        stamped: bool = True,
        track_confidence: float = TRACK_CONFIDENCE,
        paint_finder: PaintFinder | None = None,
    ) -> None:
        calibration = calibrated_pinhole_camera(camera) if isinstance(camera, CameraModel) else camera
        self._shape = (calibration.height_px, calibration.width_px, 3)
        self.bird_eye = make_bird_eye(calibration, grid, stamped=stamped)
        self.trace: DetectionTrace | None = None
        self._lane_width_m = lane_width_m
        self._track_confidence = track_confidence
        self._paint_finder = paint_finder
        self._lane = Lane((0.0, 0.0, 0.0), lane_width_m, grid.near_m, grid.far_m, 0.0)
        self._misses = FORGET_AFTER_PICTURES
        self._second_line = 0.0
        """The visible share of the less visible line in the last picture; 0 if no lane was believed in it."""

    @property
    def finds_paint_itself(self) -> bool:
        """Whether LAVT's own test for paint is used."""
        return self._paint_finder is None

    def forget(self) -> None:
        """Search the next picture for the lane that contains the car, instead of tracking the last lane."""
        self._misses = FORGET_AFTER_PICTURES

    def detect(self, picture_bgr: Picture) -> Lane:
        """Return the lane in the next picture; raise `ValueError` unless its shape is the camera's, (h, w, 3)."""
        if picture_bgr.shape != self._shape:
            raise ValueError(f"the picture has the shape {picture_bgr.shape}, not {self._shape}")
        mask = self._paint(picture_bgr)
        points = mark_points(mask, self.bird_eye.grid)
        tracked = self._misses < FORGET_AFTER_PICTURES
        self.trace = self._track(mask, points) if tracked else self._search(mask, points)
        fit = self.trace.fit
        if fit is None or fit.confidence < self._track_confidence:
            self._misses += 1
            self._second_line = 0.0
            self._lane = replace(self._lane, confidence=0.0 if fit is None else fit.confidence)
        else:
            self._misses = 0
            self._second_line = min(fit.left_visible, fit.right_visible)
            self._lane = average_lane(self._lane, fit) if tracked else average_lane(None, fit)
            if car_has_left(self._lane):
                self.forget()
        return self._lane

    def _paint(self, picture_bgr: Picture) -> Mask:
        """Return the mask of paint in the view from above; raise `UserError` for a mask that is not the picture's."""
        bird_eye = self.bird_eye
        if self._paint_finder is None:
            return lane_paint(bird_eye.view_from_above(bird_eye.region(picture_bgr)), bird_eye.grid)
        paint = self._paint_finder.find_paint(picture_bgr)
        if paint.shape != picture_bgr.shape[:2] or paint.dtype != np.uint8:
            raise UserError(
                f"{type(self._paint_finder).__name__} made a mask of {paint.dtype} with the shape {paint.shape}, but "
                f"LAVT needs uint8 and the shape of the picture, {picture_bgr.shape[:2]}: correct its find_paint"
            )
        return bird_eye.view_from_above(bird_eye.region(paint))

    def _track(self, mask: Mask, points: Points) -> DetectionTrace:
        sides = sides_near(points, self._lane.centre, self._lane.width_m)
        fit = fit_lane(points, sides, self.bird_eye.grid, self._lane.width_m, self._lane.centre)
        if fit is not None and fit.confidence >= self._track_confidence and self._is_another_line(fit):
            self.forget()
            fit = None
        return DetectionTrace(mask, points, sides, self._lane.centre, self._lane.width_m, (), fit)

    def _is_another_line(self, fit: LaneFit) -> bool:
        return self._second_line >= BOTH_SEEN and is_another_line(fit, self._lane.centre)

    def _search(self, mask: Mask, points: Points) -> DetectionTrace:
        grid = self.bird_eye.grid
        starts = start_lanes(mask, grid, self._lane_width_m, START_LANES)
        if not starts:
            return DetectionTrace(
                mask, points, np.zeros(len(points.x_m), dtype=np.int8), None, self._lane_width_m, (), None
            )
        # A candidate is rough, but uses all paint. Windows follow any curve, also a line that leads away from the lane.
        # So the candidates and the windows along the first one are fitted, until a lane is clear enough.
        first, width_m = starts[0]
        sides, windows = sides_by_windows(points, grid, first, width_m)
        found = None
        for start in (starts[0], None, *starts[1:]):
            rough = fit_lane(points, sides, grid, width_m) if start is None else self._fit_near(points, *start)
            fit = self._refine(points, rough)
            if fit is not None and self._is_believed(points, fit):
                found = max(found or fit, fit, key=lambda lane: lane.clearness)
                if found.clearness >= CLEAR_ENOUGH:
                    break
        return DetectionTrace(mask, points, sides, first, width_m, windows, found)

    def _is_believed(self, points: Points, fit: LaneFit) -> bool:
        return fit.clearness >= MIN_CLEARNESS and contains_car(fit) and has_parallel(points, fit, self.bird_eye.grid)

    def _fit_near(self, points: Points, centre: tuple[float, float, float], width_m: float) -> LaneFit | None:
        return fit_lane(points, sides_near(points, centre, width_m), self.bird_eye.grid, width_m, centre)

    def _refine(self, points: Points, fit: LaneFit | None) -> LaneFit | None:
        for _ in range(REFINEMENTS):
            if fit is not None:
                fit = self._fit_near(points, fit.centre, fit.width_m)
        return fit


class GroundTruthLaneDetector:
    """A detector for fidelity `geometry`. It averages true lanes as `LaneDetector` averages detected ones.

    Both detectors therefore have the same effect on the control loop's dynamics. When little of the lane is visible,
    the confidence is low and the lane is the last one detected.
    """

    def __init__(self, track_confidence: float = TRACK_CONFIDENCE) -> None:
        self._track_confidence = track_confidence
        self._lane = Lane((0.0, 0.0, 0.0), LANE_WIDTH_M, GRID.near_m, GRID.far_m, 0.0)
        self._misses = FORGET_AFTER_PICTURES

    def forget(self) -> None:
        """Restart the average with the next lane."""
        self._misses = FORGET_AFTER_PICTURES

    def detect(self, seen_lane: SeenLane) -> Lane:
        """Return the moving average of this lane and the previous ones."""
        lane = seen_lane.lane
        if lane.confidence < self._track_confidence:
            self._misses += 1
            self._lane = replace(self._lane, confidence=lane.confidence)
        else:
            self._lane = average_lane(self._lane if self._misses < FORGET_AFTER_PICTURES else None, lane)
            self._misses = 0
        return self._lane


def contains_car(lane: LaneFit) -> bool:
    """Return whether the car is in a lane, within a fit's accuracy; a car on a line is in the lanes on both sides."""
    return _lateral_distance_m(lane.centre) <= lane.width_m / 2 + OUTLIER_M


def is_another_line(fit: LaneFit, before: tuple[float, float, float]) -> bool:
    """Return whether a lane has a single line, and that line is not near the last picture's lane, given its centre.

    A kerb within reach of the last line is fitted like a line. A line that stays alone does not jump.
    """
    if min(fit.left_visible, fit.right_visible) >= SINGLE_LINE:
        return False
    shift_m = np.abs(evaluate_centre(COMPARED_AT_M, fit.centre)[0] - evaluate_centre(COMPARED_AT_M, before)[0])
    return bool(np.any(shift_m > SHIFT_M + TURN_RAD * COMPARED_AT_M))


def car_has_left(lane: Lane) -> bool:
    """Return whether the car is so far off a lane that it is in the middle of the next one, or beyond."""
    return _lateral_distance_m(lane.centre) > DROP_LANE_AT_WIDTHS * lane.width_m


def _lateral_distance_m(centre: tuple[float, float, float]) -> float:
    c0, c1, _ = centre
    return abs(c0) / math.hypot(1.0, c1)


def average_lane(before: Lane | None, fit: LaneFit | Lane) -> Lane:
    """Return the previous lane moved towards the newest one; without a previous lane, the newest one."""
    if before is None:
        return Lane(fit.centre, fit.width_m, fit.near_m, fit.far_m, fit.confidence)
    c0, c1, c2 = (old + SMOOTHING * (new - old) for old, new in zip(before.centre, fit.centre, strict=True))
    width_m = before.width_m + SMOOTHING * (fit.width_m - before.width_m)
    return Lane((c0, c1, c2), width_m, fit.near_m, fit.far_m, fit.confidence)
