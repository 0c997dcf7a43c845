from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.safety.rig import START_NS, WHEELBASE_M, vehicle_at

from lavt.control.pure_pursuit import Place, curvature_per_m, moved, steering_rad
from lavt.domain import NS_PER_MS, NS_PER_S, PATH_POINTS, VehicleState
from lavt.safety.path_follower import PathFollower, point_of

STEP_S = 1 / 240
LAG_S = 0.12
"""Of the simulator's car."""
BEND = (0.03,) * PATH_POINTS
BEND_RAD = steering_rad(0.03, WHEELBASE_M)
S_BEND = (0.0, 0.01, 0.02, 0.03, 0.03, 0.02, 0.0, -0.02, -0.03, -0.03)


def new() -> PathFollower:
    return PathFollower(WHEELBASE_M, 5 * NS_PER_S)


def seen(passed_ns: int, speed_mps: float, angle_rad: float = 0.0) -> VehicleState:
    return replace(vehicle_at(speed_mps, angle_rad), mono_ns=START_NS + passed_ns)


class Stopping(NamedTuple):
    """Where a car went that brakes from 30 km/h with 4 m/s2."""

    covered_m: float
    place: Place
    angle_rad: float


def stop(path: tuple[float, ...], *, every: int, picture_age_s: float = 0.0, angle_rad: float = 0.0) -> Stopping:
    """Brake along a path with a wheel that lags, in steps of 1/240 s, looking at every so many of them.

    The picture was taken where the car was `picture_age_s` before it brakes; until then it has the first curvature.
    """
    follower, place, covered_m, wanted_rad = new(), (0.0, 0.0, 0.0), 0.0, angle_rad
    for step in range(10_000):
        passed_s = step * STEP_S
        speed_mps = 30 / 3.6 - 4 * max(0.0, passed_s - picture_age_s)
        if speed_mps <= 0:
            break
        if step % every == 0:
            follower.look(seen(round(passed_s * NS_PER_S), speed_mps, angle_rad))
            if passed_s >= picture_age_s:
                if follower.steering_rad(START_NS) is None:
                    follower.take(steering_rad(path[0], WHEELBASE_M), path, START_NS)
                wanted_rad = follower.steering_rad(START_NS + round(passed_s * NS_PER_S)) or 0.0
        angle_rad += (wanted_rad - angle_rad) * (1 - math.exp(-STEP_S / LAG_S))
        place = moved(place, speed_mps * STEP_S, curvature_per_m(angle_rad, WHEELBASE_M))
        covered_m += speed_mps * STEP_S
    return Stopping(covered_m, place, angle_rad)


def aside_m(path: tuple[float, ...], done: Stopping) -> float:
    """How far beside its path the car has come to stand."""
    on_x_m, on_y_m, heading_rad = point_of((0.0, 0.0, 0.0), (path[0], *path), done.covered_m)
    x_m, y_m, _ = done.place
    return (y_m - on_y_m) * math.cos(heading_rad) - (x_m - on_x_m) * math.sin(heading_rad)


def test_without_a_path_it_says_nothing() -> None:
    """Before the first path, and after it was told to forget it, there is nothing to follow."""
    follower = new()
    follower.look(seen(0, 8.0))
    assert follower.steering_rad(START_NS) is None
    follower.take(0.0, BEND, START_NS)
    assert follower.steering_rad(START_NS) is not None
    follower.forget()
    assert follower.steering_rad(START_NS) is None


def test_on_a_circle_the_wheel_is_that_of_the_circle() -> None:
    """On a path of one curvature the angle is the kinematic car's for it, also past its last point."""
    follower = new()
    follower.look(seen(0, 8.0, BEND_RAD))
    follower.take(BEND_RAD, BEND, START_NS)
    for passed_ns in (0, NS_PER_S, 4 * NS_PER_S):  # 0, 8 and 32 m
        follower.look(seen(passed_ns, 8.0, BEND_RAD))
        assert follower.steering_rad(START_NS + passed_ns) == pytest.approx(BEND_RAD, abs=1e-6)


@pytest.mark.parametrize("every", [1, 8])
@pytest.mark.parametrize("path", [BEND, S_BEND])
def test_a_car_whose_wheel_lags_stops_on_the_path(path: tuple[float, ...], every: int) -> None:
    """From 30 km/h and a straight wheel it stops within 0.15 m of the path, looked at 240 or 30 times a second."""
    done = stop(path, every=every)
    assert done.covered_m > 8
    assert abs(aside_m(path, done)) < 0.15


def test_the_path_begins_where_the_picture_was_taken() -> None:
    """A path from a picture of half a second ago is followed from there, not from where its command came."""
    done = stop(S_BEND, every=1, picture_age_s=0.5)
    assert done.covered_m > 12
    assert abs(aside_m(S_BEND, done)) < 0.15


def test_a_car_beside_its_path_goes_back_to_it() -> None:
    """A car that went straight on for 0.6 s where the path bends steers more than the path does, to the same side."""
    follower = new()
    for passed_ns in range(0, 600 * NS_PER_MS + 1, 20 * NS_PER_MS):
        follower.look(seen(passed_ns, 8.0))
    follower.take(BEND_RAD, BEND, START_NS)
    said_rad = follower.steering_rad(START_NS + 600 * NS_PER_MS)
    assert said_rad is not None
    assert said_rad > 1.5 * BEND_RAD


CURVATURES = st.floats(-1, 1)


@given(
    st.tuples(*[CURVATURES] * PATH_POINTS),
    st.floats(-1, 1),
    st.lists(st.tuples(st.floats(-20, 60), st.floats(-1, 1)), min_size=1, max_size=20),
)
def test_any_path_gives_an_angle(path: tuple[float, ...], angle_rad: float, reports: list[tuple[float, float]]) -> None:
    """Whatever path was in range on the wire, and wherever the car goes, the angle is a number below a right angle."""
    follower = new()
    for number, report in enumerate(reports):
        follower.look(seen(number * 100 * NS_PER_MS, *report))
        follower.take(angle_rad, path, START_NS)
        said_rad = follower.steering_rad(START_NS + number * 100 * NS_PER_MS)
        assert said_rad is not None
        assert abs(said_rad) < math.pi / 2
