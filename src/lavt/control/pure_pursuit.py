"""Steering by pure pursuit, and the path that follows from it.

The car aims at the point of the lane's centre that is a lookahead away from its rear axle, and takes the circle that
leads there: curvature = 2 sin(angle to that point) / lookahead (R. C. Coulter, Implementation of the Pure Pursuit Path
Tracking Algorithm, CMU-RI-TR-92-01).
"""

from __future__ import annotations

import math

from lavt.domain import PATH_POINTS, PATH_STEP_M, Lane

LOOKAHEAD_WITHIN_M = (4.0, 20.0)
"""Nearer than 4 m the camera sees no road, and the wheel would twitch at low speed; beyond 20 m it sees no marks."""
CLOSE_M2 = 1e-6
"""So far the goal's squared distance may be off the lookahead's: 0.1 micrometres at the nearest."""


Place = tuple[float, float, float]
"""Where the rear axle is (x and y, m) and where the car points to (rad), in the frame the lane is given in."""

SEEN_FROM: Place = (0.0, 0.0, 0.0)
"""Where the picture was taken."""


def moved(place: Place, distance_m: float, curvature_per_m: float) -> Place:
    """Go `distance_m` along a circle."""
    x_m, y_m, heading_rad = place
    turned_rad = distance_m * curvature_per_m
    # The chord of the arc: its length, and its direction half-way between the two headings.
    chord_m = distance_m if -1e-9 < turned_rad < 1e-9 else 2 * math.sin(turned_rad / 2) / curvature_per_m
    along_rad = heading_rad + turned_rad / 2
    return x_m + chord_m * math.cos(along_rad), y_m + chord_m * math.sin(along_rad), heading_rad + turned_rad


def lookahead_m(lookahead_s: float, speed_mps: float) -> float:
    """Give the distance to aim at: `lookahead_s` of driving, within `LOOKAHEAD_WITHIN_M`."""
    nearest_m, farthest_m = LOOKAHEAD_WITHIN_M
    return min(max(lookahead_s * speed_mps, nearest_m), farthest_m)


def goal_m(lane: Lane, distance_m: float, place: Place = SEEN_FROM) -> tuple[float, float]:
    """Find the point of the lane's centre, ahead of `place`, that is `distance_m` away from it.

    From a place farther off the lane than that, it is the point abreast.
    """
    c0, c1, c2 = lane.centre
    from_x_m, from_y_m, _ = place
    farthest_m2 = distance_m * distance_m
    aside_m = c0 + (c1 + c2 * from_x_m) * from_x_m - from_y_m
    if abs(aside_m) >= distance_m:
        return from_x_m, from_y_m + aside_m
    # Newton's method on the squared distance, three or four steps; it starts where a straight lane would have the goal
    # and is kept between what is known to be too near and too far.
    low_m, high_m = from_x_m, from_x_m + distance_m
    x_m = from_x_m + math.sqrt(farthest_m2 - aside_m * aside_m)
    for _ in range(50):
        y_m = c0 + (c1 + c2 * x_m) * x_m
        ahead_m, left_m = x_m - from_x_m, y_m - from_y_m
        off_m2 = ahead_m * ahead_m + left_m * left_m - farthest_m2
        if -CLOSE_M2 < off_m2 < CLOSE_M2:
            break
        if off_m2 < 0:
            low_m = x_m
        else:
            high_m = x_m
        slope_m = 2 * (ahead_m + left_m * (c1 + 2 * c2 * x_m))
        x_m = x_m - off_m2 / slope_m if slope_m > 0 else low_m
        if not low_m < x_m < high_m:
            x_m = (low_m + high_m) / 2
    return x_m, y_m


def pursuit_curvature_per_m(lane: Lane, distance_m: float, place: Place = SEEN_FROM) -> float:
    """Give the curvature, left positive, of the circle from `place` to the goal on the lane's centre."""
    from_x_m, from_y_m, heading_rad = place
    x_m, y_m = goal_m(lane, distance_m, place)
    return 2 * math.sin(math.atan2(y_m - from_y_m, x_m - from_x_m) - heading_rad) / distance_m


def pursued_path(lane: Lane, distance_m: float, limit_per_m: float, place: Place = SEEN_FROM) -> tuple[float, ...]:
    """Give the curvatures, within +-`limit_per_m`, of the path from `place` onto the lane's centre and along it.

    It is where pure pursuit would go: `PATH_POINTS` values, `PATH_STEP_M` apart, the first one step ahead. The lane's
    own curvature would not do: a car that is beside its lane, or turned, would stay so along a path of that curvature.
    """
    curvatures = []
    bend_per_m = limited(pursuit_curvature_per_m(lane, distance_m, place), limit_per_m)
    for _ in range(PATH_POINTS):
        place = moved(place, PATH_STEP_M, bend_per_m)
        bend_per_m = pursuit_curvature_per_m(lane, distance_m, place)
        if not -limit_per_m <= bend_per_m <= limit_per_m:
            bend_per_m = limited(bend_per_m, limit_per_m)
        curvatures.append(bend_per_m)
    return tuple(curvatures)


def limited(value: float, limit: float) -> float:
    """Keep `value` within +-`limit`."""
    return min(max(value, -limit), limit)


def steering_rad(curvature_per_m: float, wheelbase_m: float) -> float:
    """Give the road wheel angle of the kinematic bicycle for a curvature of its rear axle's path."""
    return math.atan(wheelbase_m * curvature_per_m)


def curvature_per_m(angle_rad: float, wheelbase_m: float) -> float:
    """Give the curvature of the rear axle's path for a road wheel angle, the inverse of `steering_rad`."""
    return math.tan(angle_rad) / wheelbase_m
