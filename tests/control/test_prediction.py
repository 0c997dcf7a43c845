"""The prediction of the car's pose: closed forms, symmetry, and the cases without a prediction."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.control.prediction import (
    MAX_GAP_NS,
    MAX_LOOP_NS,
    CarModel,
    Motion,
    Prediction,
    RelativePose,
    SteeringCommand,
    predict,
)
from lavt.domain import MAX_REPORTED_MPS, NS_PER_MS, NS_PER_S

CAR = CarModel(wheelbase_m=2.8, steering_rate_radps=0.8, steering_lag_s=0.0, stop_deceleration_mps2=4.0)
PICTURE_NS = 1_790_000_000 * NS_PER_S
SPEEDS = st.floats(0.0, 20.0)
ANGLES = st.floats(-0.5, 0.5)
LOOPS = st.integers(0, NS_PER_S)
KNOWN = st.floats(0.0, 1.0)
"""The share of the loop delay for which the vehicle has reported its motion."""


def motions(speed_mps: float, steering_rad: float, until_ns: int) -> list[Motion]:
    """Return reports every 20 ms, from one before the picture to `until_ns` after it."""
    times = [*range(-15 * NS_PER_MS, until_ns, 20 * NS_PER_MS), until_ns]
    return [Motion(PICTURE_NS + at_ns, speed_mps, steering_rad) for at_ns in times]


def predicted(
    speed_mps: float, steering_rad: float, loop_ns: int, known: float, commands: list[SteeringCommand]
) -> Prediction:
    """Predict from reports of a steady motion, which end after the share `known` of the loop delay."""
    reports = motions(speed_mps, steering_rad, round(loop_ns * known))
    prediction = predict(CAR, reports, commands, PICTURE_NS, PICTURE_NS + loop_ns)
    assert prediction is not None
    return prediction


def on_circle(distance_m: float, steering_rad: float) -> tuple[float, float, float]:
    """Return the pose at the end of an arc that begins at the origin."""
    curvature = math.tan(steering_rad) / CAR.wheelbase_m
    turn_rad = curvature * distance_m
    if abs(turn_rad) < 1e-6:
        return distance_m, turn_rad * distance_m / 2, turn_rad
    return math.sin(turn_rad) / curvature, (1 - math.cos(turn_rad)) / curvature, turn_rad


@given(SPEEDS, LOOPS, KNOWN)
def test_straight(speed_mps: float, loop_ns: int, known: float) -> None:
    """Straight ahead, the ghost is v t away, and the stopping line v^2 / (2 a) further."""
    prediction = predicted(speed_mps, 0.0, loop_ns, known, [])
    distance_m = speed_mps * loop_ns / NS_PER_S
    assert prediction.ghost == pytest.approx((distance_m, 0.0, 0.0), abs=1e-6)
    assert prediction.standstill == pytest.approx((distance_m + speed_mps**2 / 8, 0.0, 0.0), abs=1e-6)


@given(SPEEDS, ANGLES, LOOPS, KNOWN)
def test_a_constant_circle(speed_mps: float, steering_rad: float, loop_ns: int, known: float) -> None:
    """With constant steering, ghost and standstill are on the circle of this steering, also from reports."""
    commands = [SteeringCommand(PICTURE_NS - NS_PER_S, steering_rad)]
    prediction = predicted(speed_mps, steering_rad, loop_ns, known, commands)
    distance_m = speed_mps * loop_ns / NS_PER_S
    assert prediction.ghost == pytest.approx(on_circle(distance_m, steering_rad), abs=1e-6)
    stop_m = distance_m + speed_mps**2 / 8
    assert prediction.standstill == pytest.approx(on_circle(stop_m, steering_rad), abs=1e-6)


@given(ANGLES, LOOPS, KNOWN)
def test_at_standstill_nothing_moves(steering_rad: float, loop_ns: int, known: float) -> None:
    """A car that stands is, and stops, where the picture shows it."""
    prediction = predicted(0.0, steering_rad, loop_ns, known, [SteeringCommand(PICTURE_NS, -steering_rad)])
    assert set(prediction.path) == set(prediction.stop) == {RelativePose(0.0, 0.0, 0.0)}


@given(SPEEDS, ANGLES)
def test_without_delay_the_ghost_is_the_car(speed_mps: float, steering_rad: float) -> None:
    """Without a loop delay, the ghost is at the car, and the stopping line v^2 / (2 a) ahead."""
    prediction = predicted(speed_mps, steering_rad, 0, 1.0, [])
    assert prediction.path == (RelativePose(0.0, 0.0, 0.0),)
    assert prediction.standstill == pytest.approx(on_circle(speed_mps**2 / 8, steering_rad), abs=1e-6)


@given(SPEEDS, ANGLES, LOOPS, KNOWN, st.lists(st.tuples(LOOPS, ANGLES)))
def test_mirrored_steering_gives_the_mirrored_path(
    speed_mps: float, steering_rad: float, loop_ns: int, known: float, sent: list[tuple[int, float]]
) -> None:
    """Left and right are alike."""
    left, right = (
        predicted(
            speed_mps,
            sign * steering_rad,
            loop_ns,
            known,
            [SteeringCommand(PICTURE_NS + at_ns, sign * angle) for at_ns, angle in sorted(sent)],
        )
        for sign in (1, -1)
    )
    for one, other in zip((*left.path, *left.stop), (*right.path, *right.stop), strict=True):
        assert one == pytest.approx((other.x_m, -other.y_m, -other.heading_rad), abs=1e-9)


def test_the_wheels_follow_the_commands_at_a_limited_rate() -> None:
    """A step of 0.2 rad that takes effect halfway takes 0.25 s; the heading is the integral of the curvature."""
    commands = [SteeringCommand(PICTURE_NS, 0.0), SteeringCommand(PICTURE_NS + NS_PER_S // 2, 0.2)]
    prediction = predict(CAR, motions(8.0, 0.0, 0), commands, PICTURE_NS, PICTURE_NS + NS_PER_S)
    assert prediction is not None
    while_turning = -math.log(math.cos(0.2)) / 0.8  # the integral of tan over 0.25 s
    heading_rad = 8.0 / CAR.wheelbase_m * (while_turning + 0.25 * math.tan(0.2))
    assert prediction.ghost.heading_rad == pytest.approx(heading_rad, rel=1e-3)
    late = predict(CAR, motions(8.0, 0.0, 0), commands, PICTURE_NS, PICTURE_NS + NS_PER_S // 2)
    assert late is not None
    assert late.ghost.heading_rad == 0.0
    assert late.standstill.heading_rad > 0.1  # a command that is on its way counts for the stop


def test_the_wheels_follow_with_their_lag() -> None:
    """A small step is followed exponentially, so that after many time constants the turn is later by the lag."""
    commands = [SteeringCommand(PICTURE_NS, 0.02)]
    lagging = replace(CAR, steering_lag_s=0.1)
    prediction = predict(lagging, motions(8.0, 0.0, 0), commands, PICTURE_NS, PICTURE_NS + NS_PER_S)
    assert prediction is not None
    assert prediction.ghost.heading_rad == pytest.approx(8.0 / CAR.wheelbase_m * 0.02 * (1.0 - 0.1), rel=1e-3)


def test_reports_are_believed_before_commands() -> None:
    """What the vehicle has reported counts, whatever the commands of that time were, as if they had been limited."""
    reports = motions(8.0, 0.0, NS_PER_S)
    prediction = predict(CAR, reports, [SteeringCommand(PICTURE_NS, 0.3)], PICTURE_NS, PICTURE_NS + NS_PER_S)
    assert prediction is not None
    assert prediction.ghost == pytest.approx((8.0, 0.0, 0.0))


def test_a_changing_speed_is_integrated() -> None:
    """A steady acceleration between the reports gives the mean speed."""
    reports = [Motion(PICTURE_NS + index * NS_PER_S // 50, index / 50, 0.0) for index in range(-1, 51)]
    prediction = predict(CAR, reports[1:], [], PICTURE_NS, PICTURE_NS + NS_PER_S)
    assert prediction is not None
    assert prediction.ghost.x_m == pytest.approx(0.5)


def test_the_car_moves_only_after_the_picture() -> None:
    """If the newest report is older than the picture, the wheels turn before it, but the path begins at it."""
    report = [Motion(PICTURE_NS - NS_PER_S // 4, 8.0, 0.0)]
    commands = [SteeringCommand(PICTURE_NS - NS_PER_S, 0.2)]
    prediction = predict(CAR, report, commands, PICTURE_NS, PICTURE_NS + NS_PER_S)
    assert prediction is not None
    assert prediction.ghost == pytest.approx(on_circle(8.0, 0.2), abs=1e-6)


@pytest.mark.parametrize("speed_mps", [math.nan, math.inf, -math.inf, -0.5, MAX_REPORTED_MPS])
@pytest.mark.parametrize("index", [0, 3, -1])
def test_an_impossible_speed_gives_no_prediction(speed_mps: float, index: int) -> None:
    """A report of a speed that is not finite, backwards or beyond any vehicle's gives no prediction."""
    reports = motions(8.0, 0.1, NS_PER_S // 10)
    reports[index] = reports[index]._replace(speed_mps=speed_mps)
    assert predict(CAR, reports, [], PICTURE_NS, PICTURE_NS + NS_PER_S) is None


@pytest.mark.parametrize("steering_rad", [math.nan, math.inf, -math.inf])
def test_steering_that_is_not_finite_gives_no_prediction(steering_rad: float) -> None:
    """A steering angle that is not finite, commanded or reported, gives no prediction."""
    reports = motions(8.0, 0.1, NS_PER_S // 10)
    commands = [SteeringCommand(PICTURE_NS, steering_rad)]
    assert predict(CAR, reports, commands, PICTURE_NS, PICTURE_NS + NS_PER_S) is None
    reports[2] = reports[2]._replace(steering_rad=steering_rad)
    assert predict(CAR, reports, [], PICTURE_NS, PICTURE_NS + NS_PER_S) is None


def test_missing_reports_give_no_prediction() -> None:
    """Without a report, or with reports that are all far from the picture's time, there is no prediction."""
    until_ns = PICTURE_NS + NS_PER_S
    assert predict(CAR, [], [], PICTURE_NS, until_ns) is None
    for at_ns, is_enough in (
        (-MAX_GAP_NS, True),
        (-MAX_GAP_NS - 1, False),
        (MAX_GAP_NS, True),
        (MAX_GAP_NS + 1, False),
    ):
        prediction = predict(CAR, [Motion(PICTURE_NS + at_ns, 8.0, 0.0)], [], PICTURE_NS, until_ns)
        assert (prediction is not None) == is_enough


@pytest.mark.parametrize("loop_ns", [-1, MAX_LOOP_NS + 1])
def test_an_impossible_loop_delay_gives_no_prediction(loop_ns: int) -> None:
    """An effect before the picture, or later than the longest loop delay, gives no prediction."""
    assert predict(CAR, motions(8.0, 0.0, 0), [], PICTURE_NS, PICTURE_NS + loop_ns) is None
