"""Steering without commands: along the planned path of the last command, by the vehicle's own odometry.

Each command contains the planned path, which begins where the command's picture was taken. When commands stop, odometry
measures the car's position relative to this path, and pure pursuit steers the car along the path.
"""

from __future__ import annotations

import math
from itertools import pairwise

from lavt.control.pure_pursuit import PlanarPose, curvature_per_m, lookahead_m, move_along_arc, steering_rad
from lavt.domain import PATH_STEP_M, VehicleState
from lavt.safety.odometry import Odometry

LOOKAHEAD_S = 0.5
"""Lookahead on the path, in seconds of driving.

The lookahead makes up for the lag of the wheels. The gain crossover of pure pursuit is at 2.2 / lookahead, with a phase
margin of 65 degrees (`experiment/boundary/delay_margin.py`). With 0.5 s, a steering lag of 0.12 s reduces the margin by
28 degrees, and a sampling period of at most 33 ms by 4 degrees. This leaves 33 degrees. The preset `designed` has 30
degrees; a shorter lookahead would leave a smaller margin.
"""


class PathFollower:
    """A path follower that keeps odometry and the path of the last command, and steers along that path.

    `memory_ns` is how long odometry remembers the pose at which a picture was taken.
    """

    def __init__(self, wheelbase_m: float, memory_ns: int) -> None:
        self._wheelbase_m = wheelbase_m
        self._odometry = Odometry(wheelbase_m, memory_ns)
        self._curvatures_per_m: tuple[float, ...] = ()
        """Curvature at the start of the path and at each of its points; empty if there is no path."""
        self._start = self._odometry.at(0)

    def update_odometry(self, vehicle: VehicleState) -> None:
        """Add a report of the vehicle to the odometry; more frequent reports make it more accurate."""
        self._odometry.update(vehicle)

    def set_path(self, angle_rad: float, path_curvature_per_m: tuple[float, ...], captured_ns: int) -> None:
        """Store the path of a command with steering angle `angle_rad`, made from a picture taken at `captured_ns`."""
        self._curvatures_per_m = (curvature_per_m(angle_rad, self._wheelbase_m), *path_curvature_per_m)
        self._start = self._odometry.at(captured_ns)

    def clear_path(self) -> None:
        """Drop the path."""
        self._curvatures_per_m = ()

    def steering_rad(self, now_ns: int) -> float | None:
        """Return the road wheel angle that follows the path; None if there is no path.

        Beyond its last point, the path continues with the curvature of this point.
        """
        if not self._curvatures_per_m:
            return None
        car = self._odometry.at(now_ns)
        distance_m = lookahead_m(LOOKAHEAD_S, car.speed_mps)
        along_m = car.travelled_m - self._start.travelled_m + distance_m
        goal_x_m, goal_y_m, _ = pose_along_path(self._start.pose, self._curvatures_per_m, along_m)
        x_m, y_m, heading_rad = car.pose
        # On a path that bends back the goal can be very near; the limiter limits the angle anyway.
        goal_distance_m = max(math.hypot(goal_x_m - x_m, goal_y_m - y_m), distance_m / 2)
        bearing_rad = math.atan2(goal_y_m - y_m, goal_x_m - x_m) - heading_rad
        return steering_rad(2 * math.sin(bearing_rad) / goal_distance_m, self._wheelbase_m)


def pose_along_path(start: PlanarPose, curvatures_per_m: tuple[float, ...], along_m: float) -> PlanarPose:
    """Return the pose after `along_m` on a path from `start`, given its curvatures at points `PATH_STEP_M` apart."""
    pose = start
    for curvature_before_per_m, curvature_after_per_m in pairwise(curvatures_per_m):
        mean_per_m = (curvature_before_per_m + curvature_after_per_m) / 2
        if along_m <= PATH_STEP_M:
            return move_along_arc(pose, along_m, mean_per_m)
        pose = move_along_arc(pose, PATH_STEP_M, mean_per_m)
        along_m -= PATH_STEP_M
    return move_along_arc(pose, along_m, curvatures_per_m[-1])
