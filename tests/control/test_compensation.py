"""The controllers that know the delay of their loop, in a loop with an injected clock and the simulator's car."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import msgspec
import pytest

from lavt.config import CompensationConfig
from lavt.control.compensation import (
    VARIANTS,
    CompensatingController,
    CompensationSettings,
    interpolate,
    path_from,
)
from lavt.control.drive_controller import DriveController, LaneKeeper, make_controller
from lavt.control.preset import DESIGNED
from lavt.control.pure_pursuit import PlanarPose, pursuit_path_per_m
from lavt.domain import NS_PER_MS, NS_PER_S, PATH_POINTS, Actuation, Decision, Lane, State
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ, CarDynamics, CarMotion

STEP_NS = 5 * NS_PER_MS
FRAME_NS = 35 * NS_PER_MS
STATE_NS = 20 * NS_PER_MS
SPEED_MPS = 8.0
CLOCK_SET_NS = 3 * NS_PER_S
EXACT = CompensationSettings(camera_delay_s=0.0, average_lag_s=0.0)
"""The camera of this loop stamps a picture at its exposure, and nothing is averaged."""
PRESET = replace(DESIGNED, speed_mps=SPEED_MPS)
AHEAD = Lane((0.0, 0.0, 0.0), 3.5, 2.0, 20.0, 1.0)


@dataclass
class Loop:
    """A car on a straight lane, with delays of video and control, and unrelated clocks of vehicle and client."""

    controller: DriveController
    video_ms: int = 500
    control_ms: int = 100
    vehicle_clock_ns: int = 1_700_000_000 * NS_PER_S
    clock_step_ns: int = 0
    """By how much the vehicle's wall clock is set after `clock_set_ns`."""
    clock_set_ns: int = CLOCK_SET_NS

    def drive(self, seconds: float, *, offset_m: float = 0.5) -> list[float]:
        """Return the lateral errors at each picture, and store the decisions."""
        car = CarDynamics(LINCOLN_MKZ, CarMotion(0.0, offset_m, 0.0, speed_mps=SPEED_MPS), STEP_NS / NS_PER_S)
        pictures: deque[tuple[int, int, Lane, float]] = deque()
        commands: deque[tuple[int, int, float]] = deque()
        errors, sequence, applied, target_rad = [], 0, -1, 0.0
        self.decisions: list[Decision] = []
        for now_ns in range(0, round(seconds * NS_PER_S), STEP_NS):
            motion, wall_ns = car.motion, now_ns + self.vehicle_clock_ns
            wall_ns += self.clock_step_ns * (now_ns >= self.clock_set_ns)
            if now_ns % FRAME_NS == 0:
                slope = -math.tan(motion.heading_rad)
                lane = Lane((-motion.y_m / math.cos(motion.heading_rad), slope, 0.0), 3.5, 2.0, 20.0, 1.0)
                pictures.append((now_ns + self.video_ms * NS_PER_MS, wall_ns, lane, motion.speed_mps))
                errors.append(motion.y_m)
            while commands and commands[0][0] <= now_ns:
                _, applied, target_rad = commands.popleft()
            history = getattr(self.controller, "history", None)
            if now_ns % STATE_NS == 0 and history is not None:
                history.note_state(state(wall_ns, now_ns, motion, applied), now_ns)
            while pictures and pictures[0][0] <= now_ns:
                _, stamp_ns, lane, speed_mps = pictures.popleft()
                if isinstance(self.controller, CompensatingController):
                    self.controller.note_stamp(stamp_ns)
                decision = self.controller.decide(lane, speed_mps, now_ns)
                self.decisions.append(decision)
                sequence += 1
                if history is not None:
                    history.note_command(sequence, decision.steering_rad, now_ns)
                commands.append((now_ns + self.control_ms * NS_PER_MS, sequence, decision.steering_rad))
            car.step(Actuation(target_rad, 0.06, 0.0))
        return errors


def state(wall_ns: int, mono_ns: int, motion: CarMotion, applied: int) -> State:
    """Return the state that the car reports."""
    return State(
        sent_wall_ns=wall_ns,
        state_mono_ns=mono_ns,
        speed_mps=motion.speed_mps,
        steering_rad=motion.steering_rad,
        gear="drive",
        safety="driving",
        reason="",
        applied_sequence=applied,
        rejected="",
    )


def controller(kind: str, settings: CompensationSettings = EXACT) -> CompensatingController:
    """Return a controller with the lookahead of its variant."""
    variant = VARIANTS[kind]
    preset = replace(PRESET, lookahead_s=variant.lookahead_s)
    return CompensatingController(variant, preset, wheelbase_m=LINCOLN_MKZ.wheelbase_m, settings=settings)


@pytest.mark.parametrize("step_s", [-2.0, -0.2, 0.2, 2.0])
def test_no_pose_is_predicted_with_two_clocks(step_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """When the vehicle's clock is set, nothing is predicted until pictures with stamps of the new clock arrive."""
    known = controller("predictive")
    predict, predicted = known._predict_pose, []

    def spy(speed_mps: float, now_ns: int) -> PlanarPose | None:
        pose = predict(speed_mps, now_ns)
        predicted.append((now_ns / NS_PER_S, pose))
        return pose

    monkeypatch.setattr(known, "_predict_pose", spy)
    Loop(known, clock_step_ns=round(step_s * NS_PER_S)).drive(9)
    set_s, total_delay_s = CLOCK_SET_NS / NS_PER_S, 0.6
    without = [at_s for at_s, pose in predicted if pose is None and at_s > set_s]
    poses = [(at_s, pose) for at_s, pose in predicted if pose is not None]

    assert len(without) > 10
    assert max(without) < set_s + 0.7 + max(0.0, -step_s)
    assert poses[-1][0] > 8.9
    for at_s, (x_m, _, _) in poses:
        assert x_m == pytest.approx(SPEED_MPS * total_delay_s, rel=0.1), at_s


def test_without_a_prediction_it_looks_farther_ahead() -> None:
    """While a clock that was set back by 2 s allows no prediction at 600 ms, the error does not grow."""
    loop = Loop(controller("predictive"), clock_step_ns=-2 * NS_PER_S, clock_set_ns=2 * NS_PER_S)
    assert max(map(abs, loop.drive(6))) < 0.6


@pytest.mark.parametrize(
    ("kind", "video_ms", "control_ms"),
    [
        ("predictive", 500, 100),
        ("predictive", 800, 200),
        ("smith", 500, 100),
        ("constant_delay", 290, 100),
    ],
)
def test_a_prediction_stabilizes_the_loop(kind: str, video_ms: int, control_ms: int) -> None:
    """From 0.5 m beside the centre, a controller that predicts comes to the centre and stays there."""
    errors_m = Loop(controller(kind), video_ms, control_ms).drive(20)
    assert max(map(abs, errors_m)) < 0.6
    assert max(map(abs, errors_m[len(errors_m) // 2 :])) < 0.05


def test_without_a_prediction_the_same_loop_is_unstable() -> None:
    """At 600 ms the lane keeper with the preset `designed` oscillates more and more."""
    errors_m = Loop(LaneKeeper(PRESET, wheelbase_m=LINCOLN_MKZ.wheelbase_m)).drive(20)
    assert max(map(abs, errors_m[len(errors_m) // 2 :])) > 1.0


def test_the_control_delay_needs_no_common_clock() -> None:
    """Whatever the vehicle's clock shows, the decisions are the same, to the last bit."""
    loops = [Loop(controller("predictive"), vehicle_clock_ns=clock_ns) for clock_ns in (NS_PER_S, 10**18)]
    assert loops[0].drive(5) == loops[1].drive(5)
    assert loops[0].decisions == loops[1].decisions


@pytest.mark.parametrize("kind", ["predictive", "smith", "scheduled_lookahead"])
def test_without_a_known_delay_it_drives_as_the_lane_keeper(kind: str) -> None:
    """Before the vehicle has applied a command, the decisions are those of pure pursuit from the seen lane."""
    lane = Lane((0.4, 0.05, 0.001), 3.5, 2.0, 20.0, 1.0)
    knows, keeps = (
        controller(kind),
        LaneKeeper(replace(PRESET, lookahead_s=VARIANTS[kind].lookahead_s), wheelbase_m=LINCOLN_MKZ.wheelbase_m),
    )
    for now_ns in range(0, NS_PER_S, FRAME_NS):
        knows.note_stamp(now_ns)
        assert knows.decide(lane, SPEED_MPS, now_ns) == keeps.decide(lane, SPEED_MPS, now_ns)


def test_an_assumed_delay_is_not_measured() -> None:
    """With an assumed delay of 0 s the loop at 600 ms is as unstable as without a prediction."""
    wrong = controller("constant_delay", replace(EXACT, constant_delay_s=0.0))
    errors_m = Loop(wrong).drive(20)
    assert max(map(abs, errors_m[len(errors_m) // 2 :])) > 1.0


def test_a_wrong_delay_changes_the_prediction() -> None:
    """An estimate that is 300 ms too short makes the loop at 600 ms unstable; the right one does not."""
    wrong = controller("predictive", replace(EXACT, delay_error_s=-0.3))
    assert max(map(abs, Loop(wrong).drive(20)[-100:])) > 0.5


def test_a_longer_delay_lengthens_the_lookahead() -> None:
    """At 400 ms, the steering towards a lane to the left is gentler than at 100 ms."""
    decisions = []
    for video_ms in (80, 380):
        loop = Loop(controller("scheduled_lookahead"), video_ms, 20)
        loop.drive(3, offset_m=0.0)
        decisions.append(loop.controller.decide(Lane((0.5, 0.0, 0.0), 3.5, 2.0, 20.0, 1.0), SPEED_MPS, 3 * NS_PER_S))
    assert 0 < decisions[1].steering_rad < 0.4 * decisions[0].steering_rad


def test_a_longer_delay_slows_the_car_down() -> None:
    """At 600 ms, `slow_down` brakes at 8 m/s; at 100 ms it hardly does."""
    brakes = []
    for video_ms in (20, 500):
        loop = Loop(controller("slow_down"), video_ms, 80)
        loop.drive(3, offset_m=0.0)
        brakes.append(loop.decisions[-1].brake)
    assert brakes[0] < 0.01
    assert brakes[1] > 0.2


@pytest.mark.parametrize("step_s", [3.0, 3600.0])
def test_a_server_that_restarts_with_another_clock_does_not_shorten_the_delay(step_s: float) -> None:
    """While a restarted server with a faster clock drives nothing yet, `slow_down` keeps the low speed of 600 ms."""
    known = controller("slow_down")
    loop = Loop(known, 500, 80)
    loop.drive(3, offset_m=0.0)
    clock_ns = loop.vehicle_clock_ns + round(step_s * NS_PER_S)
    for now_ns in range(3 * NS_PER_S, 4 * NS_PER_S, FRAME_NS):
        restarted = state(now_ns + clock_ns, now_ns, CarMotion(0.0, 0.0, 0.0, speed_mps=0.0), -1)
        known.history.note_state(msgspec.structs.replace(restarted, instance=1), now_ns)
        known.note_stamp(now_ns + clock_ns - 500 * NS_PER_MS)
        decision = known.decide(AHEAD, SPEED_MPS, now_ns)
    assert decision.brake == pytest.approx(loop.decisions[-1].brake)


def test_a_picture_that_arrives_before_the_state_that_shows_a_step_of_the_clock_is_not_averaged() -> None:
    """One stamp that is an hour later does not end the low speed of `slow_down`."""
    known = controller("slow_down")
    loop = Loop(known, 500, 80)
    loop.drive(3, offset_m=0.0)
    known.note_stamp(loop.vehicle_clock_ns + 3603 * NS_PER_S)
    decision = known.decide(AHEAD, SPEED_MPS, 3 * NS_PER_S)
    assert decision.brake == pytest.approx(loop.decisions[-1].brake)


def test_a_lost_lane_is_followed_from_the_predicted_pose() -> None:
    """Without a lane, the car steers by the last lane as a car that has moved on, and uses no pedal."""
    loop = Loop(controller("predictive"))
    loop.drive(5)
    lost = Lane((0.0, 0.0, 0.0), 3.5, 2.0, 20.0, 0.0)
    decision = loop.controller.decide(lost, SPEED_MPS, 5 * NS_PER_S)
    assert (decision.throttle, decision.brake) == (0.0, 0.0)
    assert decision.steering_rad == pytest.approx(loop.decisions[-1].steering_rad, abs=0.01)


def test_the_path_is_counted_from_the_picture() -> None:
    """The path that a vehicle without commands follows begins at the picture, 6 m before the predicted pose."""
    lane, pose = Lane((0.3, 0.0, 0.002), 3.5, 2.0, 20.0, 1.0), (6.1, 0.2, 0.01)
    path = path_from(lane, 8.0, 0.1, pose, 0.05)
    assert path[:3] == (0.05,) * 3
    assert path[3:] == pursuit_path_per_m(lane, 8.0, 0.1, pose)[: PATH_POINTS - 3]
    assert path_from(lane, 8.0, 0.1, (0.0, 0.0, 0.0), 0.05) == pursuit_path_per_m(lane, 8.0, 0.1)
    assert path_from(lane, 8.0, 0.1, (99.0, 0.0, 0.0), 0.05) == (0.05,) * PATH_POINTS


def test_a_schedule_is_linear_between_its_points() -> None:
    """Outside of its points, a schedule has the value of the nearest one."""
    schedule = ((1.0, 10.0), (2.0, 20.0), (4.0, 0.0))
    assert [interpolate(schedule, at) for at in (0.0, 1.0, 1.5, 3.0, 4.0, 9.0)] == [10.0, 10.0, 15.0, 10.0, 0.0, 0.0]


@pytest.mark.parametrize("kind", VARIANTS)
def test_every_variant_is_a_controller_by_name(kind: str) -> None:
    """Each kind of the table can be made by its name."""
    assert isinstance(make_controller(kind, PRESET, LINCOLN_MKZ.wheelbase_m), CompensatingController)


def test_the_age_of_the_average_follows_the_frame_rate() -> None:
    """Unless it is configured, the age of the averaged lane is two thirds of the time between pictures."""
    config = CompensationConfig()
    ages_s = [config.settings_at(rate_hz).average_lag_s for rate_hz in (10.0, 15.0, 30.0)]
    assert ages_s == [0.067, 0.044, CompensationSettings().average_lag_s]
    assert CompensationConfig(average_lag_s=0.01).settings_at(10.0).average_lag_s == 0.01
    assert config.changes == {}
