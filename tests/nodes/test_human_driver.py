# ruff: noqa: D102 (a test bench with short methods)

from __future__ import annotations

import json
from itertools import repeat
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.nodes.stand_ins import MONO_NS, SMALL_CAMERA, WALL_NS, at, deliver, noise, payloads

from lavt.control.client_limits import CLIENT_LIMITS
from lavt.control.human_controls import HUMAN_LIMITS, HumanControls
from lavt.domain import NS_PER_MS, NS_PER_S, NS_PER_US, Command, SessionReply, SessionRequest, State
from lavt.node import WAKE, Message, Send
from lavt.nodes.client_session import ClientSession
from lavt.nodes.human_driver import COMMAND_GAP_NS, SEAT_NS, HumanDriverNode
from lavt.nodes.page_prediction import PagePredictor
from lavt.nodes.payloads import DecodedFrame, DelayChoice, ReceivedUnit, RelayDelay
from lavt.nodes.picture_reader import PictureReader
from lavt.runtime.pipeline import run_stages
from lavt.transport.messages import decode, encode
from lavt.transport.rtp.reception_stats import ReceptionSample
from lavt.transport.video.frame_codec import RenderedPicture, VideoReceiver
from lavt.transport.video.h264 import Decoder
from lavt.transport.video.stamp import rtp_timestamp

GRANTED = SessionReply(True, "", 5, bytes(range(16)), 5600, "kernel", 0)
STEP_NS = 20 * NS_PER_MS
DELAYS = DelayChoice((("L0", 0.0, 0.0), ("L3", 225.0, 0.0)), RelayDelay(0.0, 0.0))


class HumanBench:
    """A person's driver node with page 1, and methods that deliver what the page and the vehicle send."""

    def __init__(
        self,
        delays: DelayChoice | None = None,
        *,
        shows_latency: bool = True,
        predictor: PagePredictor | None = None,
    ) -> None:
        self.session = ClientSession("alice", 1, rearm=True, start_ns=MONO_NS)
        self.controls = HumanControls(wheelbase_m=2.8)
        self.node = HumanDriverNode(
            PictureReader(VideoReceiver(Decoder(), (SMALL_CAMERA.height_px, SMALL_CAMERA.width_px))),
            self.controls,
            self.session,
            CLIENT_LIMITS,
            delays,
            shows_latency=shows_latency,
            predictor=predictor,
        )
        self.mono_ns = 0
        self.opened = self.deliver("page_opened", None, peer=1)

    def deliver(self, channel: str, payload: object, *, peer: Any = None) -> list[Send]:
        return deliver(self.node, channel, payload, at(self.mono_ns), peer)

    def page(self, page: int = 1, **message: Any) -> list[Send]:
        """Deliver a message of a page."""
        return self.deliver("page_message", json.dumps(message), peer=page)

    def input(self, *, held: bool = True, live: bool = True, page: int = 1, age_ns: int = 0, **values: float) -> Any:
        """Let a step pass, deliver an input, and return the command that follows; None: no command."""
        self.mono_ns += STEP_NS
        seen_us = (at(self.mono_ns).mono_ns - age_ns) // NS_PER_US
        message = {"type": "input", "seen_us": seen_us, "held": held, "live": live}
        return command(self.page(page, **message, **{"steering": 0.0, "throttle": 0.0, "brake": 0.0, **values}))

    def show(self, page: int = 1, *, is_decoded_first: bool = True) -> int:
        """Deliver a keyframe that the page shows and this client decodes; return its stamp."""
        stamp_ns = WALL_NS + self.mono_ns
        self.deliver("access_unit", ReceivedUnit(b"", rtp_timestamp(stamp_ns), True, True, MONO_NS))
        view = DecodedFrame(stamp_ns, stamp_ns, RenderedPicture(noise(1)))
        ack = {"type": "ack", "unit": rtp_timestamp(stamp_ns)}
        if is_decoded_first:
            self.deliver("view", view)
        self.page(page, **ack)
        if not is_decoded_first:
            self.deliver("view", view)
        return stamp_ns

    def state(self, safety: str, speed_mps: float = 0.0, *, applied: int = -1) -> None:
        """Deliver a state of the vehicle."""
        mono_ns = at(self.mono_ns).mono_ns
        state = State(1, mono_ns, speed_mps, 0.0, "drive", safety, "why", applied, "")  # type: ignore[arg-type]
        self.deliver("state", encode(state))

    def grant(self) -> HumanBench:
        """Grant control, show a picture and return this bench."""
        self.deliver("session_reply", encode(GRANTED))
        self.show()
        return self

    def drive(self) -> HumanBench:
        """Arm the vehicle by a hand that holds, let it drive, and return this bench."""
        self.grant()
        self.input(held=False)
        assert self.input().mode == "arm"
        self.mono_ns += NS_PER_MS
        self.state("driving")
        assert self.input(throttle=0.5).mode == "drive"
        return self

    def wake(self, after_ns: int) -> list[Send]:
        self.mono_ns += after_ns
        return self.deliver(WAKE, None)

    def status(self, page: int = 1) -> dict[str, Any]:
        """Return the next status of a page."""
        sends = self.wake(50 * NS_PER_MS)
        (text,) = [send.payload for send in sends if (send.channel, send.peer) == ("page_status", page)]
        status: dict[str, Any] = json.loads(text)
        return status


def reception(packets: int, recovered: int, lost: int) -> ReceptionSample:
    """Return a sample of a second in which packets arrived, and others were recovered or lost."""
    return ReceptionSample(NS_PER_S, packets, recovered + lost, recovered, lost, 0, 0, 0, 0, None)


def command(sends: list[Send]) -> Command | None:
    commands = [decode(Command, payload) for payload in payloads(sends, "control")]
    assert len(commands) <= 1
    return commands[0] if commands else None


def test_a_person_arms_by_holding_and_drives() -> None:
    """Without a hold nothing is commanded; a hold after an open hand arms; then inputs drive with the shown stamp."""
    bench = HumanBench().grant()
    assert bench.input() is None
    assert bench.input(held=False) is None
    arm = bench.input(steering=1.0)
    assert (arm.mode, arm.throttle, arm.brake, arm.steering_rad) == ("arm", 0, 1, 0)
    bench.state("driving")
    stamp_ns = bench.show()
    drive = bench.input(throttle=0.5, steering=1.0)
    assert (drive.mode, drive.throttle, drive.stamp_ns, drive.epoch) == ("drive", 0.5, stamp_ns, 5)
    assert drive.steering_rad == HUMAN_LIMITS.steering_limit_rad


def test_arming_needs_a_released_throttle() -> None:
    """A hand that holds with the throttle pressed does not arm."""
    bench = HumanBench().grant()
    bench.input(held=False)
    assert bench.input(throttle=0.5) is None
    assert bench.input().mode == "arm"


def test_without_control_nothing_is_commanded() -> None:
    """Before control is granted, a hand that holds commands nothing."""
    bench = HumanBench()
    bench.show()
    bench.input(held=False)
    assert bench.input() is None


def test_a_released_hand_stops_the_vehicle() -> None:
    """If the hand opens while driving, the next command requests a stop."""
    bench = HumanBench().drive()
    stop = bench.input(held=False, throttle=1.0)
    assert (stop.mode, stop.throttle, stop.brake) == ("stop", 0, 1)


@pytest.mark.parametrize("loss", ["hidden", "old", "silent", "closed"])
def test_a_lost_page_commands_nothing(loss: str) -> None:
    """If the page is hidden, old, silent or closed, no command is sent: the vehicle's own stages stop it."""
    bench = HumanBench().drive()
    match loss:
        case "hidden":
            assert bench.input(live=False, throttle=1.0) is None
        case "old":
            assert bench.input(throttle=1.0, age_ns=HUMAN_LIMITS.lock_after_ns + NS_PER_MS) is None
        case "silent":
            bench.wake(HUMAN_LIMITS.lock_after_ns)
        case "closed":
            bench.deliver("page_closed", None, peer=1)
    sends = [bench.wake(STEP_NS) for _ in range(20)]
    assert [command(each) for each in sends] == [None] * 20
    if loss != "closed":
        assert bench.input(throttle=1.0) is None
        assert bench.input(held=False).mode == "stop"


def test_a_silent_page_drives_no_longer_than_the_timeout() -> None:
    """The last input is repeated until the timeout, and not after it."""
    bench = HumanBench().drive()
    is_sent = [command(bench.wake(10 * NS_PER_MS)) is not None for _ in range(50)]
    after = HUMAN_LIMITS.input_timeout_ns // (10 * NS_PER_MS) - 1
    assert any(is_sent[after - 3 : after])
    assert not any(is_sent[after:])


def test_the_stamp_is_that_of_the_newest_picture_shown() -> None:
    """A picture that the page has not shown changes no command, whichever of page and client is faster."""
    bench = HumanBench().drive()
    shown_ns = bench.show(is_decoded_first=False)
    assert bench.input().stamp_ns == shown_ns
    stamp_ns = WALL_NS + bench.mono_ns
    bench.deliver("access_unit", ReceivedUnit(b"", rtp_timestamp(stamp_ns), True, True, MONO_NS))
    bench.deliver("view", DecodedFrame(stamp_ns, stamp_ns, RenderedPicture(noise(1))))
    assert bench.input().stamp_ns == shown_ns
    bench.page(type="ack", unit=7)
    assert bench.input().stamp_ns == shown_ns


def test_a_page_that_shows_nothing_brakes_and_stops() -> None:
    """Without a newly shown picture, the client brakes after 300 ms and stops after 2.5 s."""
    bench = HumanBench().drive()
    bench.show()
    shown_ns, modes = bench.mono_ns, {}
    for _ in range(150):
        new = bench.input(throttle=0.5)
        bench.state("driving", 5.0)
        modes[bench.mono_ns - shown_ns] = (new.mode, new.brake > 0)
    assert all(what == ("drive", False) for age_ns, what in modes.items() if age_ns < 250 * NS_PER_MS)
    assert all(what[1] for age_ns, what in modes.items() if age_ns > CLIENT_LIMITS.no_picture_brake_ns + 50 * NS_PER_MS)
    assert modes[max(modes)] == ("stop", True)


def test_access_units_go_to_the_page_before_they_are_decoded() -> None:
    """An access unit is sent to the page, undecoded, before it is decoded here."""
    bench = HumanBench()
    assert payloads(bench.opened, "picture_lost") == [None]
    sends = bench.deliver("access_unit", ReceivedUnit(b"\x00\x00\x01", 77, True, True, MONO_NS))
    assert [send.channel for send in sends] == ["page_unit", "unit_to_decode"]
    assert sends[0].payload.endswith(b"\x00\x00\x01")
    assert sends[0].peer == 1


def test_a_stalled_page_gets_a_keyframe_when_it_continues() -> None:
    """A page that has acknowledged nothing gets three units; when it answers, a keyframe is requested."""
    bench = HumanBench()
    units = [ReceivedUnit(b"", number, True, number == 0, MONO_NS) for number in range(6)]
    sent = [bool(payloads(bench.deliver("access_unit", unit), "page_unit")) for unit in units]
    assert sent == [True, True, True, False, False, False]
    assert payloads(bench.page(type="ack", unit=2), "picture_lost") == [None]
    assert payloads(bench.page(type="lost"), "picture_lost") == [None]


def test_a_second_page_watches_only() -> None:
    """A second page gets the video; its inputs are counted and command nothing; it can drive when the first is gone."""
    bench = HumanBench().drive()
    bench.deliver("page_opened", None, peer=2)
    assert bench.status(2)["role"] == "watches"
    assert not bench.status(2)["can_drive"]
    assert bench.input(page=2, held=False) is None
    assert bench.input(page=2, throttle=1.0) is None
    bench.page(2, type="drive")
    assert bench.status(1)["role"] == "drives"
    assert bench.node.counts["inputs_without_control"] == 2
    bench.deliver("page_closed", None, peer=1)
    assert bench.status(2)["can_drive"]
    assert bench.input(page=2) is None
    bench.page(2, type="drive")
    assert bench.status(2)["role"] == "drives"
    bench.show(2)
    assert bench.input(page=2) is None
    assert bench.input(page=2, held=False).mode == "stop"


def test_a_frozen_page_does_not_keep_the_seat() -> None:
    """A page that has sent nothing for seconds stays connected, but another page can drive, after an open hand."""
    bench = HumanBench().drive()
    bench.deliver("page_opened", None, peer=2)
    bench.wake(SEAT_NS - NS_PER_S)
    assert not bench.status(2)["can_drive"]
    bench.wake(NS_PER_S)
    assert bench.status(2)["can_drive"]
    bench.page(2, type="drive")
    assert (bench.status(1)["role"], bench.status(2)["role"]) == ("watches", "drives")
    bench.show(2)
    assert bench.input(throttle=1.0) is None
    assert bench.input(page=2) is None
    assert bench.input(page=2, held=False).mode == "stop"


def test_a_burst_of_inputs_is_no_burst_of_commands() -> None:
    """Inputs that arrive at once cause one command, and then one with the newest input."""
    bench = HumanBench().drive()
    bench.input()
    seen_us = at(bench.mono_ns).mono_ns // NS_PER_US
    values: dict[str, Any] = {"held": True, "live": True, "steering": 0.0, "brake": 0.0}
    burst = [bench.page(type="input", seen_us=seen_us, throttle=each / 10, **values) for each in range(10)]
    assert [command(sends) for sends in burst] == [None] * 10
    newest = command(bench.wake(COMMAND_GAP_NS))
    assert newest is not None
    assert newest.throttle == 0.9


@pytest.mark.parametrize("page", [1, 2])
def test_any_page_makes_an_emergency_stop(page: int) -> None:
    """The emergency stop of a page, driving or watching, is sent as a request and is in every later command."""
    bench = HumanBench().drive()
    bench.deliver("page_opened", None, peer=2)
    sends = bench.page(page, type="stop")
    (request,) = [decode(SessionRequest, payload) for payload in payloads(sends, "session")]
    assert request.operation == "emergency_stop"
    stop = command(sends)
    assert stop is not None
    assert (stop.mode, stop.brake, stop.emergency_stop) == ("stop", 1, request.number)
    assert payloads(bench.page(page, type="stop"), "session") == []
    assert bench.status()["emergency_stop"] == "sent"
    bench.deliver("session_reply", encode(SessionReply(True, "", 0, b"", 5600, "kernel", request.number)))
    assert bench.status()["emergency_stop"] == "confirmed"


def test_a_stop_is_not_swallowed_by_an_old_state() -> None:
    """A stop that the vehicle has confirmed is not requested twice, except after the vehicle's state is old."""
    bench = HumanBench().drive()
    (request,) = [decode(SessionRequest, each) for each in payloads(bench.page(type="stop"), "session")]
    bench.deliver("session_reply", encode(SessionReply(True, "", 0, b"", 5600, "kernel", request.number)))
    bench.mono_ns += NS_PER_MS
    bench.state("emergency_stop")
    assert payloads(bench.page(type="stop"), "session") == []
    bench.mono_ns += NS_PER_S
    (again,) = [decode(SessionRequest, each) for each in payloads(bench.page(type="stop"), "session")]
    assert again.operation == "emergency_stop"
    assert again.number != request.number


def test_after_the_page_is_closed_commands_still_carry_the_stop() -> None:
    """When the page is closed after an emergency stop, each later command still has the stop's number."""
    bench = HumanBench().drive()
    (request,) = [decode(SessionRequest, each) for each in payloads(bench.page(type="stop"), "session")]
    bench.deliver("page_closed", None, peer=1)
    later = [command(bench.wake(CLIENT_LIMITS.command_period_ns)) for _ in range(5)]
    assert [new and (new.mode, new.emergency_stop) for new in later] == [("stop", request.number)] * 5


def test_the_driving_page_hands_over() -> None:
    """The driving page releases control, as SIGUSR2 does, and another page cannot."""
    bench = HumanBench().drive()
    bench.deliver("page_opened", None, peer=2)
    assert bench.page(2, type="release") == []
    (request,) = [decode(SessionRequest, payload) for payload in payloads(bench.page(type="release"), "session")]
    assert request.operation == "release"
    assert bench.input(throttle=1.0) is None
    assert (bench.status()["phase"], bench.status()["session_reason"]) == ("watching", "released")


def test_after_a_safe_stop_a_fresh_press_arms_again() -> None:
    """After a safe stop, at standstill, the vehicle is armed again only by a hand that opens and holds."""
    bench = HumanBench().drive()
    bench.mono_ns += NS_PER_MS
    bench.state("safe_stop", 3.0)
    assert bench.input() is None
    bench.mono_ns += NS_PER_MS
    bench.state("safe_stop", 0.0)
    bench.mono_ns += NS_PER_MS
    bench.state("safe_stop", 0.0)
    assert bench.session.phase == "seeking"
    bench.grant()
    assert bench.input(held=False) is None
    assert bench.input().mode == "arm"


def test_a_hold_that_lasts_through_a_stop_does_not_arm() -> None:
    """A hand that has held since before the vehicle stopped by itself arms nothing; a fresh press does."""
    bench = HumanBench().drive()
    for speed_mps in (3.0, 0.0, 0.0):
        bench.mono_ns += NS_PER_MS
        bench.state("safe_stop", speed_mps)
    assert bench.session.phase == "seeking"
    bench.grant()
    assert [bench.input() for _ in range(5)] == [None] * 5
    assert bench.status()["hand"] == "not_seen"
    assert bench.input(held=False) is None
    assert bench.input().mode == "arm"


def test_the_status_has_state_delays_and_round_trip() -> None:
    """The status reports the vehicle's state, the hand, the last command and the round trip of a command."""
    bench = HumanBench(DELAYS).drive()
    sequence = bench.input(throttle=0.5).sequence
    bench.mono_ns += 7 * NS_PER_MS
    bench.state("driving", 4.0, applied=sequence)
    status = bench.status()
    assert (status["safety"], status["reason"], status["speed_mps"]) == ("driving", "why", 4.0)
    assert (status["hand"], status["phase"], status["command"][1]) == ("held", "driving", 0.5)
    assert status["round_trip_ms"] == 7.0
    bench.deliver("access_unit", ReceivedUnit(bytes(1000), 1, True, False, MONO_NS))
    assert (bench.status()["bit_rate_bps"], bench.wake(NS_PER_S) and bench.status()["bit_rate_bps"]) == (8000, 0)
    assert status["conditions"] == [list(condition) for condition in DELAYS.conditions]
    assert status["delay"] == [0.0, 0.0]


@pytest.mark.parametrize(("shows_latency", "reason"), [(True, "latency"), (False, "")])
def test_the_status_has_the_speed_limit_of_the_vehicle(*, shows_latency: bool, reason: str) -> None:
    """A person sees the speed limit of the vehicle; its reason is hidden with the latencies."""
    bench = HumanBench(shows_latency=shows_latency).drive()
    mono_ns = at(bench.mono_ns).mono_ns
    state = State(1, mono_ns, 4.0, 0.0, "drive", "driving", "why", -1, "", "", "", 0, "", 0, 4.5, "latency")
    bench.deliver("state", encode(state))
    assert (bench.status()["speed_limit_mps"], bench.status()["speed_limit_reason"]) == (4.5, reason)


def test_the_status_has_the_share_of_lost_packets() -> None:
    """The share is of the packets that were due in the newest sample; it is null at first, and if none was due."""
    bench = HumanBench()
    assert bench.status()["lost_share"] is None
    for packets, recovered, lost, share in ((94, 4, 2, 0.02), (50, 0, 0, 0.0), (0, 0, 0, None)):
        bench.deliver("video_reception", reception(packets, recovered, lost))
        assert bench.status()["lost_share"] == share


@pytest.mark.parametrize("shows_latency", [True, False])
def test_a_page_that_shows_no_latency_gets_none(*, shows_latency: bool) -> None:
    """Without `shows_latency` the status has no latency and no losses, although they are known, and says so."""
    bench = HumanBench(shows_latency=shows_latency).drive()
    bench.mono_ns += 7 * NS_PER_MS
    bench.state("driving", applied=1)
    bench.deliver("video_reception", reception(90, 0, 10))
    status = bench.status()
    known = [status[name] is not None for name in ("video_ms", "round_trip_ms", "lost_share")]
    assert (status["shows_latency"], known) == (shows_latency, [shows_latency] * 3)


def test_only_the_driving_page_of_a_client_with_a_relay_changes_delays() -> None:
    """The delays that the driving page chooses are sent to the relay; other requests are counted."""
    bench = HumanBench(DELAYS)
    bench.deliver("page_opened", None, peer=2)
    chosen = {"type": "delay", "video_ms": 225, "control_ms": 10.5}
    assert payloads(bench.page(1, **chosen), "relay_delay") == [RelayDelay(225, 10.5)]
    assert bench.status()["delay"] == [225, 10.5]
    assert bench.page(2, **chosen) == []
    without_relay = HumanBench()
    assert without_relay.page(1, **chosen) == []
    assert (bench.node.counts["delays_rejected"], without_relay.node.counts["delays_rejected"]) == (1, 1)
    assert without_relay.status()["delay"] is None


def test_the_record_has_the_inputs_and_the_loss_of_the_hand() -> None:
    """Each input of the driving page is recorded with the state of the hand, and so is a loss without an input."""
    bench = HumanBench().drive()
    bench.mono_ns += STEP_NS
    sends = bench.page(
        type="input", seen_us=at(bench.mono_ns).mono_ns // 1000, held=True, live=True, steering=0.5, throttle=1, brake=0
    )
    (sample,) = payloads(sends, "human_input")
    assert (sample.hand, sample.steering, sample.throttle) == ("held", 0.5, 1.0)
    (loss,) = payloads(bench.wake(NS_PER_S), "human_input")
    assert loss.hand == "no_input"


def test_the_times_of_a_shown_picture_are_recorded() -> None:
    """The page's times are recorded on the client's wall clock; a stamp that the page has read differently is not."""
    bench = HumanBench()
    stamp_ns = bench.show()
    page_us = [stamp_ns // NS_PER_US + late_us for late_us in (2000, 3000, 3500, 9000)]
    names = ("arrived_us", "decoded_us", "drawn_us", "shown_us")
    message: dict[str, Any] = {"type": "shown", "unit": rtp_timestamp(stamp_ns), "offset_us": -500.5, "bound_us": 120.0}
    message |= dict(zip(names, page_us, strict=True))
    (picture,) = payloads(bench.page(**message, stamp=str(stamp_ns)), "page_picture")
    late_ns = [picture.arrived_wall_ns, picture.decoded_wall_ns, picture.drawn_wall_ns, picture.shown_wall_ns]
    assert [(time_ns - stamp_ns) / NS_PER_US for time_ns in late_ns] == [1499.5, 2499.5, 2999.5, 8499.5]
    assert (picture.stamp_ns, picture.bound_ns) == (stamp_ns, 120_000)
    assert bench.page(**message, stamp=str(stamp_ns + 1)) == []
    assert bench.page(**{**message, "unit": 5}, stamp=str(stamp_ns)) == []
    assert (bench.node.counts["page_stamps_true"], bench.node.counts["page_stamps_false"]) == (1, 1)


def test_a_probe_is_answered_with_the_clients_clock() -> None:
    """The answer to a probe has its send time, and when the client got and answered it."""
    bench = HumanBench()
    message = Message("page_message", '{"type": "probe", "sent_us": 7}', at(5000), 1)
    stages = bench.node.pipelines["page_message"]
    (send,) = run_stages("driver", stages, message, at(9000), repeat(at(9000))).sends
    wall_us = WALL_NS // NS_PER_US
    answer = {"type": "probe", "sent_us": 7, "received_us": wall_us + 5, "answered_us": wall_us + 9}
    assert (json.loads(send.payload), send.peer) == (answer, 1)


messages = st.text() | st.binary() | st.recursive(st.none() | st.floats(), st.lists).map(json.dumps)


@settings(max_examples=30)  # each needs a decoder
@given(st.lists(st.tuples(messages, st.sampled_from([1, 2, 3])), max_size=20))
def test_bytes_of_a_page_never_raise(received: list[tuple[str | bytes, int]]) -> None:
    """Whatever pages send, known or not, is counted and dropped, and drives nothing."""
    bench = HumanBench().grant()
    for data, page in received:
        assert bench.deliver("page_message", data, peer=page) == []
    assert bench.node.counts.get("page_messages_unreadable", 0) == sum(page == 1 for _, page in received)
