"""A CARLA world that runs by itself: the times of its states, the commands, and who brakes; no server is needed."""

from __future__ import annotations

import math
import os
import signal
import sys
from collections.abc import Callable
from itertools import pairwise
from unittest.mock import Mock

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.support.clocks import ManualClock

from lavt.config import RunConfig
from lavt.config_file import parse_config
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, Now
from lavt.errors import UserError, VehicleError
from lavt.experiment.runs.plan import plan_run
from lavt.operating_system import HANGUP
from lavt.vehicle.carla import guard as guarding
from lavt.vehicle.carla import guard_link
from lavt.vehicle.carla.follower import CALIBRATION_TICKS, RESEND_NS, Follower
from lavt.vehicle.carla.frames import FlatPose
from lavt.vehicle.carla.guard_link import GuardLink
from lavt.vehicle.carla.plausible import SentControls, checked
from lavt.vehicle.carla.settings import CarlaEvent, CarlaSettings, Snapshot
from lavt.vehicle.carla.ticks import FULL_BRAKE, SILENCE_NS
from lavt.vehicle.carla.world_time import WINDOW_NS, WorldTime

START_NS = 5 * NS_PER_S
THROTTLE = Actuation(0.1, 0.5, 0.0)
DELAYS_MS = st.lists(st.floats(1.0, 30.0), min_size=5, max_size=60)


class RecordedWorld:
    """A world that records what is applied."""

    def __init__(self) -> None:
        self.applied: list[tuple[Actuation, bool]] = []
        self.events: list[CarlaEvent] = []

    def apply(self, actuation: Actuation, *, hand_brake: bool = False) -> None:
        """Record the actuation."""
        self.applied.append((actuation, hand_brake))

    def wait_for_state(self) -> Snapshot:
        """Never called, because no thread runs."""
        raise AssertionError

    def take_events(self) -> list[CarlaEvent]:
        """Return the events since the last call."""
        events, self.events = self.events, []
        return events


class FixedClock:
    """A clock that stands still."""

    def now(self) -> Now:
        """Return the start."""
        return Now(START_NS, 0)


def snapshot(frame: int, elapsed_s: float, platform_s: float = 0.0) -> Snapshot:
    return Snapshot(frame, FlatPose(0.0, 0.0, 0.0), 0.0, 0.0, 1, elapsed_s, platform_s)


def follow(follower: Follower, world_s: float, clock_s: float, *, count: int, first: int = 1) -> None:
    """Let states arrive that are `world_s` apart in the world, and `clock_s` apart on the clock."""
    for number in range(first, first + count):
        follower.note(snapshot(number, 100 + number * world_s), START_NS + round(number * clock_s * NS_PER_S))


@given(DELAYS_MS)
def test_a_state_is_at_most_as_old_as_its_delay(delays_ms: list[float]) -> None:
    """A state's time is between its true time and its arrival, and its error is the smallest delay so far."""
    times, smallest_ms = WorldTime(), 1e9
    for number, delay_ms in enumerate(delays_ms):
        true_ns = START_NS + number * 10 * NS_PER_MS
        arrived_ns = max(true_ns + round(delay_ms * NS_PER_MS), START_NS)
        smallest_ms = min(smallest_ms, delay_ms)
        found_ns = times.state_ns(true_ns - START_NS, arrived_ns)
        assert true_ns <= found_ns <= arrived_ns
        assert found_ns - true_ns == pytest.approx(smallest_ms * NS_PER_MS, abs=2)


def test_a_world_that_lost_time_is_followed() -> None:
    """A second after a world stood still for 80 ms, its states have their true times again, and 80 ms were reported."""
    times, drifts = WorldTime(), 0
    for number in range(400):
        elapsed_ns = number * 10 * NS_PER_MS
        lost_ns = 80 * NS_PER_MS if number >= 100 else 0
        state_ns = times.state_ns(elapsed_ns, START_NS + elapsed_ns + lost_ns)
        drifts += times.take_drift_ns()
        if number > 100 + WINDOW_NS // (10 * NS_PER_MS) + 1:
            assert state_ns == START_NS + elapsed_ns + lost_ns
    assert drifts == 80 * NS_PER_MS


@pytest.mark.parametrize(("pace", "is_late"), [(1.0, False), (0.97, True), (1.03, True)])
def test_a_world_at_another_pace_is_late(pace: float, is_late: bool) -> None:
    """A world that runs 3 % slower or faster than the clock reports that share of the time as late."""
    follower = Follower(RecordedWorld())
    follow(follower, 0.02 * pace, 0.02, count=1000)
    late_ms = [int(event.detail.removesuffix(" ms")) for _, event in follower.take_events() if event.kind == "late"]
    assert sum(late_ms) == pytest.approx(0.03 * 20_000 if is_late else 0.0, rel=0.1)


@pytest.mark.parametrize(
    ("pace", "lag", "is_late"),
    [(1.0, 0.0, False), (0.98, 0.0, False), (1.0001, 0.0, False), (1.0, 0.002, True), (1.0, 0.0001, False)],
)
def test_a_way_that_becomes_longer_is_told_from_a_slow_world(pace: float, lag: float, is_late: bool) -> None:
    """States that arrive later and later by the clock of CARLA's machine are counted; those of a slow world are not."""
    follower = Follower(RecordedWorld())
    for number in range(1000):
        at_s = 0.02 * number
        arrived_ns = START_NS + round((at_s + lag * at_s) * NS_PER_S)
        follower.note(snapshot(number, 100 + pace * at_s, 7e5 + at_s), arrived_ns)
    assert (follower.counts["states_late"] > 600) == is_late
    assert follower.counts["states_late"] == 0 or is_late


def test_the_first_states_only_give_the_time() -> None:
    """The first states are not used; of the others, times increase, and frames that did not arrive are counted."""
    follower = Follower(RecordedWorld())
    follow(follower, 0.02, 0.02, count=CALIBRATION_TICKS)
    assert follower.take_ticks(0) == []
    follow(follower, 0.02, 0.02, count=5, first=CALIBRATION_TICKS + 4)
    ticked = follower.take_ticks(0)
    assert len(ticked) == 5
    assert all(first.due_ns < second.due_ns for first, second in pairwise(ticked))
    assert follower.counts["states_missed"] == 3
    found = follower.wait_for_frame(CALIBRATION_TICKS + 5, 0.0)
    assert found == ticked[1]
    assert follower.wait_for_frame(CALIBRATION_TICKS + 3, 0.0) is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["pose", "speed_mps", "steering_rad", "elapsed_s", "platform_s"])
def test_values_that_are_not_finite_are_refused(field: str, value: float) -> None:
    """A pose, speed, angle or time that is not finite is an error of the server, not a state of the car."""
    wrong = FlatPose(value, 0.0, 0.0) if field == "pose" else value
    with pytest.raises(VehicleError, match=r"here:1 reports .* not finite"):
        checked(msgspec.structs.replace(snapshot(1, 0.1), **{field: wrong}), "here:1")
    assert checked(snapshot(1, 0.1), "here:1") == snapshot(1, 0.1)


@pytest.mark.parametrize(("speed_mps", "steering_rad"), [(1e30, 0.0), (0.0, math.pi / 2), (-200.0, 0.0)])
def test_values_that_no_car_has_are_refused(speed_mps: float, steering_rad: float) -> None:
    """A speed of 720 km/h or wheels across the car are an error of the server."""
    wrong = msgspec.structs.replace(snapshot(1, 0.1), speed_mps=speed_mps, steering_rad=steering_rad)
    with pytest.raises(VehicleError, match="which no car can have"):
        checked(wrong, "here:1")


def test_a_control_that_was_not_sent_is_noticed() -> None:
    """The control in force may be one of the last half second or the guard's; another one means a lost connection."""
    sent = SentControls()
    sent.check(0.0, 0.7, 0.0, "here:1")  # nothing has been sent yet
    for number in range(10):
        sent.note(0.1 * number, 0.5, 0.0)
        sent.check(0.1 * number, 0.5, 0.0, "here:1")
        sent.check(0.1 * number, 0.0, 1.0, "here:1")
    for number in range(10, 14):
        sent.note(0.1 * number, 0.0, 1.0)
        sent.check(0.1 * number, 0.5, 0.0, "here:1")  # the old one is still on its way
    sent.note(1.5, 0.0, 1.0)
    with pytest.raises(VehicleError, match=r"does not do what it is told \(throttle 0\.50, brake 0\.00\)"):
        sent.check(1.5, 0.5, 0.0, "here:1")


def test_a_new_car_may_not_have_its_first_control_yet() -> None:
    """A server that answers late reports that a new car has no control, but only for half a second of its time."""
    sent = SentControls()
    for number in range(10):
        sent.note(7.0 + 0.1 * number, 0.5, 0.0)
    sent.check(7.4, 0.0, 0.0, "here:1")
    with pytest.raises(VehicleError, match=r"does not do what it is told \(throttle 0\.00, brake 0\.00\)"):
        sent.check(7.6, 0.0, 0.0, "here:1")


def test_a_guard_whose_server_is_silent_goes_on_without_answering() -> None:
    """A beat is answered only if the server has answered within a second; its silence does not end the guard."""
    clock, asked, is_silent = ManualClock(), 0, True

    def ask_server() -> str:
        nonlocal asked
        asked += 1
        if is_silent:
            raise RuntimeError("time-out")
        return "0.9.16"

    reader, writer = os.pipe()
    os.set_blocking(reader, False)
    answer = guarding.BeatAnswer(ask_server, clock, writer)
    try:
        answer()
        with pytest.raises(BlockingIOError):
            os.read(reader, 10)
        is_silent = False
        answer()
        answer()
        assert (os.read(reader, 10), asked) == (guarding.BEAT * 2, 2)
        clock.advance(guarding.CALL_NS / NS_PER_MS)
        is_silent = True
        answer()
        with pytest.raises(BlockingIOError):
            os.read(reader, 10)
        os.close(reader)
        is_silent = False
        answer()
    finally:
        os.close(writer)


def test_a_follower_that_fails_brakes_and_stops_beating() -> None:
    """The error of one thread sends the full brake, ends the other thread, and is raised to the actuator."""
    world = RecordedWorld()
    follower = Follower(world)
    follower._fail(VehicleError("the connection is lost"))
    assert world.applied[-1] == (FULL_BRAKE, False)
    with pytest.raises(VehicleError, match="the connection is lost"):
        follower.tick_until(START_NS)


def test_a_command_is_sent_at_once_and_repeated() -> None:
    """A new command is sent when it comes, and again after a while, because the guard may have braked."""
    world, beats = RecordedWorld(), []
    follower = Follower(world, beat=lambda: beats.append(1))
    for after_ns, count in ((0, 1), (1, 1), (RESEND_NS - 1, 1), (RESEND_NS, 2), (RESEND_NS + 1, 2)):
        follower.tick_until(START_NS + after_ns)
        follower.send(START_NS + after_ns)
        assert len(world.applied) == count
    follower.command(THROTTLE, START_NS, hand_brake=False)
    follower.send(START_NS + RESEND_NS + 2)
    assert world.applied[-1] == (THROTTLE, False)
    assert len(beats) == 6


def test_a_car_is_braked_when_the_actuator_is_silent() -> None:
    """If the actuator does not look for states for more than 200 ms, the car brakes along its last steering angle."""
    world = RecordedWorld()
    follower = Follower(world)
    follower.tick_until(START_NS)
    follower.command(THROTTLE, START_NS, hand_brake=False)
    for after_ns, sent in ((0, THROTTLE), (SILENCE_NS, THROTTLE), (SILENCE_NS + 1, Actuation(0.1, 0.0, 1.0))):
        follower.send(START_NS + after_ns)
        assert world.applied[-1] == (sent, False)
    assert follower.counts["silences"] == 1
    follower.tick_until(START_NS + SILENCE_NS + 2)
    follower.send(START_NS + SILENCE_NS + 2)
    assert world.applied[-1] == (THROTTLE, False)


def test_a_failed_thread_fails_the_actuator() -> None:
    """An error of the guard, or of the server, is raised when the actuator next looks for states."""

    def no_guard() -> None:
        raise UserError("the guard has ended")

    follower = Follower(RecordedWorld(), beat=no_guard)
    follower._send(clock=FixedClock())
    with pytest.raises(UserError, match="the guard has ended"):
        follower.tick_until(START_NS)


class RecordedBrake(guarding.CarBrake):
    """A brake that records its controls."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, bool]] = []
        super().__init__(self._record)

    def _record(self, steer: float, hand_brake: bool) -> bool:
        self.sent.append((steer, hand_brake))
        return True


def guard_with(*texts: bytes) -> list[tuple[float, bool]]:
    """Run the guard's loop on a pipe with some texts, which is then closed; return its steers and hand brakes."""
    reading, writing = os.pipe()
    brake = RecordedBrake()
    for text in texts:
        os.write(writing, text)
    os.close(writing)
    try:
        guarding.guard(reading, brake)
    finally:
        os.close(reading)
    return brake.sent


def test_the_guard_does_not_brake_after_a_farewell() -> None:
    """A guard that was told to end does not touch the car."""
    assert guard_with(b"<0.100000>" * 3, guarding.FAREWELL) == []


@pytest.mark.parametrize(
    ("beats", "steer"),
    [
        (b"", guarding.TRIAL_STEER),
        (b"<0.100000><-0.250000>", -0.25),
        (b"00000><0.300000><0.4", 0.3),
        (b"<9.000000><nan><>", guarding.TRIAL_STEER),
    ],
)
def test_the_guard_brakes_a_dead_process(monkeypatch: pytest.MonkeyPatch, beats: bytes, steer: float) -> None:
    """Without a farewell the guard brakes for some seconds with the steer of the newest whole beat, then parks."""
    monkeypatch.setattr(guarding, "pause", lambda _: None)
    sent = guard_with(beats)
    assert sent == [(steer, False)] * (guarding.LAST_BRAKINGS - 1) + [(steer, True)]


def test_the_guard_brakes_a_silent_process_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """While a process writes nothing the guard brakes again and again; when it writes again, the guard waits again."""
    monkeypatch.setattr(guarding, "BEAT_TIMEOUT_S", 0.0)
    monkeypatch.setattr(guarding, "REPEAT_S", 0.0)
    reading, writing = os.pipe()
    brakings = []

    def send(steer: float, hand_brake: bool) -> bool:
        brakings.append((steer, hand_brake))
        if len(brakings) == 3:
            os.write(writing, b"<0.100000>" + guarding.FAREWELL)
        return True

    guarding.guard(reading, guarding.CarBrake(send))
    assert brakings == [(guarding.TRIAL_STEER, False)] * 3
    for end in (reading, writing):
        os.close(end)


def guard_ended_pipe(send: Callable[[float, bool], bool]) -> None:
    """Run the guard's loop on a pipe that is closed without a farewell."""
    reading, writing = os.pipe()
    os.close(writing)
    try:
        guarding.guard(reading, guarding.CarBrake(send))
    finally:
        os.close(reading)


@pytest.mark.parametrize(("unreached", "brakings"), [(5, 5 + guarding.LAST_BRAKINGS), (1000, guarding.MAX_UNREACHED)])
def test_the_guard_brakes_until_the_server_answered(
    monkeypatch: pytest.MonkeyPatch, unreached: int, brakings: int
) -> None:
    """Only brakings that the server answered count, and the last one pulls the hand brake; the tries are limited."""
    monkeypatch.setattr(guarding, "pause", lambda _: None)
    hand_brakes: list[bool] = []

    def send(_: float, hand_brake: bool) -> bool:
        hand_brakes.append(hand_brake)
        return len(hand_brakes) > unreached

    guard_ended_pipe(send)
    assert len(hand_brakes) == brakings
    assert hand_brakes.count(True) == (unreached < guarding.MAX_UNREACHED)


def test_the_guard_outlives_the_signals_of_a_service_manager(monkeypatch: pytest.MonkeyPatch) -> None:
    """The guard ignores SIGTERM, SIGHUP and SIGINT, which LAVT's process receives at the same time and handles."""
    ignored: list[int] = []
    monkeypatch.setattr(signal, "signal", lambda number, _: ignored.append(number))
    monkeypatch.setattr(guarding, "load_library", Mock(side_effect=UserError("no wheel")))
    monkeypatch.setattr(sys, "argv", ["guard", "127.0.0.1", "2000", "1.0", "24"])
    assert guarding.main() == 1
    assert {signal.SIGINT, signal.SIGTERM, *HANGUP} == set(ignored)


class LostClient:
    """A client whose connection is lost: what it sends is lost without an error, and no answer comes."""

    def __init__(self, *, is_lost: bool) -> None:
        self.is_lost = is_lost
        self.arrived: list[str] = []

    def get_server_version(self) -> str:
        """Return the version, or raise the package's error."""
        if self.is_lost:
            raise RuntimeError("time-out")
        return "0.9.16"


def test_the_guard_connects_anew_after_a_failure() -> None:
    """A braking whose answer does not come is not counted; the next one goes over a new connection."""
    clients = [LostClient(is_lost=True), LostClient(is_lost=False)]
    waiting: list[LostClient | UserError] = [clients[0], UserError("no server"), clients[1]]

    def connect_client() -> LostClient:
        following = waiting.pop(0)
        if isinstance(following, UserError):
            raise following
        return following

    link = GuardLink(connect_client)
    assert [link.reach(lambda client: client.arrived.append("brake")) for _ in range(3)] == [False, False, True]
    assert clients[1].arrived == ["brake"]
    with pytest.raises(RuntimeError, match="time-out"):  # so that LAVT's process, which may have lost its own, ends
        link.ask()


def test_the_guard_does_not_touch_the_cars_of_another_world(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that was restarted, or has loaded a town, may have given the car's number to another client's car."""
    episodes = iter([7, 7, 8])
    monkeypatch.setattr(guard_link, "connect", lambda *_: Mock())
    monkeypatch.setattr(guard_link, "ask_episode", lambda *_: next(episodes))
    connect_client = guard_link.connector(None, CarlaSettings("127.0.0.1", 2000, 0.1, None))
    connect_client()
    connect_client()
    with pytest.raises(VehicleError, match="another world"):
        connect_client()


def test_a_guard_that_does_not_reach_the_car_is_noticed() -> None:
    """The steer of the guard's first control must appear in the car's states, sooner or later."""
    steerings_rad = iter([0.0] * 5 + [-guarding.TRIAL_STEER * 0.5])
    guarding.await_trial(lambda: next(steerings_rad), 0.5)
    with pytest.raises(VehicleError, match="does not reach the car"):
        guarding.await_trial(lambda: 0.0, 0.5)


def test_an_asynchronous_world_needs_real_time() -> None:
    """A run in virtual time with a world that runs by itself is refused, with what to set."""
    settings = {"vehicle": {"kind": "carla", "carla": {"asynchronous": True}}, "time": "virtual"}
    with pytest.raises(UserError, match="asynchronous needs time real"):
        plan_run(parse_config(RunConfig, settings, "the test"))
