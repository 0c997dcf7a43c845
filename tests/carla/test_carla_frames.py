"""Conversions between LAVT's right-handed frames and CARLA's left-handed ones."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import CameraModel
from lavt.vehicle.carla.frames import (
    CarlaPose,
    FlatPose,
    actor_pose,
    camera_mount,
    curve_at,
    find_axles,
    forward_speed_mps,
    rear_axle_pose,
    road_wheel_rad,
    steer_for,
)

METRES = st.floats(-2000, 2000)
ANGLES = st.floats(-math.pi, math.pi)
POSES = st.builds(FlatPose, METRES, METRES, ANGLES)
SHIFTS = st.tuples(METRES, METRES)
AXLES = st.floats(-3, 3)


@given(POSES, AXLES, SHIFTS)
def test_a_pose_survives_both_conversions(pose: FlatPose, rear_axle_m: float, shift_m: tuple[float, float]) -> None:
    """The rear axle's pose of the actor of a pose is that pose."""
    back = rear_axle_pose(actor_pose(pose, rear_axle_m, shift_m), rear_axle_m, shift_m)
    assert back[:2] == pytest.approx(pose[:2], abs=1e-6)
    assert math.remainder(back.heading_rad - pose.heading_rad, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)


@given(POSES, POSES)
def test_distances_are_kept_and_sides_are_mirrored(one: FlatPose, other: FlatPose) -> None:
    """Two actors are as far apart as in LAVT, and the turn from one place to another has the opposite sign."""
    first, second = actor_pose(one, 0.0), actor_pose(other, 0.0)
    assert math.dist(first[:2], second[:2]) == pytest.approx(math.dist(one[:2], other[:2]), abs=1e-6)
    ours = one.x_m * other.y_m - one.y_m * other.x_m
    assert first.x_m * second.y_m - first.y_m * second.x_m == pytest.approx(-ours, abs=1e-6)


def test_left_is_left() -> None:
    """A place to the left of a car has the smaller y in CARLA, and a turn to the left has a negative yaw."""
    ahead, left = actor_pose(FlatPose(0.0, 0.0, 0.0), 0.0), actor_pose(FlatPose(0.0, 1.0, 0.1), 0.0)
    assert left.y_m < ahead.y_m
    assert left.yaw_deg == pytest.approx(-math.degrees(0.1))


def test_the_actor_is_ahead_of_its_rear_axle() -> None:
    """With the rear axle 1.4 m behind the origin, a car that heads along y has its origin 1.4 m further along y."""
    actor = actor_pose(FlatPose(10.0, 20.0, math.pi / 2), -1.4)
    assert actor[:2] == pytest.approx((10.0, -21.4))


@given(POSES, st.floats(1.5, 4), AXLES, st.floats(0.5, 2))
def test_axles_are_found_at_any_pose(pose: FlatPose, wheelbase_m: float, rear_axle_m: float, track_m: float) -> None:
    """The wheels' positions in cm give wheelbase and rear axle, wherever the car is."""
    actor = actor_pose(pose, rear_axle_m)
    yaw_rad = math.radians(actor.yaw_deg)
    wheels_cm = [
        (
            100 * (actor.x_m + ahead_m * math.cos(yaw_rad) - right_m * math.sin(yaw_rad)),
            100 * (actor.y_m + ahead_m * math.sin(yaw_rad) + right_m * math.cos(yaw_rad)),
        )
        for ahead_m in (rear_axle_m + wheelbase_m, rear_axle_m)
        for right_m in (-track_m / 2, track_m / 2)
    ]
    assert find_axles(actor, wheels_cm) == pytest.approx((rear_axle_m, wheelbase_m), abs=1e-6)


@given(st.floats(-30, 30), st.floats(-180, 180))
def test_only_the_forward_part_of_a_velocity_counts(speed_mps: float, yaw_deg: float) -> None:
    """A velocity along the car's axis is its speed; one across the axis is none."""
    ahead = (math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg)))
    along = (speed_mps * ahead[0], speed_mps * ahead[1], 3.0)
    across = (-speed_mps * ahead[1], speed_mps * ahead[0], 3.0)
    assert forward_speed_mps(along, yaw_deg) == pytest.approx(speed_mps, abs=1e-9)
    assert forward_speed_mps(across, yaw_deg) == pytest.approx(0.0, abs=1e-9)


def test_a_camera_keeps_its_place_and_its_view() -> None:
    """A camera to the left, turned left, tilted down and leaning right has these signs in CARLA."""
    model = CameraModel(x_m=1.6, y_m=0.2, z_m=1.4, yaw_rad=0.1, pitch_rad=0.2, roll_rad=0.3)
    degrees = math.degrees
    expected = CarlaPose(0.2, -0.2, 1.4, -degrees(0.2), -degrees(0.1), degrees(0.3))
    assert camera_mount(model, -1.4) == pytest.approx(expected)


@given(st.floats(-1.2, 1.2), st.floats(0.1, 1.2), st.floats(0.2, 1.0))
def test_steer_is_mirrored_and_limited(steering_rad: float, max_rad: float, factor: float) -> None:
    """The steer that the server multiplies by its factor gives the angle, or the largest angle of that sign."""
    steer = steer_for(steering_rad, max_rad, factor)
    assert -1.0 <= steer <= 1.0
    reached_rad = -steer * max_rad * factor
    assert reached_rad == pytest.approx(max(-max_rad * factor, min(max_rad * factor, steering_rad)))


@given(st.floats(-0.6, 0.6).filter(lambda angle: abs(angle) > 1e-3), st.floats(2, 4), st.floats(1, 2))
def test_two_wheels_are_one_bicycle_wheel(steering_rad: float, wheelbase_m: float, track_m: float) -> None:
    """Front wheels that roll on circles around one point give the angle of the wheel between them."""
    radius_m = wheelbase_m / math.tan(steering_rad)
    left_deg, right_deg = (-math.degrees(math.atan(wheelbase_m / (radius_m + side * track_m / 2))) for side in (-1, 1))
    assert road_wheel_rad(left_deg, right_deg) == pytest.approx(steering_rad, abs=1e-6)


def test_straight_wheels_have_the_angle_zero() -> None:
    """Straight wheels, and wheels with opposite angles, are no steering angle."""
    assert road_wheel_rad(0.0, 0.0) == 0.0
    assert road_wheel_rad(-2.0, 2.0) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("at", "value"), [(-5.0, 1.0), (0.0, 1.0), (30.0, 0.9), (60.0, 0.8), (200.0, 0.5)])
def test_a_curve_is_interpolated(at: float, value: float) -> None:
    """Between its points a curve is linear, beyond them constant."""
    assert curve_at([(0.0, 1.0), (60.0, 0.8), (120.0, 0.5)], at) == pytest.approx(value)


def test_a_curve_without_points_changes_nothing() -> None:
    """A server without a steering curve steers fully at every speed."""
    assert curve_at([], 50.0) == 1.0
