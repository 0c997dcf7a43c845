import math

import pytest

from lavt.control.pure_pursuit import (
    ORIGIN,
    curvature_per_m,
    goal_point_m,
    lookahead_m,
    move_along_arc,
    pursuit_curvature_per_m,
    pursuit_path_per_m,
    steering_rad,
)
from lavt.domain import PATH_POINTS, PATH_STEP_M, Lane

WHEELBASE_M = 2.8448


def lane(c0: float = 0.0, c1: float = 0.0, c2: float = 0.0) -> Lane:
    return Lane(centre=(c0, c1, c2), width_m=3.5, near_m=3.6, far_m=20.0, confidence=1.0)


@pytest.mark.parametrize(("speed_mps", "expected_m"), [(0.0, 4.0), (2.0, 4.0), (8.0, 8.0), (30.0, 20.0)])
def test_the_lookahead_grows_with_speed(speed_mps: float, expected_m: float) -> None:
    """The lookahead distance is proportional to the speed, but between 4 and 20 m."""
    assert lookahead_m(1.0, speed_mps) == expected_m


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (1.5, -0.2, 0.012), (-3.0, 0.5, -0.02)])
def test_the_goal_is_on_the_centre_at_the_lookahead_distance(centre: tuple[float, float, float]) -> None:
    """The goal is on the lane's centre, ahead, at the lookahead distance."""
    x_m, y_m = goal_point_m(lane(*centre), 6.2)
    assert math.hypot(x_m, y_m) == pytest.approx(6.2, abs=1e-3)
    assert y_m == pytest.approx(centre[0] + centre[1] * x_m + centre[2] * x_m**2)
    assert x_m > 0


def test_on_the_centre_the_wheel_is_straight() -> None:
    """On the centre of a straight lane, the wheel is straight."""
    assert pursuit_curvature_per_m(lane(), 8.0) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("offset_m", [-2.0, -0.5, 0.5, 2.0])
def test_steering_is_towards_the_lane(offset_m: float) -> None:
    """For a lateral offset the curvature is 2 offset / lookahead^2, towards the lane."""
    assert pursuit_curvature_per_m(lane(offset_m), 8.0) == pytest.approx(2 * offset_m / 64, rel=1e-3)


def test_a_heading_error_is_steered_back() -> None:
    """A car turned to the left of its lane steers to the right."""
    assert pursuit_curvature_per_m(lane(c1=-0.1), 8.0) == pytest.approx(-2 * math.sin(math.atan(0.1)) / 8.0, rel=1e-3)


def test_a_lane_beyond_the_lookahead_is_approached_at_the_largest_curvature() -> None:
    """A lane farther away than the lookahead is approached at the largest curvature."""
    assert pursuit_curvature_per_m(lane(9.0), 4.0) == pytest.approx(0.5, rel=1e-3)
    assert pursuit_curvature_per_m(lane(-9.0), 4.0) == pytest.approx(-0.5, rel=1e-3)


def test_the_circle_leads_to_the_goal() -> None:
    """A car that drives along the arc of the pursuit curvature reaches the goal point."""
    curved_lane = lane(0.5, 0.1, 0.01)
    curvature = pursuit_curvature_per_m(curved_lane, 8.0)
    half_angle_rad = math.asin(curvature * 8.0 / 2)
    x_m, y_m, _ = move_along_arc(ORIGIN, 2 * half_angle_rad / curvature, curvature)
    assert (x_m, y_m) == pytest.approx(goal_point_m(curved_lane, 8.0), abs=1e-3)


def test_steering_and_curvature_are_inverse() -> None:
    """Steering angle and curvature are inverse; a radius of 42 m needs 3.9 degrees."""
    assert steering_rad(1 / 42, WHEELBASE_M) == pytest.approx(math.radians(3.875), rel=1e-3)
    assert curvature_per_m(steering_rad(-0.03, WHEELBASE_M), WHEELBASE_M) == pytest.approx(-0.03)


def test_the_path_on_a_curve_has_its_curvature() -> None:
    """On the centre of a gentle curve, the path has the lane's curvature."""
    radius_m = 135
    path = pursuit_path_per_m(lane(c2=0.5 / radius_m), 6.0, limit_per_m=1.0)
    assert len(path) == PATH_POINTS
    assert path[:5] == pytest.approx([1 / radius_m] * 5, rel=0.1)


def test_the_path_leads_back_to_the_lane() -> None:
    """The path of a car that is 1 m off its lane and turned away ends less than 0.3 m from the lane's centre."""
    offset_lane = lane(c0=-1.0, c1=-0.1)
    position, curvature = ORIGIN, pursuit_curvature_per_m(offset_lane, 6.0)
    for next_curvature in pursuit_path_per_m(offset_lane, 6.0, limit_per_m=1.0):
        position = move_along_arc(position, PATH_STEP_M, curvature)
        curvature = next_curvature
    x_m, y_m, heading_rad = position
    assert y_m == pytest.approx(-1.0 - 0.1 * x_m, abs=0.3)
    assert heading_rad == pytest.approx(math.atan(-0.1), abs=0.05)


def test_the_path_keeps_to_the_limit() -> None:
    """No curvature of the path exceeds the limit."""
    path = pursuit_path_per_m(lane(3.0), 4.0, limit_per_m=0.04)
    assert max(abs(curvature) for curvature in path) == 0.04


def test_move_along_arc() -> None:
    """A quarter of a circle with a radius of 10 m ends 10 m ahead and 10 m to the left, turned by 90 degrees."""
    assert move_along_arc(ORIGIN, math.pi / 2 * 10, 0.1) == pytest.approx((10.0, 10.0, math.pi / 2))
