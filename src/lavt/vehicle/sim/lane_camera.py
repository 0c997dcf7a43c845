"""A camera that gives the lane itself: what a faultless detector would make of the picture from a pose."""

from __future__ import annotations

import math

import numpy as np

from lavt.domain import CameraModel, FloatArray, Lane, Pose, SeenLane
from lavt.vehicle.camera import CapturedFrame
from lavt.vehicle.sim.road import Road

STEP_M = 0.5
"""Between the points of the lane's centre that are looked at."""
LINEAR_BELOW_M = 6.0
"""Of length seen: as with pixels, less gives no curvature."""
POINTS_AT_LEAST = 3


class LaneCamera:
    """A `lavt.vehicle.camera.Camera` without pixels: its pictures are `SeenLane`, fitted to the road's true centre.

    The ground it looks at is that of the detector: `near_m` to `far_m` ahead of the rear axle and `half_width_m` to
    both sides, as far as the camera's field of view has it. Confidence is the share of the lane's two lines in there.
    """

    def __init__(
        self,
        *,
        model: CameraModel,
        rate_hz: float,
        phase_ns: int,
        road: Road,
        near_m: float,
        far_m: float,
        half_width_m: float,
    ) -> None:
        self.model = model
        self.rate_hz = rate_hz
        self.phase_ns = phase_ns
        self._road = road
        self._near_m, self._far_m, self._half_width_m = near_m, far_m, half_width_m
        self._view_slope = math.tan(model.field_of_view_rad / 2)
        self._width_m = road.lanes.widths_m[road.lanes.driven]
        self._reach = round(far_m / STEP_M) + 2
        stations_m = np.arange(-self._reach, road.length_m / STEP_M + 2 * self._reach) * STEP_M
        half_m = self._width_m / 2
        # One array for all: x and y of the centre, of the left line and of the right one, a row for each station.
        self._lines = np.stack([road.across(stations_m, offset_m) for offset_m in (0.0, half_m, -half_m)])
        self._near_s_m = 0.0

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:
        """Give the lane as it is seen from `pose`; None without a pose."""
        if pose is None:
            return None
        return CapturedFrame(number, at_ns, SeenLane(0, at_ns, self.lane_from(pose)))

    def lane_from(self, pose: Pose) -> Lane:
        """Fit the driven lane's centre as far as its lines are in view; confidence 0 where nothing of them is."""
        self._near_s_m = self._road.project(pose.x_m, pose.y_m, self._near_s_m)[0]
        x, y = self._around(pose)
        seen = (x >= self._near_m) & (x <= self._far_m) & (np.abs(y) <= self._half_width_m)
        seen &= np.abs(y) <= (x - self.model.x_m) * self._view_slope
        chosen = seen[1] | seen[2]
        count = int(np.count_nonzero(chosen))
        if count < POINTS_AT_LEAST:
            return Lane((0.0, 0.0, 0.0), self._width_m, self._near_m, self._far_m, 0.0)
        ahead, left = x[0][chosen], y[0][chosen]
        share = np.count_nonzero(seen[1:]) * STEP_M / (2 * (self._far_m - self._near_m))
        centre = _fit(ahead, left, degree=2 if float(np.ptp(ahead)) >= LINEAR_BELOW_M else 1)
        return Lane(centre, self._width_m, float(ahead.min()), float(ahead.max()), min(share, 1.0))

    def _around(self, pose: Pose) -> tuple[FloatArray, FloatArray]:
        """Give the lines around the car in its own frame: x and y, (3, points)."""
        middle = round(self._near_s_m / STEP_M) + self._reach
        lines = self._lines[:, max(middle - self._reach, 0) : middle + self._reach]
        dx, dy = lines[..., 0] - pose.x_m, lines[..., 1] - pose.y_m
        cosine, sine = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        return dx * cosine + dy * sine, dy * cosine - dx * sine


def _fit(x: FloatArray, y: FloatArray, degree: int) -> tuple[float, float, float]:
    """Least squares for c0, c1 and, with degree 2, c2."""
    powers = np.stack([np.ones_like(x), x, x * x][: degree + 1])
    solved = np.linalg.solve(powers @ powers.T, powers @ y).tolist()
    return solved[0], solved[1], solved[2] if degree == 2 else 0.0
