# ruff: noqa: D102 (a test bench with short methods)

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import count
from typing import Any, Literal

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec import UNSET
from msgspec.structs import replace
from tests.nodes.stand_ins import MONO_NS, FakeVehicle, at, deliver, payloads

from lavt.domain import NS_PER_MS, NS_PER_S, Command, EventKind, SessionReply, SessionRequest, State, VehicleEvent
from lavt.node import WAKE, Send
from lavt.nodes.actuator import POSE_AHEAD_NS, ActuatorNode
from lavt.nodes.payloads import Admission, AtWheel, FrameWritten, Route, SpeedLimitSample
from lavt.recording.json_payload import to_json
from lavt.safety.gate import RejectionReason, SafetyGate
from lavt.safety.governor import Governor, GovernorSettings
from lavt.safety.limiter import Limiter
from lavt.safety.limits import LIMITS
from lavt.safety.state_machine import TRIGGER_MESSAGES
from lavt.transport.messages import ELLIPSIS, decode, encode
from lavt.vehicle.camera import FrameTimes
from lavt.vehicle.vehicle import ReachedCommand

PERIOD_NS = 20 * NS_PER_MS
"""The period of states, and of the commands of the test bench."""
ARM = Command(
    epoch=0,
    sequence=0,
    sent_wall_ns=11,
    stamp_ns=0,
    stamp_received_wall_ns=22,
    steering_rad=0.0,
    throttle=0.0,
    brake=1.0,
    path_curvature_per_m=(0.0,) * 10,
    mode="arm",
    emergency_stop=0,
)
DRIVE = replace(ARM, mode="drive", throttle=0.5, brake=0.0)


class Bench:
    """An actuator node with a stationary vehicle, and a client that commands it."""

    def __init__(
        self,
        route: Route | None = None,
        sample_times: Sequence[FrameTimes] = (),
        after_collision: Literal["end", "continue"] = "end",
        governor: Governor | None = None,
    ) -> None:
        numbers = count(1)
        limiter = Limiter(
            LIMITS, wheelbase_m=2.8448, max_steering_rad=0.513, max_acceleration_mps2=2.0, max_braking_mps2=6.0
        )
        self.vehicle = FakeVehicle()
        self.gate = SafetyGate(
            LIMITS, limiter, new_epoch=lambda: next(numbers), new_token=lambda: bytes(16), governor=governor
        )
        self.node = ActuatorNode(
            self.vehicle,
            self.gate,
            start_ns=MONO_NS,
            route=route,
            sample_times=sample_times,
            after_collision=after_collision,
        )
        self.mono_ns = 0
        self.sequence = 0
        self.epoch = 0
        self.sends: list[Send] = []

    def deliver(self, channel: str, payload: Any, **options: Any) -> list[Send]:
        sends = deliver(self.node, channel, payload, at(self.mono_ns), **options)
        self.sends += sends
        return sends

    def advance(self, duration_ns: int) -> list[Send]:
        """Let time pass, and wake the node whenever it is due."""
        end_ns, sends = self.mono_ns + duration_ns, []
        while (wake_ns := self.node.next_wake_ns() - MONO_NS) <= end_ns:
            self.mono_ns = max(self.mono_ns, wake_ns)
            sends += self.deliver(WAKE, None)
        self.mono_ns = end_ns
        return sends

    def request(self, operation: Any, number: int = 0) -> SessionReply:
        sends = self.deliver("session", encode(SessionRequest(operation, "alice", 1, number)), peer="query")
        (reply,) = [decode(SessionReply, send.payload) for send in sends if send.peer == "query"]
        self.epoch = reply.epoch or self.epoch
        return reply

    def report_frame(self) -> int:
        """Report a sent frame to the node, as the camera does, and return its stamp."""
        stamp_ns = at(self.mono_ns).wall_ns
        number = self.mono_ns // NS_PER_MS
        self.deliver("frame", FrameWritten(number, stamp_ns, at(self.mono_ns).mono_ns, None, number, 1))
        return stamp_ns

    def send_command(self, **changes: Any) -> Admission:
        """Send an arm command from a new frame, changed by `changes`, and return the gate's verdict."""
        self.sequence += 1
        command = replace(ARM, epoch=self.epoch, sequence=self.sequence, stamp_ns=self.report_frame())
        (admission,) = payloads(self.deliver("control", encode(replace(command, **changes))), "admission")
        assert isinstance(admission, Admission)
        return admission

    def send_drive_command(self, **changes: Any) -> Admission:
        return self.send_command(**{"mode": "drive", "throttle": 0.5, "brake": 0.0, **changes})

    @property
    def safety(self) -> str:
        return self.gate.state

    def arm(self) -> Bench:
        """Acquire control, arm the vehicle, and return this bench."""
        self.request("acquire")
        for _ in range(51):
            self.advance(PERIOD_NS)
            self.send_command()
        assert self.gate.state == "driving"
        return self

    def event_details(self, kind: str) -> list[str]:
        return [event.detail for event in payloads(self.sends, "event") if event.kind == kind]


def test_the_state_is_published_50_times_a_second() -> None:
    """The state is published 50 times a second, with the vehicle's own time and the safety state."""
    bench = Bench()
    states = [decode(State, payload) for payload in payloads(bench.advance(NS_PER_S - 1), "state")]
    assert len(states) == 50
    assert {state.safety for state in states} == {"disarmed"}
    assert [state.state_mono_ns for state in states] == sorted(state.state_mono_ns for state in states)


@pytest.mark.parametrize(("waited_ns", "accepted"), [(0, True), (LIMITS.picture_age_limit_ns, False)])
def test_the_age_of_a_picture_is_judged_when_its_command_is_applied(waited_ns: int, accepted: bool) -> None:
    """A command that waits in a stalled process until its picture is too old is rejected, though it arrived in time."""
    bench = Bench().arm()
    stamp_ns = bench.report_frame()
    bench.sequence += 1
    command = replace(DRIVE, epoch=bench.epoch, sequence=bench.sequence, stamp_ns=stamp_ns)
    arrived = at(bench.mono_ns + 200 * NS_PER_MS)
    bench.mono_ns += 200 * NS_PER_MS + waited_ns
    (admission,) = payloads(bench.deliver("control", encode(command), arrived=arrived), "admission")
    assert admission.received_mono_ns == arrived.mono_ns
    assert admission.reason == ("" if accepted else RejectionReason.PICTURE_TOO_OLD)


def test_lazy_physics_advances_before_each_frame() -> None:
    """With sample times, physics advances just before each frame and for each state, not at each physics step."""
    frames = FrameTimes(MONO_NS + 7 * NS_PER_MS, 30.0)
    bench, woken = Bench(sample_times=[frames]), []
    while (wake_ns := bench.node.next_wake_ns()) < MONO_NS + NS_PER_S:
        bench.mono_ns = wake_ns - MONO_NS
        bench.deliver(WAKE, None)
        woken.append(wake_ns)
        assert bench.vehicle.now_ns == wake_ns
    assert {frames.due_ns(number) - POSE_AHEAD_NS for number in range(30)} <= set(woken)
    assert len(woken) == 30 + 50


def test_a_late_node_publishes_one_state_and_reports_late_physics() -> None:
    """After a stall of 1 s the node publishes one state and reports that physics was late."""
    bench = Bench()
    bench.mono_ns = NS_PER_S
    assert len(payloads(bench.deliver(WAKE, None), "state")) == 1
    assert bench.event_details("late") == ["995 ms"], "the first physics step was due after 1/240 s"
    assert bench.node.next_wake_ns() > at(NS_PER_S).mono_ns


def test_an_accepted_command_is_recorded_completely() -> None:
    """The record of an accepted command has its content, its times and the limits that changed it."""
    bench = Bench().arm()
    admission = bench.send_drive_command(steering_rad=0.4)
    now = at(bench.mono_ns)
    assert admission == Admission(
        epoch=bench.epoch,
        sequence=bench.sequence,
        stamp_ns=now.wall_ns,
        sent_wall_ns=11,
        stamp_received_wall_ns=22,
        received_mono_ns=now.mono_ns,
        received_wall_ns=now.wall_ns,
        applied_mono_ns=now.mono_ns,
        verdict="accepted",
        reason="",
        limited="steering rate",
        mode="drive",
        steering_rad=0.4,
        throttle=0.5,
        brake=0.0,
    )
    assert bench.vehicle.applied[-1].throttle == 0.5
    assert bench.node.counts["commands_limited"] == 1


def test_a_rejected_command_is_recorded_and_not_applied() -> None:
    """A rejected command is recorded with its reason, reported in the state and not applied."""
    bench = Bench().arm()
    applied_before = len(bench.vehicle.applied)
    admission = bench.send_drive_command(epoch=99)
    assert (admission.verdict, admission.reason) == ("rejected", RejectionReason.WRONG_EPOCH)
    assert admission.applied_mono_ns is None
    assert len(bench.vehicle.applied) == applied_before
    (state,) = [decode(State, payload) for payload in payloads(bench.advance(PERIOD_NS), "state")]
    assert state.rejected == RejectionReason.WRONG_EPOCH


def test_arrival_and_application_are_recorded() -> None:
    """The record of a command has the time of its arrival on the host and that of its application."""
    bench = Bench().arm()
    arrived = at(bench.mono_ns)
    stamp_ns = bench.report_frame()
    bench.mono_ns += 10 * NS_PER_MS
    command = replace(DRIVE, epoch=bench.epoch, sequence=999, stamp_ns=stamp_ns)
    (admission,) = payloads(bench.deliver("control", encode(command), arrived=arrived), "admission")
    assert (admission.received_mono_ns, admission.applied_mono_ns) == (arrived.mono_ns, at(bench.mono_ns).mono_ns)


def test_without_drive_commands_the_vehicle_does_not_move_and_stops() -> None:
    """An armed vehicle without drive commands gets no throttle, is degraded after 300 ms and stops after 500 ms."""
    bench = Bench().arm()
    bench.advance(299 * NS_PER_MS)
    assert bench.safety == "driving"
    bench.advance(NS_PER_MS)
    assert bench.safety == "degraded"
    bench.advance(200 * NS_PER_MS)
    assert bench.safety == "safe_stop"
    assert all(requested.throttle == 0 and requested.brake > 0 for requested in bench.vehicle.applied)


def test_a_drive_begins_and_ends_exactly_once() -> None:
    """A drive begins when the vehicle is armed, and ends once: with the first event that ends a drive."""
    bench = Bench().arm()
    bench.send_drive_command()
    bench.vehicle.speed_mps = 8.0
    bench.advance(300 * NS_PER_MS)
    bench.send_drive_command()
    assert bench.safety == "driving"
    bench.vehicle.next_events = [VehicleEvent(1, "lane_invasion", "left"), VehicleEvent(2, "completed", "")]
    bench.advance(PERIOD_NS)
    assert bench.safety == "safe_stop"
    bench.vehicle.next_events = [VehicleEvent(3, "collision", "")]
    bench.vehicle.speed_mps = 0.0
    bench.advance(NS_PER_S)
    assert (bench.event_details("drive_began"), bench.event_details("ending")) == ([""], ["completed"])
    assert bench.event_details("lane_invasion") == ["left"]


def test_a_safe_stop_ends_the_drive_at_standstill() -> None:
    """A safe stop ends the drive at standstill; arming again begins a new drive."""
    bench = Bench().arm()
    bench.vehicle.speed_mps = 8.0
    bench.advance(NS_PER_S)
    assert bench.event_details("ending") == []
    bench.vehicle.speed_mps = 0.0
    bench.advance(NS_PER_S)
    assert bench.event_details("ending") == ["safe_stop"]
    bench.arm()
    assert len(bench.event_details("drive_began")) == 2


@pytest.mark.parametrize(("after_collision", "endings"), [("end", ["collision"]), ("continue", ["completed"])])
def test_whether_a_collision_ends_the_drive_is_a_setting(
    after_collision: Literal["end", "continue"], endings: list[str]
) -> None:
    """A collision ends the drive; with `after_collision: continue` it is only reported."""
    bench = Bench(after_collision=after_collision).arm()
    kinds: tuple[EventKind, ...] = ("collision", "collision", "completed")
    for mono_ns, kind in enumerate(kinds):
        bench.send_drive_command()
        bench.vehicle.next_events = [VehicleEvent(mono_ns, kind, "")]
        bench.advance(PERIOD_NS)
    assert bench.event_details("ending") == endings
    assert len(bench.event_details("collision")) == 2


def test_an_event_before_the_drive_ends_no_drive() -> None:
    """An event before the drive is reported and ends no drive."""
    bench = Bench()
    bench.vehicle.next_events = [VehicleEvent(1, "collision", "hit from behind")]
    bench.advance(PERIOD_NS)
    assert bench.event_details("collision") == ["hit from behind"]
    assert bench.event_details("ending") == []


def test_the_token_goes_to_the_camera_when_it_changes() -> None:
    """The camera gets the new token once when control is acquired, and None when control is released."""
    bench = Bench()
    bench.request("acquire")
    bench.request("acquire")
    assert payloads(bench.sends, "video_token") == [bytes(16)]
    bench.request("release")
    assert payloads(bench.sends, "video_token") == [bytes(16), None]


def test_transitions_and_requests_are_events() -> None:
    """Each safety transition and each session request is recorded as an event."""
    bench = Bench().arm()
    assert bench.request("emergency_stop", 5).granted
    assert [detail.split(":")[0] for detail in bench.event_details("safety")] == [
        "disarmed -> arming",
        "arming -> driving",
        "driving -> emergency_stop",
    ]
    assert bench.event_details("session") == ["acquire by alice granted", "emergency_stop by alice granted"]


def test_frozen_pictures_stop_the_vehicle_even_if_they_change_again() -> None:
    """Five equal pictures stop the vehicle even if a different one follows before the next wake."""
    bench = Bench().arm()
    for number in range(6):
        stamp_ns = at(bench.mono_ns).wall_ns + number
        crc = -1 if number < 5 else 7
        bench.deliver("frame", FrameWritten(5000 + number, stamp_ns, at(bench.mono_ns).mono_ns, None, crc, 1))
    assert bench.safety == "safe_stop"


def test_the_route_is_recorded_once() -> None:
    """The route is recorded once, at the start."""
    route = Route("a_key", 1.0, ((0.0, 0.0),))
    bench = Bench(route)
    bench.advance(NS_PER_S)
    assert payloads(bench.sends, "route") == [route]


@given(st.binary(max_size=200))
def test_unreadable_messages_are_counted(data: bytes) -> None:
    """Unreadable commands and requests are counted, not answered, and do not move the vehicle."""
    bench = Bench()
    assert bench.deliver("control", data) == []
    assert bench.deliver("session", data, peer=3) == []
    counts = bench.node.counts
    assert (counts["commands_unreadable"], counts["session_requests_unreadable"]) == (1, 1)
    assert bench.vehicle.applied == []


def states(sends: list[Send]) -> list[State]:
    return [decode(State, payload) for payload in payloads(sends, "state")]


def test_the_state_names_operator_and_requester() -> None:
    """The state names the active operator and the client that requests control, until that request expires."""
    bench = Bench().arm()
    bench.deliver("session", encode(SessionRequest("request_handover", "bob", 7, 0)), peer="query")
    reported = states(bench.advance(2 * NS_PER_S))
    assert {(state.active_operator, state.requested_by) for state in reported} == {("alice", "bob")}
    assert {state.requested_by for state in states(bench.advance(NS_PER_S + PERIOD_NS))[-1:]} == {""}


def test_a_rejection_is_reported_for_1_s() -> None:
    """The state contains the last rejection reason for 1 s."""
    bench = Bench().arm()
    bench.send_drive_command(epoch=99)
    assert {state.rejected for state in states(bench.advance(NS_PER_S - PERIOD_NS))} == {RejectionReason.WRONG_EPOCH}
    assert {state.rejected for state in states(bench.advance(3 * PERIOD_NS))[-1:]} == {""}


@pytest.mark.parametrize("letter", ["a", "ä"])
def test_a_state_with_a_long_inhibit_reason_is_readable(letter: str) -> None:
    """However long the inhibit reason is, clients can read the state, which contains the reason's beginning."""
    bench = Bench().arm()
    bench.vehicle.inhibit_reason = 300 * letter
    bench.advance(PERIOD_NS)
    bench.request("acquire")
    bench.send_command()
    for state in states(bench.advance(2 * PERIOD_NS)):
        assert state.safety == "safe_stop"
        assert state.reason.endswith(20 * letter + ELLIPSIS)
        assert state.rejected.endswith(20 * letter + ELLIPSIS)


@given(speed_mps=st.floats(), steering_rad=st.floats())
@example(speed_mps=101.0, steering_rad=-1.01)
@example(speed_mps=math.nan, steering_rad=math.nan)
def test_any_vehicle_state_is_readable(speed_mps: float, steering_rad: float) -> None:
    """A state is readable whatever speed and angle the vehicle reports.

    A value within the range of a state is published unchanged, any other value as the nearest end of the range.
    """
    bench = Bench()
    bench.vehicle.speed_mps, bench.vehicle.steering_rad = speed_mps, steering_rad
    (state,) = [decode(State, state) for state in payloads(bench.advance(PERIOD_NS), "state")][-1:]
    for reported, published, bound in ((speed_mps, state.speed_mps, 100.0), (steering_rad, state.steering_rad, 1.0)):
        assert published == (reported if abs(reported) <= bound else math.copysign(bound, published))
        assert math.isnan(reported) or reported * published >= 0


@pytest.mark.parametrize("speed_mps", [math.nan, math.inf])
def test_a_speed_that_is_no_number_stops_and_is_reported(speed_mps: float) -> None:
    """A speed that is not finite leads to a safe stop whose reason is readable, and is not published as standstill."""
    bench = Bench().arm()
    bench.vehicle.speed_mps = speed_mps
    state = decode(State, payloads(bench.advance(2 * PERIOD_NS), "state")[-1])
    assert (state.safety, state.speed_mps) == ("safe_stop", 100.0)
    assert state.reason.startswith(TRIGGER_MESSAGES["vehicle fault"])


def test_a_server_shutdown_stops_the_vehicle_and_ends_the_drive() -> None:
    """A server shutdown stops the vehicle, ends control, closes the video path and ends the drive."""
    bench = Bench().arm()
    bench.vehicle.speed_mps = 5.0
    sends = bench.deliver("server_ends", None)
    assert payloads(sends, "video_token") == [None]
    last = states(bench.advance(PERIOD_NS))[-1]
    assert (last.safety, last.active_operator) == ("safe_stop", "")
    assert "shutting down" in last.reason
    assert bench.vehicle.applied[-1].brake > 0
    bench.vehicle.speed_mps = 0.0
    bench.advance(PERIOD_NS)
    assert bench.event_details("ending") == ["safe_stop"]


def test_the_vehicle_is_engaged_from_arming_to_standstill() -> None:
    """The vehicle is engaged from arming on, until it is stationary after a stop."""
    bench = Bench()
    bench.advance(PERIOD_NS)
    assert not bench.vehicle.is_engage_requested
    bench.arm()
    bench.send_drive_command()
    assert bench.vehicle.is_engage_requested
    bench.vehicle.speed_mps = 5.0
    bench.advance(NS_PER_S)
    assert (bench.safety, bench.vehicle.is_engage_requested) == ("safe_stop", True)
    bench.vehicle.speed_mps = 0.0
    bench.advance(PERIOD_NS)
    assert not bench.vehicle.is_engage_requested


def test_commands_that_reached_the_wheels_are_recorded() -> None:
    """Each command that reached the wheels is recorded once, with its sequence number and stamp."""
    bench = Bench().arm()
    first, second = bench.send_drive_command(), bench.send_drive_command(steering_rad=0.1)
    assert first.applied_mono_ns is not None
    bench.advance(PERIOD_NS)
    applied_ns, reached_ns = second.applied_mono_ns or 0, at(bench.mono_ns).mono_ns
    bench.vehicle.reached = [ReachedCommand(applied_ns + 1, reached_ns)]  # no command was applied at this time
    assert payloads(bench.advance(PERIOD_NS), "wheel") == []
    third = bench.send_drive_command()
    bench.vehicle.reached = [ReachedCommand(third.applied_mono_ns or 0, reached_ns)] * 2
    reported = payloads(bench.advance(PERIOD_NS), "wheel")
    assert reported == [AtWheel(third.sequence, third.stamp_ns, third.applied_mono_ns or 0, reached_ns)]


def test_the_speed_limit_is_published_and_recorded_while_the_vehicle_is_driven() -> None:
    """State and record have the speed limit with its reason from the first drive command until the safe stop."""
    bench = Bench(governor=Governor(GovernorSettings(LIMITS.speed_limit_mps), LIMITS.speed_limit_mps)).arm()
    armed = bench.advance(PERIOD_NS)
    assert {state.speed_limit_mps for state in states(armed)} == {UNSET}
    assert payloads(armed, "speed_limit") == []
    bench.send_drive_command()
    driven = bench.advance(250 * NS_PER_MS)
    samples: list[SpeedLimitSample] = payloads(driven, "speed_limit")
    assert [sample.reason for sample in samples[:9]] == ["stopping distance"] * 9
    assert samples[-1].reason == "latency"
    assert samples[-1].age_ms is not None
    assert samples[-1].limit_mps == pytest.approx(LIMITS.speed_limit_mps * 200 / samples[-1].age_ms)
    published = [(state.speed_limit_mps, state.speed_limit_reason) for state in states(driven)]
    assert published == [(sample.limit_mps, sample.reason) for sample in samples]
    stopped = bench.advance(NS_PER_S)
    assert states(stopped)[-1].safety == "safe_stop"
    assert states(stopped)[-1].speed_limit_reason is UNSET


def test_without_a_governor_states_and_records_have_no_speed_limit() -> None:
    """Without a speed governor nothing is recorded, and the JSON of a state in the record is the same as before."""
    bench = Bench().arm()
    bench.send_drive_command()
    sends = bench.advance(100 * NS_PER_MS)
    assert payloads(sends, "speed_limit") == []
    assert b"speed_limit" not in to_json(states(sends)[-1])
