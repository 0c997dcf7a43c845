# ruff: noqa: D102 (a test bench with short methods)

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from tests.nodes.stand_ins import MONO_NS, SMALL_CAMERA, WALL_NS, at, deliver, noise, payloads

from lavt.channels import CHANNELS
from lavt.control.client_limits import CLIENT_LIMITS
from lavt.control.drive_controller import DriveController, make_controller
from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.control.loop_history import LoopHistory
from lavt.control.preset import DESIGNED
from lavt.domain import (
    NS_PER_MS,
    NS_PER_S,
    CameraModel,
    Command,
    Decision,
    Lane,
    Now,
    Picture,
    SessionReply,
    SessionRequest,
    State,
)
from lavt.node import WAKE, Send
from lavt.nodes.client_session import ClientSession
from lavt.nodes.driver import DriverNode
from lavt.nodes.payloads import DecodedFrame, PathToken, PictureRead, ReceivedUnit
from lavt.nodes.picture_reader import PictureReader
from lavt.perception.lane_detector import LONGEST_GAP_NS, LaneDetector
from lavt.transport.messages import decode, encode
from lavt.transport.video.frame_codec import RenderedPicture, VideoReceiver
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.transport.video.stamp import rtp_timestamp, write_stamp

FRAME_NS = NS_PER_S // 30
GRANTED = SessionReply(True, "", 5, bytes(range(16)), 5600, "kernel", 0)


@dataclass
class FakeLaneDetector:
    """A fake `LaneDetector` that returns a straight lane with a given confidence."""

    confidence: float = 1.0
    offset_m: float = 0.0
    pictures: list[Picture] = field(default_factory=list)
    forget_calls: int = 0

    def forget(self) -> None:
        """Count the call."""
        self.forget_calls += 1

    def detect(self, picture_bgr: Picture) -> Lane:
        """Return the lane."""
        self.pictures.append(picture_bgr)
        return Lane(centre=(self.offset_m, 0.0, 0.0), width_m=3.5, near_m=3.6, far_m=20.0, confidence=self.confidence)


class FakeController:
    """A fake `DriveController` that always returns the same decision."""

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:  # noqa: ARG002 (the protocol's)
        """Return the decision."""
        return Decision(0.125, 0.5, 0.0, (0.0,) * 10)


@dataclass
class StampedController(FakeController):
    """A fake controller that also reads stamps; it stores the stamps that it got."""

    stamps_ns: list[int] = field(default_factory=list)

    def note_stamp(self, stamp_ns: int) -> None:
        """Store the stamp."""
        self.stamps_ns.append(stamp_ns)


@dataclass
class HistoryController(FakeController):
    """A fake controller that also reads what the node notes of its loop."""

    history: LoopHistory = field(default_factory=LoopHistory)


class Bench:
    """A driver node, with methods that deliver the messages of the vehicle's side."""

    def __init__(
        self,
        detector: LaneDetector | None = None,
        controller: DriveController | None = None,
        lane_confidence: float = LANE_CONFIDENCE,
    ) -> None:
        self.controller = controller or FakeController()
        self.detector = FakeLaneDetector()
        self.session = ClientSession("alice", 1, rearm=False, start_ns=MONO_NS)
        self.node = DriverNode(
            PictureReader(VideoReceiver(Decoder(), (SMALL_CAMERA.height_px, SMALL_CAMERA.width_px))),
            detector or self.detector,
            self.controller,
            self.session,
            CLIENT_LIMITS,
            lane_confidence=lane_confidence,
        )
        self.mono_ns = 0
        self.sends: list[Send] = []

    def deliver(self, channel: str, payload: object) -> list[Send]:
        sends = deliver(self.node, channel, payload, at(self.mono_ns))
        self.sends += sends
        return sends

    def deliver_picture(self, picture: Picture | None = None) -> list[Command]:
        """Deliver a decoded picture to perception, and return the commands that the node sends."""
        rendered = RenderedPicture(noise(1) if picture is None else picture)
        frame = DecodedFrame(WALL_NS + self.mono_ns, WALL_NS + self.mono_ns, rendered)
        return commands(self.deliver("view", frame))

    def advance(self, duration_ns: int) -> list[tuple[int, Command]]:
        """Let time pass, wake the node whenever it is due, and return its commands with their times."""
        end_ns, timed_commands = self.mono_ns + duration_ns, []
        while (wake_ns := self.node.next_wake_ns()) is not None and wake_ns - MONO_NS <= end_ns:
            self.mono_ns = max(self.mono_ns, wake_ns - MONO_NS)
            timed_commands += [(self.mono_ns, command) for command in commands(self.deliver(WAKE, None))]
        self.mono_ns = end_ns
        return timed_commands

    def deliver_state(
        self, safety: str, speed_mps: float = 0.0, *, vehicle_ns: int | None = None, instance: int = 0
    ) -> None:
        """Deliver a state, whose time on the vehicle's clock is `vehicle_ns`, or the present time."""
        mono_ns = at(self.mono_ns).mono_ns if vehicle_ns is None else vehicle_ns
        state = State(1, mono_ns, speed_mps, 0.0, "drive", safety, "", -1, "", instance=instance)  # type: ignore[arg-type]
        self.deliver("state", encode(state))

    def start_driving(self) -> Bench:
        """Grant control, report that the vehicle drives, and return this bench."""
        self.deliver("session_reply", encode(GRANTED))
        self.deliver_state("driving")
        assert self.deliver_picture()
        return self


def commands(sends: list[Send]) -> list[Command]:
    return [decode(Command, payload) for payload in payloads(sends, "control")]


def encode_unit(picture: Picture, stamp_ns: int, rtp_ns: int | None = None) -> ReceivedUnit:
    """Stamp and encode a picture; the access unit's RTP timestamp is that of `rtp_ns`, or of the stamp."""
    height_px, width_px, _ = picture.shape
    encoder = Encoder(width_px, height_px, rate_hz=30, bit_rate_bps=4_000_000, gop_frames=30)
    picture = picture.copy()
    write_stamp(picture, stamp_ns)
    data = encoder.encode(picture)
    return ReceivedUnit(data, rtp_timestamp(stamp_ns if rtp_ns is None else rtp_ns), True, True, MONO_NS)


def picture_entry(sends: list[Send]) -> PictureRead:
    (picture,) = payloads(sends, "picture")
    assert isinstance(picture, PictureRead)
    return picture


def test_a_picture_is_decoded_and_viewed() -> None:
    """A received access unit is decoded, its stamp is read, and the picture is sent on to perception."""
    bench = Bench()
    sends = bench.deliver("access_unit", encode_unit(noise(1), WALL_NS + 17))
    assert (picture_entry(sends).stamp_ns, picture_entry(sends).readable, picture_entry(sends).in_doubt) == (
        WALL_NS + 17,
        True,
        False,
    )
    (view,) = payloads(sends, "view")
    assert view.stamp_ns == WALL_NS + 17
    assert picture_entry(sends).decoded
    assert bench.node.counts["frames_decoded"] == 1


def test_only_the_newest_picture_waits_for_perception() -> None:
    """All access units wait, because each refers to the one before; of the decoded pictures only the newest waits."""
    assert CHANNELS["access_unit"].waiting == "queue"
    assert CHANNELS["view"].waiting == "newest"


def test_a_stamp_that_disagrees_with_its_packets_is_never_used() -> None:
    """A picture whose stamp disagrees with its RTP timestamp is unreadable and not used."""
    bench = Bench()
    sends = bench.deliver("access_unit", encode_unit(noise(1), WALL_NS, rtp_ns=WALL_NS + NS_PER_MS))
    assert (picture_entry(sends).stamp_ns, picture_entry(sends).readable) == (None, False)
    assert picture_entry(sends).decoded
    assert "RTP timestamp" in picture_entry(sends).reason
    assert payloads(sends, "view") == []
    assert bench.node.counts["frames_unreadable"] == 1


def test_a_picture_of_another_size_is_counted_and_not_used() -> None:
    """A picture of another size than configured is unreadable and not used."""
    bench = Bench()
    sends = bench.deliver("access_unit", encode_unit(noise(1, CameraModel(160, 128)), WALL_NS))
    assert "160 x 128" in picture_entry(sends).reason
    assert payloads(sends, "view") == []


def test_an_access_unit_without_a_picture() -> None:
    """An access unit without a picture is reported to the receiver and puts later pictures in doubt."""
    bench = Bench()
    unit = ReceivedUnit(b"\x00\x00\x00\x01\x65garbage", 0, False, True, MONO_NS)
    sends = bench.deliver("access_unit", unit)
    assert payloads(sends, "picture_lost") == [None]
    assert picture_entry(sends).in_doubt
    assert not picture_entry(sends).decoded
    assert not picture_entry(bench.deliver("access_unit", encode_unit(noise(1), WALL_NS))).in_doubt


def test_request_control_arm_and_drive() -> None:
    """The driver requests control, arms with the brake applied, and drives once the vehicle is driving."""
    bench = Bench()
    assert bench.deliver_picture() == []
    bench.advance(0)
    assert len(payloads(bench.sends, "session")) == 1
    sends = bench.deliver("session_reply", encode(GRANTED))
    assert payloads(sends, "path_token") == [PathToken(GRANTED.token, 5600)]
    (arm,) = bench.deliver_picture()
    assert (arm.mode, arm.epoch, arm.throttle, arm.brake, arm.steering_rad) == ("arm", 5, 0.0, 1.0, 0.0)
    bench.deliver_state("driving")
    (drive,) = bench.deliver_picture()
    assert (drive.mode, drive.throttle, drive.brake, drive.steering_rad) == ("drive", 0.5, 0.0, 0.125)
    assert drive.sequence > arm.sequence
    assert drive.stamp_ns == WALL_NS


def test_perception_has_memory_only_while_driving() -> None:
    """Before the drive, each picture is detected without memory of earlier ones."""
    bench = Bench()
    bench.deliver_picture()
    bench.deliver_picture()
    assert bench.detector.forget_calls == 2
    bench.start_driving()
    calls_before = bench.detector.forget_calls
    bench.deliver_picture()
    assert bench.detector.forget_calls == calls_before


def test_a_command_is_sent_every_20_ms_between_pictures() -> None:
    """Between pictures a command is sent every 20 ms, with the stamp of the newest picture."""
    bench = Bench().start_driving()
    timed_commands = bench.advance(100 * NS_PER_MS)
    assert [at_ns for at_ns, _ in timed_commands] == [number * 20 * NS_PER_MS for number in range(1, 6)]
    assert len({command.sequence for _, command in timed_commands}) == 5
    assert {command.stamp_ns for _, command in timed_commands} == {WALL_NS}


def test_without_pictures_the_driver_brakes_after_300_ms_and_stops_after_2500_ms() -> None:
    """Without a new picture the driver brakes after 300 ms and requests a stop after 2.5 s."""
    bench = Bench().start_driving()
    timed_commands = bench.advance(2600 * NS_PER_MS)
    for at_ns, command in timed_commands:
        mode = "stop" if at_ns >= 2500 * NS_PER_MS else "drive"
        assert command.mode == mode
        assert (command.throttle == 0) == (at_ns >= 300 * NS_PER_MS)
        assert (command.brake >= CLIENT_LIMITS.brake) == (at_ns >= 300 * NS_PER_MS)
    assert timed_commands[-1][1].mode == "stop"


@pytest.mark.parametrize(
    ("lost_ms", "mode", "brakes"), [(280, "drive", False), (300, "drive", True), (2500, "stop", True)]
)
def test_without_states_the_driver_brakes_and_stops(lost_ms: int, mode: str, *, brakes: bool) -> None:
    """Without a new state the driver brakes after 300 ms and requests a stop after 2.5 s."""
    bench = Bench().start_driving()
    for _ in range(lost_ms // 20):
        bench.mono_ns += 20 * NS_PER_MS
        (command,) = bench.deliver_picture()
    assert command.mode == mode
    assert (command.brake >= CLIENT_LIMITS.brake) == brakes
    assert (command.throttle == 0.0) == brakes


@pytest.mark.parametrize(
    ("lost_ms", "mode", "brakes"), [(280, "drive", False), (300, "drive", True), (2500, "stop", True)]
)
@pytest.mark.parametrize("going_back_ns", [0, NS_PER_MS])
def test_a_repeated_state_is_no_newer_state(lost_ms: int, mode: str, going_back_ns: int, *, brakes: bool) -> None:
    """States whose vehicle time does not grow are not new: the driver brakes, and requests a stop after 2.5 s."""
    bench = Bench().start_driving()
    for number in range(lost_ms // 20):
        bench.mono_ns += 20 * NS_PER_MS
        bench.deliver_state("driving", vehicle_ns=MONO_NS - number * going_back_ns)
        (command,) = bench.deliver_picture()
    assert command.mode == mode
    assert (command.brake >= CLIENT_LIMITS.brake) == brakes
    assert bench.node.counts["states_not_newer"] == lost_ms // 20


def test_a_repeated_state_still_reports_the_safety_state() -> None:
    """A stop ends the drive at the client even if the state that reports it is not new."""
    bench = Bench().start_driving()
    bench.deliver_state("safe_stop", vehicle_ns=MONO_NS)
    assert bench.session.phase == "stopped"


def test_the_time_of_a_restarted_server_begins_anew() -> None:
    """The first state of another server process is new, whatever its vehicle time."""
    bench = Bench().start_driving()
    bench.mono_ns += 280 * NS_PER_MS
    bench.deliver_state("driving", vehicle_ns=1, instance=2)
    bench.mono_ns += 280 * NS_PER_MS
    (command,) = bench.deliver_picture()
    assert command.brake < CLIENT_LIMITS.brake


@pytest.mark.parametrize("kind", ["any", "lane_keeper", "two_point"])
@pytest.mark.parametrize(
    ("lost_ms", "mode", "brakes"), [(480, "drive", False), (520, "drive", True), (2520, "stop", True)]
)
def test_without_a_lane_the_driver_brakes_and_stops(lost_ms: int, mode: str, kind: str, *, brakes: bool) -> None:
    """Without a lane the driver brakes after 0.5 s and requests a stop after 2.5 s, with every controller."""
    controller = None if kind == "any" else make_controller(kind, DESIGNED, 2.8448)
    bench = Bench(controller=controller).start_driving()
    bench.detector.confidence = 0.0
    for _ in range(lost_ms // 20):
        bench.mono_ns += 20 * NS_PER_MS
        bench.deliver_state("driving")
        (command,) = bench.deliver_picture()
    assert command.mode == mode
    assert (command.brake >= CLIENT_LIMITS.brake) == brakes


@pytest.mark.parametrize("kind", ["lane_keeper", "two_point"])
def test_a_lane_that_is_not_finite_is_no_lane(kind: str) -> None:
    """A confident lane that is not a number is counted and treated as lost: the driver brakes and requests a stop."""
    bench = Bench(controller=make_controller(kind, DESIGNED, 2.8448)).start_driving()
    bench.detector.offset_m = math.nan
    for _ in range(2520 // 20):
        bench.mono_ns += 20 * NS_PER_MS
        bench.deliver_state("driving")
        (command,) = bench.deliver_picture()
        assert math.isfinite(command.steering_rad)
    assert command.mode == "stop"
    assert bench.node.counts["lanes_not_finite"] == 2520 // 20


@pytest.mark.parametrize(("lane_confidence", "mode"), [(0.2, "drive"), (0.5, "stop")])
def test_the_threshold_decides_whether_a_lane_is_lost(lane_confidence: float, mode: str) -> None:
    """With lanes of confidence 0.4 for 2.52 s, the driver drives at a threshold of 0.2 and stops at 0.5."""
    bench = Bench(lane_confidence=lane_confidence).start_driving()
    bench.detector.confidence = 0.4
    for _ in range(2520 // 20):
        bench.mono_ns += 20 * NS_PER_MS
        bench.deliver_state("driving")
        (command,) = bench.deliver_picture()
    assert command.mode == mode


def test_a_controller_that_reads_stamps_gets_the_stamp_of_each_picture() -> None:
    """A controller with `note_stamp` gets the picture's stamp before its lane."""
    bench = Bench(controller=StampedController()).start_driving()
    stamps_ns = [WALL_NS + bench.mono_ns]
    for _ in range(2):
        bench.mono_ns += FRAME_NS
        bench.deliver_picture()
        stamps_ns.append(WALL_NS + bench.mono_ns)
    assert isinstance(bench.controller, StampedController)
    assert bench.controller.stamps_ns == stamps_ns


def test_a_controller_with_a_history_gets_commands_and_states() -> None:
    """The history of a controller has the commands sent and the states while this client has control."""
    controller = HistoryController()
    bench = Bench(controller=controller).start_driving()
    bench.mono_ns += 20 * NS_PER_MS
    bench.deliver_state("driving", 3.0)
    assert [motion.speed_mps for motion in controller.history.motions(0)] == [0.0, 3.0]
    (first, *_) = controller.history.commands(5, 0)
    assert (first.at_ns, first.steering_rad) == (MONO_NS + 5, 0.125)
    bench.deliver("operator", "release")
    bench.mono_ns += 20 * NS_PER_MS
    bench.deliver_state("driving", 4.0)
    assert controller.history.motions(0) == []


def test_grey_pictures_lead_to_a_stop() -> None:
    """With the real lane detector, grey pictures make the driver request a stop after 2.5 s."""
    bench = Bench(LaneDetector(CameraModel()))
    bench.deliver("session_reply", encode(GRANTED))
    bench.deliver_state("driving")
    grey = np.full((480, 640, 3), 128, np.uint8)
    modes = []
    for _ in range(77):  # 2.57 s
        modes += [command.mode for command in bench.deliver_picture(grey)]
        bench.mono_ns += FRAME_NS
    assert (modes[0], modes[-1]) == ("drive", "stop")


def test_garbage_from_the_vehicle_is_counted() -> None:
    """Unreadable states and replies are counted and have no effect."""
    bench = Bench().start_driving()
    for data in (b"", b"\xc1", b"\x93\x01\x02\x03", bytes(2000)):
        assert bench.deliver("state", data) == []
        assert bench.deliver("session_reply", data) == []
    assert bench.node.counts["states_unreadable"] == 4
    assert bench.node.counts["session_replies_unreadable"] == 4
    assert bench.session.phase == "driving"


def test_after_any_reply_an_emergency_stop_is_readable() -> None:
    """After any readable reply, the next emergency stop is a readable message."""
    for last_number in (2**62, 2**62 + 1, 2**63 - 1):
        bench = Bench().start_driving()
        bench.deliver("session_reply", encode(replace(GRANTED, emergency_stop=last_number)))
        sends = bench.deliver("operator", "emergency_stop")
        assert decode(SessionRequest, payloads(sends, "session")[0]).operation == "emergency_stop"
        assert commands(sends)[0].emergency_stop > 0


@given(st.binary(max_size=300))
def test_any_bytes_are_survived(data: bytes) -> None:
    """No bytes on any external channel raise an exception."""
    bench = Bench()
    for channel in ("state", "session_reply"):
        bench.deliver(channel, data)
    bench.deliver("access_unit", ReceivedUnit(data, 0, True, True, MONO_NS))


def test_a_grant_without_a_token_opens_no_path() -> None:
    """A granted reply without a token opens no video path."""
    bench = Bench()
    sends = bench.deliver("session_reply", encode(SessionReply(True, "", 0, b"", 5600, "kernel", 0)))
    assert payloads(sends, "path_token") == []


def test_the_emergency_stop_is_in_every_command() -> None:
    """After an emergency stop, every command carries its number and no throttle."""
    bench = Bench().start_driving()
    number = bench.session.raise_emergency_stop(Now(0, WALL_NS)).number
    bench.mono_ns += NS_PER_MS
    sent = [*bench.deliver_picture(), *(command for _, command in bench.advance(200 * NS_PER_MS))]
    assert len(sent) == 11, "one for the picture, and one every 20 ms"
    assert {(command.emergency_stop, command.mode, command.throttle) for command in sent} == {(number, "stop", 0.0)}


@pytest.mark.parametrize(
    ("since_ns", "forgets"),
    [(FRAME_NS, False), (LONGEST_GAP_NS, False), (LONGEST_GAP_NS + 1, True), (-FRAME_NS, True)],
    ids=["next", "just in time", "after a gap", "clock set back"],
)
def test_after_a_gap_the_lane_is_searched_without_memory(since_ns: int, forgets: bool) -> None:
    """After a gap in the pictures, the lane of earlier pictures is forgotten."""
    bench = Bench().start_driving()
    bench.deliver_picture()
    calls_before = bench.detector.forget_calls
    bench.mono_ns += since_ns
    bench.deliver_picture()
    assert (bench.detector.forget_calls > calls_before) == forgets


def requested_operations(sends: list[Send]) -> list[str]:
    return [decode(SessionRequest, payload).operation for payload in payloads(sends, "session")]


def test_a_release_ends_all_commands() -> None:
    """A release is requested at once and ends all commands."""
    bench = Bench().start_driving()
    sends = bench.deliver("operator", "release")
    assert (requested_operations(sends), commands(sends)) == (["release"], [])
    assert bench.deliver_picture() == []
    bench.deliver("session_reply", encode(SessionReply(True, "", 0, b"", 5600, "kernel", 0)))
    assert bench.session.released
    assert bench.advance(NS_PER_S) == []
    assert bench.node.next_wake_ns() is None
