"""Steering by pure pursuit, and the path that follows from it.

The car aims at the point of the lane's centre that is a lookahead away from its rear axle, and takes the circle that
leads there: curvature = 2 sin(angle to that point) / lookahead (R. C. Coulter, Implementation of the Pure Pursuit Path
Tracking Algorithm, CMU-RI-TR-92-01).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from lavt.domain import PATH_POINTS, PATH_STEP_M, Lane

LOOKAHEAD_WITHIN_M = (4.0, 20.0)
"""Nearer than 4 m the camera sees no road, and the wheel would twitch at low speed; beyond 20 m it sees no marks."""
CLOSE_M = 1e-7
"""So far the goal may be off the lookahead."""


class Place(NamedTuple):
    """Where the rear axle is and where the car points to, in the frame the lane is given in."""

    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0

    def moved(self, distance_m: float, curvature_per_m: float) -> Place:
        """Go `distance_m` along a circle."""
        turned_rad = distance_m * curvature_per_m
        # The chord of the arc: its length, and its direction half-way between the two headings.
        chord_m = distance_m if abs(turned_rad) < 1e-9 else 2 * math.sin(turned_rad / 2) / curvature_per_m
        direction_rad = self.heading_rad + turned_rad / 2
        return Place(
            self.x_m + chord_m * math.cos(direction_rad),
            self.y_m + chord_m * math.sin(direction_rad),
            self.heading_rad + turned_rad,
        )


SEEN_FROM = Place()
"""Where the picture was taken."""


def lookahead_m(lookahead_s: float, speed_mps: float) -> float:
    """Give the distance to aim at: `lookahead_s` of driving, within `LOOKAHEAD_WITHIN_M`."""
    nearest_m, farthest_m = LOOKAHEAD_WITHIN_M
    return min(max(lookahead_s * speed_mps, nearest_m), farthest_m)


def goal_m(lane: Lane, distance_m: float, place: Place = SEEN_FROM) -> tuple[float, float]:
    """Find the point of the lane's centre, ahead of `place`, that is `distance_m` away from it.

    From a place farther off the lane than that, it is the point abreast.
    """
    c0, c1, c2 = lane.centre
    from_x_m, from_y_m = place.x_m, place.y_m
    # At `low_m` the centre is nearer than the lookahead and at `high_m` not nearer: the crossing lies between. It is
    # found by false position, halving the value at an end that stays (the Illinois rule): 5 steps, not 24.
    low_m, high_m = from_x_m, from_x_m + distance_m
    below = abs(c0 + (c1 + c2 * low_m) * low_m - from_y_m) - distance_m
    above = math.hypot(distance_m, c0 + (c1 + c2 * high_m) * high_m - from_y_m) - distance_m
    if below >= 0:
        return low_m, c0 + (c1 + c2 * low_m) * low_m
    moved = 0
    for _ in range(50):
        x_m = (low_m * above - high_m * below) / (above - below)
        y_m = c0 + (c1 + c2 * x_m) * x_m
        off = math.hypot(x_m - from_x_m, y_m - from_y_m) - distance_m
        if abs(off) < CLOSE_M:
            break
        if off < 0:
            low_m, below, above, moved = x_m, off, above / 2 if moved < 0 else above, -1
        else:
            high_m, above, below, moved = x_m, off, below / 2 if moved > 0 else below, 1
    return x_m, y_m


def pursuit_curvature_per_m(lane: Lane, distance_m: float, place: Place = SEEN_FROM) -> float:
    """Give the curvature, left positive, of the circle from `place` to the goal on the lane's centre."""
    x_m, y_m = goal_m(lane, distance_m, place)
    angle_rad = math.atan2(y_m - place.y_m, x_m - place.x_m) - place.heading_rad
    return 2 * math.sin(angle_rad) / distance_m


def pursued_path(lane: Lane, distance_m: float, limit_per_m: float, place: Place = SEEN_FROM) -> tuple[float, ...]:
    """Give the curvatures, within +-`limit_per_m`, of the path from `place` onto the lane's centre and along it.

    It is where pure pursuit would go: `PATH_POINTS` values, `PATH_STEP_M` apart, the first one step ahead. The lane's
    own curvature would not do: a car that is beside its lane, or turned, would stay so along a path of that curvature.
    """
    curvatures = [limited(pursuit_curvature_per_m(lane, distance_m, place), limit_per_m)]
    for _ in range(PATH_POINTS):
        place = place.moved(PATH_STEP_M, curvatures[-1])
        curvatures.append(limited(pursuit_curvature_per_m(lane, distance_m, place), limit_per_m))
    return tuple(curvatures[1:])


def limited(value: float, limit: float) -> float:
    """Keep `value` within +-`limit`."""
    return min(max(value, -limit), limit)


def steering_rad(curvature_per_m: float, wheelbase_m: float) -> float:
    """Give the road wheel angle of the kinematic bicycle for a curvature of its rear axle's path."""
    return math.atan(wheelbase_m * curvature_per_m)


def curvature_per_m(angle_rad: float, wheelbase_m: float) -> float:
    """Give the curvature of the rear axle's path for a road wheel angle, the inverse of `steering_rad`."""
    return math.tan(angle_rad) / wheelbase_m
