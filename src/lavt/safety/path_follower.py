"""Steering without commands: along the path that the last command meant to follow, by the vehicle's own odometry.

A command says where it means to go from the place where its picture was taken. When commands cease, the car knows by
odometry how far it has come along that path and how far beside it, and steers by pure pursuit of the path's points.
"""

from __future__ import annotations

import math
from itertools import pairwise

from lavt.control.pure_pursuit import Place, curvature_per_m, lookahead_m, moved, steering_rad
from lavt.domain import PATH_STEP_M, VehicleState
from lavt.safety.odometry import Odometry

LOOKAHEAD_S = 0.5
"""How far ahead on its path the car aims.

Aiming ahead is what makes up for the wheel's lag. Pure pursuit crosses over at 2.2 / lookahead with 65 degrees of phase
left (`experiment/boundary/delay_margin.py`); at half a second a steering lag of 0.12 s takes 28 of these, and
looking every 33 ms at most takes 4. 33 degrees stay: at 30 degrees a preset counts as designed, and less lookahead
would leave less.
"""


class PathFollower:
    """Keeps the odometry and the path of the last command, and says how to steer along it.

    `memory_ns`: for how long the place where a picture was taken is remembered.
    """

    def __init__(self, wheelbase_m: float, memory_ns: int) -> None:
        self._wheelbase_m = wheelbase_m
        self._odometry = Odometry(wheelbase_m, memory_ns)
        self._bends_per_m: tuple[float, ...] = ()
        """Curvature at the beginning of the path and at each of its points; empty: there is no path."""
        self._begin = self._odometry.at(0)

    def look(self, vehicle: VehicleState) -> None:
        """Look where the vehicle has got to; at any times, the more often the better."""
        self._odometry.note(vehicle)

    def take(self, angle_rad: float, path_curvature_per_m: tuple[float, ...], captured_ns: int) -> None:
        """Take over the path of a command from a picture taken at `captured_ns`; `angle_rad` is how it steers there."""
        self._bends_per_m = (curvature_per_m(angle_rad, self._wheelbase_m), *path_curvature_per_m)
        self._begin = self._odometry.at(captured_ns)

    def forget(self) -> None:
        """There is no path any more."""
        self._bends_per_m = ()

    def steering_rad(self, now_ns: int) -> float | None:
        """Give the road wheel angle that follows the path, or None where there is none.

        Beyond its last point the path goes on as it bends there.
        """
        if not self._bends_per_m:
            return None
        car = self._odometry.at(now_ns)
        distance_m = lookahead_m(LOOKAHEAD_S, car.speed_mps)
        along_m = car.travelled_m - self._begin.travelled_m + distance_m
        goal_x_m, goal_y_m, _ = point_of(self._begin.place, self._bends_per_m, along_m)
        x_m, y_m, heading_rad = car.place
        # A path that bends back on itself has its point nearer than the way there; the wheel has its limits anyway.
        away_m = max(math.hypot(goal_x_m - x_m, goal_y_m - y_m), distance_m / 2)
        aside_rad = math.atan2(goal_y_m - y_m, goal_x_m - x_m) - heading_rad
        return steering_rad(2 * math.sin(aside_rad) / away_m, self._wheelbase_m)


def point_of(begin: Place, bends_per_m: tuple[float, ...], along_m: float) -> Place:
    """Find the place `along_m` along a path from `begin`, whose curvatures are `PATH_STEP_M` apart from there on."""
    place = begin
    for before, after in pairwise(bends_per_m):
        if along_m <= PATH_STEP_M:
            return moved(place, along_m, (before + after) / 2)
        place = moved(place, PATH_STEP_M, (before + after) / 2)
        along_m -= PATH_STEP_M
    return moved(place, along_m, bends_per_m[-1])
