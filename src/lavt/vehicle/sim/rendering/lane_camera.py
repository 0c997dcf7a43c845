"""A camera that delivers the lane itself, as a perfect detector would find it in the picture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from lavt.domain import CameraModel, Lane, Pose, SeenLane
from lavt.streams import IndexedStream
from lavt.vehicle.camera import CapturedFrame, newest_pose
from lavt.vehicle.sim.road.road import Road

LINEAR_BELOW_M = 6.0
"""If the visible part of the lane is shorter than this length, no curvature is fitted, as in `lane_fit`."""

MIN_POINTS = 3
"""If fewer points of the centre are visible, no lane is fitted."""

_ABEAM_RAD = math.radians(89.9)
"""The largest angle between straight ahead and an edge of the field of view, because ground at a larger angle is not
ahead."""

STATION_SPACING_M = 1.0
"""The spacing of the sampled points on the lane's lines."""


class LaneNoise:
    """Normally distributed noise of a lane's lateral position and direction at the rear axle.

    It is independent between frames. That of a frame depends only on the seed and on the frame's number.
    """

    def __init__(self, seed: int, position_m: float, direction_rad: float) -> None:
        self._deviations = (position_m, direction_rad)
        self._stream = IndexedStream(seed, "lane noise")

    def added_to(self, lane: Lane, number: int) -> Lane:
        """Return the lane of a frame with its noise."""
        moved_m, turned_rad = (self._stream.at(number).standard_normal(2) * self._deviations).tolist()
        c0, c1, c2 = lane.centre
        return replace(lane, centre=(c0 + moved_m, c1 + turned_rad, c2))


class LaneCamera:
    """A `lavt.vehicle.camera.Camera` without pixels: its pictures are `SeenLane`, fitted to the road's true centre.

    The lane is visible on the detector's ground: between `near_m` and `far_m` ahead of the rear axle, up to
    `half_width_m` to both sides, and in the camera's field of view. The camera's position, yaw and horizontal angle
    matter; pitch and roll do not. Confidence is the share of the lane's two lines that is visible. A car that is turned
    by more than 90 degrees sees no lane. With `noise`, the captured lanes are not exact.
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
        exposure_ns: int = 0,
        sensor_delay_ns: int = 0,
        noise: LaneNoise | None = None,
    ) -> None:
        self.model = model
        self.rate_hz = rate_hz
        self.phase_ns = phase_ns
        self.exposure_ns = exposure_ns
        self.sensor_delay_ns = sensor_delay_ns
        self._noise = noise
        self._road = road
        self._near_m, self._far_m, self._half_width_m = near_m, far_m, half_width_m
        half_rad = model.field_of_view_rad / 2
        self._left_slope, self._right_slope = (
            math.tan(min(max(model.yaw_rad + edge_rad, -_ABEAM_RAD), _ABEAM_RAD)) for edge_rad in (half_rad, -half_rad)
        )
        self._lanes = road.lanes
        self._count_ahead = math.ceil(math.hypot(far_m, half_width_m) / STATION_SPACING_M) + 1
        stations_m = np.arange(road.route_length_m / STATION_SPACING_M + 2 * self._count_ahead) * STATION_SPACING_M
        half_m = np.array([self._lanes.driven_width_at(s_m) for s_m in stations_m.tolist()]) / 2
        lines = [road.point_at(stations_m, offset_m) for offset_m in (0.0, half_m, -half_m)]
        self._line_points: list[list[float]] = np.concatenate(lines, axis=1).tolist()
        """For each station, world x and y of the lane's centre, of its left line, and of its right line."""
        self._near_station_m = 0.0
        """The station of the car at the last call."""

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:
        """Return the lane visible from `pose`; None without a pose."""
        if pose is None:
            return None
        lane = self.observe_lane(pose)
        if self._noise is not None:
            lane = self._noise.added_to(lane, number)
        return CapturedFrame(number, at_ns, SeenLane(0, at_ns, lane))

    def capture_after_exposure(self, number: int, begin_ns: int, poses: Sequence[Pose]) -> CapturedFrame | None:
        """Return the lane visible from the middle between the poses when the shutter opens and when it closes."""
        first, last = newest_pose(poses, begin_ns), newest_pose(poses, begin_ns + self.exposure_ns)
        if first is None or last is None:
            return None
        turn_rad = math.remainder(last.heading_rad - first.heading_rad, 2 * math.pi)
        middle_ns = begin_ns + self.exposure_ns // 2
        x_m, y_m = (first.x_m + last.x_m) / 2, (first.y_m + last.y_m) / 2
        return self.capture(number, middle_ns, Pose(middle_ns, x_m, y_m, first.heading_rad + turn_rad / 2))

    def observe_lane(self, pose: Pose) -> Lane:
        """Fit the driven lane's centre where one of its lines is visible; the confidence is 0 if no lane is fitted."""
        self._near_station_m = self._road.project(pose.x_m, pose.y_m, self._near_station_m)[0]
        first = max(math.ceil(self._near_station_m / STATION_SPACING_M), 0)
        cosine, sine = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        x_m, y_m = pose.x_m, pose.y_m
        near_m, far_m, half_width_m = self._near_m, self._far_m, self._half_width_m
        left_slope, right_slope = self._left_slope, self._right_slope
        lens_x_m, lens_y_m = self.model.x_m, self.model.y_m
        centre, visible_line_points = [], 0
        # The same code for the left and the right line; a loop over the two would take half of this function's time.
        for centre_x, centre_y, left_x, left_y, right_x, right_y in self._line_points[
            first : first + self._count_ahead
        ]:
            visible_lines = 0
            dx, dy = left_x - x_m, left_y - y_m
            ahead_m = dx * cosine + dy * sine
            if near_m <= ahead_m <= far_m:
                left_m, depth_m = dy * cosine - dx * sine, ahead_m - lens_x_m
                in_view = right_slope * depth_m <= left_m - lens_y_m <= left_slope * depth_m
                if in_view and -half_width_m <= left_m <= half_width_m:
                    visible_lines = 1
            dx, dy = right_x - x_m, right_y - y_m
            ahead_m = dx * cosine + dy * sine
            if near_m <= ahead_m <= far_m:
                left_m, depth_m = dy * cosine - dx * sine, ahead_m - lens_x_m
                in_view = right_slope * depth_m <= left_m - lens_y_m <= left_slope * depth_m
                if in_view and -half_width_m <= left_m <= half_width_m:
                    visible_lines += 1
            if visible_lines:
                visible_line_points += visible_lines
                dx, dy = centre_x - x_m, centre_y - y_m
                centre.append((dx * cosine + dy * sine, dy * cosine - dx * sine))
        width_m = self._lanes.driven_width_at(self._near_station_m)
        if len(centre) < MIN_POINTS:
            return Lane((0.0, 0.0, 0.0), width_m, near_m, far_m, 0.0)
        share = visible_line_points * STATION_SPACING_M / (2 * (far_m - near_m))
        near_m, far_m = min(centre)[0], max(centre)[0]
        return Lane(_fit_centre(centre, far_m - near_m >= LINEAR_BELOW_M), width_m, near_m, far_m, min(share, 1.0))


def _fit_centre(points: list[tuple[float, float]], curved: bool) -> tuple[float, float, float]:
    """Fit y = c0 + c1 x and, if `curved`, + c2 x^2 to points (x, y) by least squares.

    x is counted from its mean, so that the normal equations are well conditioned. For two dozen points plain floats are
    faster than arrays.
    """
    n = len(points)
    mean = sum(x for x, _ in points) / n
    x2 = x3 = x4 = y0 = y1 = y2 = 0.0
    for x, y in points:
        u = x - mean
        uu = u * u
        x2 += uu
        x3 += uu * u
        x4 += uu * uu
        y0 += y
        y1 += y * u
        y2 += y * uu
    bend = 0.0
    if curved:
        bend = (y2 - y0 * x2 / n - y1 * x3 / x2) / (x4 - x2 * x2 / n - x3 * x3 / x2)
    slope = (y1 - bend * x3) / x2
    height = (y0 - bend * x2) / n
    return height - slope * mean + bend * mean * mean, slope - 2 * bend * mean, bend
