"""Pure pursuit steering, and the path that it would follow.

The car aims at the point of the lane's centre that is the lookahead distance away from the rear axle, and takes the
circle that leads there: curvature = 2 sin(angle to that point) / lookahead (R. C. Coulter, Implementation of the Pure
Pursuit Path Tracking Algorithm, CMU-RI-TR-92-01).
"""

from __future__ import annotations

import math

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.domain import PATH_POINTS, PATH_STEP_M, Lane

LOOKAHEAD_RANGE_M = (4.0, 20.0)
"""Nearer than 4 m the camera sees no road, and the wheel would twitch at low speed. Beyond 20 m the camera sees no
marks."""
TOLERANCE_M2 = 1e-6
"""Tolerance of the goal's squared distance: 0.1 micrometres at the shortest lookahead."""


PlanarPose = tuple[float, float, float]
"""Position of the rear axle (x and y, m) and heading (rad), in the frame of the lane."""

ORIGIN: PlanarPose = (0.0, 0.0, 0.0)
"""The pose at which the picture was taken."""


def move_along_arc(pose: PlanarPose, distance_m: float, curvature_per_m: float) -> PlanarPose:
    """Return the pose after `distance_m` along a circle."""
    x_m, y_m, heading_rad = pose
    turned_rad = distance_m * curvature_per_m
    # The chord of the arc: its length, and its direction half-way between the two headings.
    chord_m = distance_m if -1e-9 < turned_rad < 1e-9 else 2 * math.sin(turned_rad / 2) / curvature_per_m
    along_rad = heading_rad + turned_rad / 2
    return x_m + chord_m * math.cos(along_rad), y_m + chord_m * math.sin(along_rad), heading_rad + turned_rad


def lookahead_m(lookahead_s: float, speed_mps: float) -> float:
    """Return the lookahead distance: what the car drives in `lookahead_s`, clamped to `LOOKAHEAD_RANGE_M`."""
    nearest_m, farthest_m = LOOKAHEAD_RANGE_M
    return min(max(lookahead_s * speed_mps, nearest_m), farthest_m)


def goal_point_m(lane: Lane, distance_m: float, pose: PlanarPose = ORIGIN) -> tuple[float, float]:
    """Return the point of the lane's centre that is ahead of `pose` and `distance_m` away from it.

    If the lane's centre is farther away than `distance_m`, return the point of the centre beside `pose`.
    """
    c0, c1, c2 = lane.centre
    from_x_m, from_y_m, _ = pose
    distance_m2 = distance_m * distance_m
    aside_m = c0 + (c1 + c2 * from_x_m) * from_x_m - from_y_m
    if abs(aside_m) >= distance_m:
        return from_x_m, from_y_m + aside_m
    # Newton's method on the squared distance takes three or four steps. It starts at the goal of a straight lane.
    # The point at `low_m` is known to be too near, the point at `high_m` too far.
    low_m, high_m = from_x_m, from_x_m + distance_m
    x_m = from_x_m + math.sqrt(distance_m2 - aside_m * aside_m)
    for _ in range(50):
        y_m = c0 + (c1 + c2 * x_m) * x_m
        ahead_m, left_m = x_m - from_x_m, y_m - from_y_m
        excess_m2 = ahead_m * ahead_m + left_m * left_m - distance_m2
        if -TOLERANCE_M2 < excess_m2 < TOLERANCE_M2:
            break
        if excess_m2 < 0:
            low_m = x_m
        else:
            high_m = x_m
        slope_m = 2 * (ahead_m + left_m * (c1 + 2 * c2 * x_m))
        x_m = x_m - excess_m2 / slope_m if slope_m > 0 else low_m
        if not low_m < x_m < high_m:
            x_m = (low_m + high_m) / 2
    return x_m, y_m


def pursuit_curvature_per_m(lane: Lane, distance_m: float, pose: PlanarPose = ORIGIN) -> float:
    """Return the curvature, left positive, of the circle from `pose` to the goal on the lane's centre."""
    from_x_m, from_y_m, heading_rad = pose
    x_m, y_m = goal_point_m(lane, distance_m, pose)
    return 2 * math.sin(math.atan2(y_m - from_y_m, x_m - from_x_m) - heading_rad) / distance_m


def pursuit_path_per_m(
    lane: Lane, distance_m: float, limit_per_m: float, pose: PlanarPose = ORIGIN
) -> tuple[float, ...]:
    """Return the curvatures, within +-`limit_per_m`, of the path from `pose` onto the lane's centre and along it.

    This is the path that pure pursuit would drive: `PATH_POINTS` values, `PATH_STEP_M` apart, the first one step ahead.
    A car that followed the curvature of the lane itself would keep its offset from the lane and its heading error.
    """
    curvatures = []
    next_per_m = clamp(pursuit_curvature_per_m(lane, distance_m, pose), limit_per_m)
    for _ in range(PATH_POINTS):
        pose = move_along_arc(pose, PATH_STEP_M, next_per_m)
        next_per_m = pursuit_curvature_per_m(lane, distance_m, pose)
        if not -limit_per_m <= next_per_m <= limit_per_m:
            next_per_m = clamp(next_per_m, limit_per_m)
        curvatures.append(next_per_m)
    return tuple(curvatures)


class RememberedLane:
    """The last lane detected with confidence, and the car's pose in the frame of this lane."""

    def __init__(self, lane_confidence: float = LANE_CONFIDENCE) -> None:
        self._lane_confidence = lane_confidence
        self.lane = Lane((0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0)
        self.pose = ORIGIN

    def update(self, lane: Lane, driven_m: float, curvature_per_m: float) -> bool:
        """Return whether `lane` is confident, and remember it if so.

        Otherwise move the pose by dead reckoning: the car has driven `driven_m` with the commanded curvature.
        """
        is_confident = lane.confidence >= self._lane_confidence
        if is_confident:
            self.lane, self.pose = lane, ORIGIN
        else:
            self.pose = move_along_arc(self.pose, driven_m, curvature_per_m)
        return is_confident


def clamp(value: float, limit: float) -> float:
    """Return `value` clamped to +-`limit`."""
    return min(max(value, -limit), limit)


def steering_rad(curvature_per_m: float, wheelbase_m: float) -> float:
    """Return the road wheel angle of the kinematic bicycle for a curvature of its rear axle's path."""
    return math.atan(wheelbase_m * curvature_per_m)


def curvature_per_m(angle_rad: float, wheelbase_m: float) -> float:
    """Return the curvature of the rear axle's path for a road wheel angle, the inverse of `steering_rad`."""
    return math.tan(angle_rad) / wheelbase_m
