"""The predictive display against the truth: where the simulator's car was when the command took effect.

In virtual time a controller drives at L3. For each command, the display predicts from the picture of this command, as
for a person who sees that picture now. The ground truth tells the pose at the picture's capture and the pose when the
vehicle applied the command.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from lavt.assembly.nodes import build_predictor
from lavt.config import RunConfig
from lavt.config_file import build_config
from lavt.control.prediction import CarModel, Motion, Prediction, SteeringCommand, predict
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, Decision, FloatArray, Now
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.side_configs import client_config
from lavt.experiment.runs.virtual_run import VirtualLoop, build_loop, drive
from lavt.nodes.page_prediction import PagePredictor
from lavt.recording.record import Record, read_record
from lavt.safety.limits import LIMITS
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ, CarDynamics, CarMotion

CAR = LINCOLN_MKZ
EFFECT_ERROR_S = 0.01
"""Half of the period of the states: how exactly they tell when commands take effect."""
REAR_SLIP_RAD = (
    CAR.mass_kg * CAR.front_axle_to_gravity_m / CAR.wheelbase_m * LIMITS.lateral_acceleration_mps2
) / CAR.rear_stiffness_nprad
"""The slip of the rear axle at the largest lateral acceleration: the car moves by this angle beside its heading, and
the model does not know it."""
STEP_RAD = 0.08
"""At 9 m/s, the lateral acceleration with this angle is just below the vehicle's limit."""
SETTLED_S = 2 * STEP_RAD / CAR.max_steering_rate_radps + 3 * CAR.steering_lag_s
"""After this time the wheels have followed a step from the left to the right: its duration and three time constants."""


class Bounds(NamedTuple):
    """The largest errors that the parts which the model leaves out can cause."""

    ahead_m: float
    left_m: float
    turn_rad: float


def error_bounds(
    speed_mps: float,
    steering_rad: float,
    change_rad: float,
    *,
    loop_s: float,
    unknown_s: float,
    acceleration_mps2: float,
) -> Bounds:
    """Return the bounds at these largest values of speed, steering, its change, and acceleration in the loop delay.

    `unknown_s` is by how much the display can be wrong about the length of the loop delay. The car turns later than
    the model by the smaller rate of its wheels and the time constant of its tyres.
    """
    distance_m, unknown_m = speed_mps * loop_s, speed_mps * unknown_s
    curvature = math.tan(steering_rad) / CAR.wheelbase_m
    slower_s = change_rad / 2 * (1 / CAR.max_steering_rate_radps - 1 / LIMITS.steering_rate_radps)
    tyres_s = CAR.mass_kg * speed_mps / (CAR.front_stiffness_nprad + CAR.rear_stiffness_nprad)
    lagging_rad = speed_mps / CAR.wheelbase_m * (slower_s + tyres_s) * change_rad
    turn_rad = lagging_rad + curvature * unknown_m
    return Bounds(
        unknown_m + acceleration_mps2 * loop_s**2 / 2, (REAR_SLIP_RAD + turn_rad) * distance_m, turn_rad + 0.005
    )


class Predicted(NamedTuple):
    """What was predicted when a command was sent, from the picture with this stamp."""

    stamp_ns: int
    prediction: Prediction


def watch_driver(loop: VirtualLoop, predictor: PagePredictor) -> dict[int, Predicted]:
    """Let `predictor` see what the driver node sends and receives; return the predictions by sequence number."""
    driver: Any = loop.client.driver
    found: dict[int, Predicted] = {}

    def note_command(decision: Decision, now: Now) -> None:
        prediction = predictor.predict_since(driver._view.stamp_ns, now.mono_ns)
        if prediction is not None:
            found[driver._sequence] = Predicted(driver._view.stamp_ns, prediction)
        predictor.history.note_command(driver._sequence, decision.steering_rad, now.mono_ns)

    def note_state(now: Now) -> None:
        if driver.session.has_control:
            predictor.history.note_state(driver._newest_state, now.mono_ns)

    driver._note_command, driver._handle_newer_state = note_command, note_state
    return found


def true_motion(record: Record) -> Callable[[float], FloatArray]:
    """Return a function that gives x, y, heading, speed and steering at a time."""
    truth = record.table("truth")
    times = truth.ints("mono_ns")
    columns = [truth.floats(name) for name in ("x_m", "y_m", "heading_rad", "speed_mps", "steering_rad")]
    columns[2] = np.unwrap(columns[2])
    return lambda at_ns: np.array([np.interp(at_ns, times, column) for column in columns])


def moved(before: FloatArray, after: FloatArray) -> tuple[float, float, float]:
    """Return the second pose relative to the first: ahead, left, turned."""
    east_m, north_m, turned_rad = after[:3] - before[:3]
    cosine, sine = math.cos(before[2]), math.sin(before[2])
    return east_m * cosine + north_m * sine, north_m * cosine - east_m * sine, turned_rad


def report(title: str, errors: list[FloatArray], actual: list[FloatArray]) -> None:
    """Print the largest and the median errors beside the movement in the loop delay."""
    for name, column in (("ahead (m)", 0), ("left (m)", 1), ("heading (rad)", 2)):
        values, moves = np.abs(np.array(errors)[:, column]), np.abs(np.array(actual)[:, column])
        print(  # noqa: T201 (the size of the errors is a result)
            f"{title}, {name}: error p50 {np.median(values):.4f}, max {values.max():.4f}; "
            f"the car itself: p50 {np.median(moves):.4f}, max {moves.max():.4f}"
        )


@pytest.mark.parametrize("state_delay", ["none", "with_video"])
def test_the_ghost_is_where_the_car_was(state_delay: str, tmp_path: Path) -> None:
    """At L3, the errors stay within what the model leaves out, while the car drives 2 m and turns."""
    changes = ["fidelity=geometry", "network.condition=L3", f"network.state_delay={state_delay}"]
    run = plan_run(build_config(RunConfig, {}, [*changes, "controller.prediction.shown=true"], "test"))
    predictor = build_predictor(client_config(run.config, run.seed))
    assert predictor is not None
    loop = build_loop(run, tmp_path / "run")
    found = watch_driver(loop, predictor)
    drive(loop, limit_ns=40 * NS_PER_S)
    record = read_record(tmp_path / "run" / "server.mcap")
    admission, frame, at = record.table("admission"), record.table("frame"), true_motion(record)
    applications = dict(zip(admission.ints("sequence"), admission.objects("applied_mono_ns"), strict=True))
    captures = {
        stamp_ns: (capture_ns, stamped_ns)
        for stamp_ns, capture_ns, stamped_ns in zip(
            frame.ints("stamp_ns"), frame.objects("capture_ns"), frame.ints("stamped_mono_ns"), strict=True
        )
    }
    assert len(found) > 0.9 * len(applications) > 900
    errors, actual, late_m = [], [], []
    for sequence in sorted(found.keys() & applications.keys()):
        (captured_ns, stamped_ns), applied_ns = captures[found[sequence].stamp_ns], applications[sequence]
        if applied_ns is None:
            continue
        times = np.linspace(captured_ns - SETTLED_S * NS_PER_S, applied_ns + SETTLED_S * NS_PER_S, 20)
        motions = np.array([at(time_ns) for time_ns in times])
        bounds = error_bounds(
            motions[:, 3].max(),
            np.abs(motions[:, 4]).max(),
            np.ptp(motions[:, 4]),
            loop_s=(applied_ns - captured_ns) / NS_PER_S,
            unknown_s=EFFECT_ERROR_S
            + (stamped_ns - captured_ns) / NS_PER_S,  # the display knows the stamp, not the capture
            acceleration_mps2=CAR.max_acceleration_mps2,
        )
        actual.append(np.array(moved(at(captured_ns), at(applied_ns))))
        errors.append(np.array(found[sequence].prediction.ghost) - actual[-1])
        late_m.append(errors[-1][0] + at(captured_ns)[3] * (stamped_ns - captured_ns) / NS_PER_S)
        assert (np.abs(errors[-1]) <= bounds).all(), (sequence, errors[-1], bounds)
    report(f"L3, state delay {state_delay}", errors, actual)
    assert (
        np.median(np.abs(errors), axis=0)[0] < 0.1 * np.median(np.abs(actual), axis=0)[0]
    )  # a picture without a ghost
    assert abs(np.median(late_m)) < EFFECT_ERROR_S * 8.0  # without the time from capture to stamp
    turning = np.abs(np.array(actual)[:, 2]) > 0.03
    assert turning.sum() > 30
    assert np.abs(errors)[turning, 2].mean() < 0.25 * np.abs(actual)[turning, 2].mean()  # a straight prediction


@pytest.mark.parametrize("known_ns", [0, 240 * NS_PER_MS])
def test_a_person_s_steps_of_steering_and_brake(known_ns: int) -> None:
    """With steps of the steering and full pedals, as of a person, the errors stay within the same bounds.

    The car gets each command at once; the picture is 240 ms old, and the newest state is, or is as new as the command.
    """
    loop_ns, step_ns, each = 240 * NS_PER_MS, 20 * NS_PER_MS, 5
    car = CarDynamics(CAR, CarMotion(0.0, 0.0, 0.0, speed_mps=8.0), step_ns / each / NS_PER_S)
    model = CarModel(
        wheelbase_m=CAR.wheelbase_m,
        steering_rate_radps=LIMITS.steering_rate_radps,
        steering_lag_s=CAR.steering_lag_s,
        stop_deceleration_mps2=LIMITS.stop_deceleration_mps2,
    )
    steps = [(0.0, 0.0, 0.0), (1, 0.0, 0.0), (0.0, 1.0, 0.0), (-1, 0.0, 0.0), (1, 0.0, 0.0), (0.0, 0.0, 1.0)]
    requested = [Actuation(left * STEP_RAD, *pedals) for left, *pedals in steps for _ in range(40)]
    motions: list[FloatArray] = []
    errors, actual = [], []
    back = loop_ns // step_ns
    for index, request in enumerate(requested):
        motion = car.motion
        now = [motion.x_m, motion.y_m, motion.heading_rad, motion.speed_mps, motion.steering_rad]
        motions.append(np.array(now))
        if index >= back:
            picture = index - back
            newest = picture + known_ns // step_ns
            prediction = predict(
                model,
                [Motion(i * step_ns, motions[i][3], motions[i][4]) for i in range(picture, newest + 1)],
                [SteeringCommand(i * step_ns, requested[i].steering_rad) for i in range(picture, index)],
                picture * step_ns,
                index * step_ns,
            )
            assert prediction is not None
            since = max(0, picture - round(SETTLED_S * NS_PER_S / step_ns))
            recent = np.array(motions[since:])
            angles = [each_request.steering_rad for each_request in requested[since : index + 1]]
            bounds = error_bounds(
                recent[:, 3].max(),
                np.abs(recent[:, 4]).max(),
                max(angles) - min(angles),
                loop_s=loop_ns / NS_PER_S,
                unknown_s=0.0,
                acceleration_mps2=CAR.max_braking_mps2 + 0.2,  # with its resistance
            )
            actual.append(np.array(moved(motions[picture], motions[index])))
            errors.append(np.array(prediction.ghost) - actual[-1])
            assert (np.abs(errors[-1]) <= bounds).all(), (index, errors[-1], bounds)
        for _ in range(each):
            car.step(request)
    report(f"steps, states until {known_ns // NS_PER_MS} ms after the picture", errors, actual)
