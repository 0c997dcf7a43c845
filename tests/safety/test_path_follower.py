from __future__ import annotations

import math
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from tests.safety.rig import START_NS, WHEELBASE_M, vehicle_at

from lavt.control.pure_pursuit import PlanarPose, curvature_per_m, move_along_arc, steering_rad
from lavt.domain import NS_PER_MS, NS_PER_S, PATH_POINTS, VehicleState
from lavt.safety.path_follower import PathFollower, pose_along_path

STEP_S = 1 / 240
LAG_S = 0.12
"""Steering lag of the simulator's car."""
BEND = (0.03,) * PATH_POINTS
BEND_RAD = steering_rad(0.03, WHEELBASE_M)
S_BEND = (0.0, 0.01, 0.02, 0.03, 0.03, 0.02, 0.0, -0.02, -0.03, -0.03)


def new_follower() -> PathFollower:
    return PathFollower(WHEELBASE_M, 5 * NS_PER_S)


def report_at(passed_ns: int, speed_mps: float, angle_rad: float = 0.0) -> VehicleState:
    return replace(vehicle_at(speed_mps, angle_rad), mono_ns=START_NS + passed_ns)


class StoppedCar(NamedTuple):
    """The distance, pose and wheel angle of a car that braked from 30 km/h with 4 m/s2."""

    covered_m: float
    pose: PlanarPose
    angle_rad: float


def brake_on_path(path: tuple[float, ...], *, steps_per_report: int, picture_age_s: float = 0.0) -> StoppedCar:
    """Brake along a path with steering lag, in steps of 1/240 s; the follower gets a report every `steps_per_report`.

    The picture was taken `picture_age_s` before braking begins. Until then the car drives straight on.
    """
    follower, pose, covered_m, angle_rad, target_rad = new_follower(), (0.0, 0.0, 0.0), 0.0, 0.0, 0.0
    for step in range(10_000):
        passed_s = step * STEP_S
        speed_mps = 30 / 3.6 - 4 * max(0.0, passed_s - picture_age_s)
        if speed_mps <= 0:
            break
        if step % steps_per_report == 0:
            follower.update_odometry(report_at(round(passed_s * NS_PER_S), speed_mps, angle_rad))
            if passed_s >= picture_age_s:
                if follower.steering_rad(START_NS) is None:
                    follower.set_path(steering_rad(path[0], WHEELBASE_M), path, START_NS)
                target_rad = follower.steering_rad(START_NS + round(passed_s * NS_PER_S)) or 0.0
        angle_rad += (target_rad - angle_rad) * (1 - math.exp(-STEP_S / LAG_S))
        pose = move_along_arc(pose, speed_mps * STEP_S, curvature_per_m(angle_rad, WHEELBASE_M))
        covered_m += speed_mps * STEP_S
    return StoppedCar(covered_m, pose, angle_rad)


def lateral_offset_m(path: tuple[float, ...], stopped_car: StoppedCar) -> float:
    """Return the lateral distance from the path to the stopped car."""
    path_x_m, path_y_m, heading_rad = pose_along_path((0.0, 0.0, 0.0), (path[0], *path), stopped_car.covered_m)
    x_m, y_m, _ = stopped_car.pose
    return (y_m - path_y_m) * math.cos(heading_rad) - (x_m - path_x_m) * math.sin(heading_rad)


def test_without_a_path_there_is_no_angle() -> None:
    """Before the first path and after clearing it, no steering angle is returned."""
    follower = new_follower()
    follower.update_odometry(report_at(0, 8.0))
    assert follower.steering_rad(START_NS) is None
    follower.set_path(0.0, BEND, START_NS)
    assert follower.steering_rad(START_NS) is not None
    follower.clear_path()
    assert follower.steering_rad(START_NS) is None


def test_a_circular_path() -> None:
    """On a path of constant curvature the steering angle is the kinematic car's, also beyond the path's last point."""
    follower = new_follower()
    follower.update_odometry(report_at(0, 8.0, BEND_RAD))
    follower.set_path(BEND_RAD, BEND, START_NS)
    for passed_ns in (0, NS_PER_S, 4 * NS_PER_S):  # 0, 8 and 32 m
        follower.update_odometry(report_at(passed_ns, 8.0, BEND_RAD))
        assert follower.steering_rad(START_NS + passed_ns) == pytest.approx(BEND_RAD, abs=1e-6)


@pytest.mark.parametrize("steps_per_report", [1, 8])
@pytest.mark.parametrize("path", [BEND, S_BEND])
def test_a_car_with_steering_lag_stops_on_the_path(path: tuple[float, ...], steps_per_report: int) -> None:
    """A car with steering lag stops from 30 km/h within 0.15 m of its path, with reports at 240 or 30 Hz."""
    stopped_car = brake_on_path(path, steps_per_report=steps_per_report)
    assert stopped_car.covered_m > 8
    assert abs(lateral_offset_m(path, stopped_car)) < 0.15


def test_the_path_begins_where_the_picture_was_taken() -> None:
    """A path from a picture that is 0.5 s old begins where that picture was taken."""
    stopped_car = brake_on_path(S_BEND, steps_per_report=1, picture_age_s=0.5)
    assert stopped_car.covered_m > 12
    assert abs(lateral_offset_m(S_BEND, stopped_car)) < 0.15


def test_a_car_off_its_path_returns_to_it() -> None:
    """A car that drove straight on in a bend for 0.6 s steers to the same side as the bend, and 1.5 times as much."""
    follower = new_follower()
    for passed_ns in range(0, 600 * NS_PER_MS + 1, 20 * NS_PER_MS):
        follower.update_odometry(report_at(passed_ns, 8.0))
    follower.set_path(BEND_RAD, BEND, START_NS)
    followed_rad = follower.steering_rad(START_NS + 600 * NS_PER_MS)
    assert followed_rad is not None
    assert followed_rad > 1.5 * BEND_RAD


CURVATURES = st.floats(-1, 1)


@given(
    st.tuples(*[CURVATURES] * PATH_POINTS),
    st.floats(-1, 1),
    st.lists(st.tuples(st.floats(-20, 60), st.floats(-1, 1)), min_size=1, max_size=20),
)
def test_the_angle_is_always_valid(
    path: tuple[float, ...], angle_rad: float, reports: list[tuple[float, float]]
) -> None:
    """For any path that can be received and any motion, the steering angle is finite and smaller than 90 degrees."""
    follower = new_follower()
    for number, report in enumerate(reports):
        follower.update_odometry(report_at(number * 100 * NS_PER_MS, *report))
        follower.set_path(angle_rad, path, START_NS)
        followed_rad = follower.steering_rad(START_NS + number * 100 * NS_PER_MS)
        assert followed_rad is not None
        assert abs(followed_rad) < math.pi / 2
