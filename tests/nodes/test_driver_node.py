# ruff: noqa: D102 (a bench for tests: short methods say themselves what they do)

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.nodes.stand_ins import MONO_NS, SMALL, WALL_NS, at, give, noise, of

from lavt.channels import CHANNELS
from lavt.control.driver_limits import CLIENT_LIMITS
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
from lavt.perception.lane_detector import FOLLOWS_FOR_NS, LaneDetector
from lavt.transport.messages import decode, encode
from lavt.transport.video.frame_codec import RenderedPicture, VideoReceiver
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.transport.video.stamp import rtp_timestamp, write_stamp

FRAME_NS = NS_PER_S // 30
GRANTED = SessionReply(True, "", 5, bytes(range(16)), 5600, "kernel", 0)


@dataclass
class SeesALane:
    """Stands in for the `LaneDetector`: a straight lane with the confidence set."""

    confidence: float = 1.0
    seen: list[Picture] = field(default_factory=list)
    forgot: int = 0

    def forget(self) -> None:
        """Forget what was seen."""
        self.forgot += 1

    def detect(self, picture_bgr: Picture) -> Lane:
        """Look at a picture."""
        self.seen.append(picture_bgr)
        return Lane((0.0, 0.0, 0.0), 3.5, 3.6, 20.0, self.confidence)


class GoesStraight:
    """Stands in for a `DriveController`: always the same decision."""

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:  # noqa: ARG002 (the protocol's)
        """Decide."""
        return Decision(0.125, 0.5, 0.0, (0.0,) * 10)


class Bench:
    """A driver node and the vehicle side's half of the talk."""

    def __init__(self, detector: LaneDetector | None = None) -> None:
        self.detector = SeesALane()
        self.session = ClientSession("alice", 1, rearm=False, start_ns=MONO_NS)
        self.node = DriverNode(
            PictureReader(VideoReceiver(Decoder(), (SMALL.height_px, SMALL.width_px))),
            detector or self.detector,
            GoesStraight(),
            self.session,
            CLIENT_LIMITS,
        )
        self.mono_ns = 0
        self.sends: list[Send] = []

    def take(self, channel: str, payload: object) -> list[Send]:
        sends = give(self.node, channel, payload, at(self.mono_ns))
        self.sends += sends
        return sends

    def view(self, picture: Picture | None = None) -> list[Command]:
        shown = noise(1) if picture is None else picture
        return commands(
            self.take("view", DecodedFrame(WALL_NS + self.mono_ns, WALL_NS + self.mono_ns, RenderedPicture(shown)))
        )

    def go(self, duration_ns: int) -> list[tuple[int, Command]]:
        """Wake the node whenever it asked; give its commands with their times."""
        end_ns, made = self.mono_ns + duration_ns, []
        while (wake_ns := self.node.next_wake_ns()) is not None and wake_ns - MONO_NS <= end_ns:
            self.mono_ns = max(self.mono_ns, wake_ns - MONO_NS)
            made += [(self.mono_ns, command) for command in commands(self.take(WAKE, None))]
        self.mono_ns = end_ns
        return made

    def state(self, safety: str, speed_mps: float = 0.0) -> None:
        self.take("state", encode(State(1, 1, speed_mps, 0.0, "drive", safety, "", -1, "")))  # type: ignore[arg-type]

    def driving(self) -> Bench:
        self.take("session_reply", encode(GRANTED))
        self.state("driving")
        assert self.view()
        return self


def commands(sends: list[Send]) -> list[Command]:
    return [decode(Command, payload) for payload in of(sends, "control")]


def unit_of(picture: Picture, stamp_ns: int, rtp_ns: int | None = None) -> ReceivedUnit:
    height_px, width_px, _ = picture.shape
    encoder = Encoder(width_px, height_px, rate_hz=30, bit_rate_bps=4_000_000, gop_frames=30)
    picture = picture.copy()
    write_stamp(picture, stamp_ns)
    data = encoder.encode(picture)
    return ReceivedUnit(data, rtp_timestamp(stamp_ns if rtp_ns is None else rtp_ns), True, True, MONO_NS)


def read(sends: list[Send]) -> PictureRead:
    (picture,) = of(sends, "picture")
    assert isinstance(picture, PictureRead)
    return picture


def test_a_picture_is_read_and_shown() -> None:
    """A received unit becomes a picture with the stamp that was written, shown to perception."""
    bench = Bench()
    sends = bench.take("access_unit", unit_of(noise(1), WALL_NS + 17))
    assert (read(sends).stamp_ns, read(sends).readable, read(sends).in_doubt) == (WALL_NS + 17, True, False)
    (view,) = of(sends, "view")
    assert view.stamp_ns == WALL_NS + 17
    assert read(sends).decoded
    assert bench.node.counts["frames_decoded"] == 1


def test_of_waiting_pictures_only_the_newest_is_looked_at() -> None:
    """Decoding queues, since every picture refers to the one before; looking does not: a new view replaces the old."""
    assert CHANNELS["access_unit"].waiting == "queue"
    assert CHANNELS["view"].waiting == "newest"


def test_a_stamp_that_disagrees_with_its_packets_is_never_used() -> None:
    """Where stamp and RTP timestamp differ the picture is counted as unreadable and not driven by."""
    bench = Bench()
    sends = bench.take("access_unit", unit_of(noise(1), WALL_NS, rtp_ns=WALL_NS + NS_PER_MS))
    assert (read(sends).stamp_ns, read(sends).readable) == (None, False)
    assert read(sends).decoded
    assert read(sends).reason == "stamp and RTP timestamp disagree"
    assert of(sends, "view") == []
    assert bench.node.counts["frames_unreadable"] == 1


def test_a_picture_of_another_size_is_counted_and_not_used() -> None:
    """A picture that is not of the configured size is unreadable, and the reason names its size."""
    bench = Bench()
    sends = bench.take("access_unit", unit_of(noise(1, CameraModel(160, 128)), WALL_NS))
    assert "160 x 128" in read(sends).reason
    assert of(sends, "view") == []


def test_what_gives_no_picture_asks_for_a_keyframe() -> None:
    """Bytes that are no picture are counted, told to the receiver, and leave the next pictures in doubt."""
    bench = Bench()
    unit = ReceivedUnit(b"\x00\x00\x00\x01\x65garbage", 0, False, True, MONO_NS)
    sends = bench.take("access_unit", unit)
    assert of(sends, "picture_lost") == [None]
    assert read(sends).in_doubt
    assert not read(sends).decoded
    assert not read(bench.take("access_unit", unit_of(noise(1), WALL_NS))).in_doubt


def test_it_asks_arms_and_drives() -> None:
    """It asks for the vehicle, arms with the brake on, and drives by its controller once the vehicle says it drives."""
    bench = Bench()
    assert bench.view() == []
    bench.go(0)
    assert len(of(bench.sends, "session")) == 1
    sends = bench.take("session_reply", encode(GRANTED))
    assert of(sends, "path_token") == [PathToken(GRANTED.token, 5600)]
    (arm,) = bench.view()
    assert (arm.mode, arm.epoch, arm.throttle, arm.brake, arm.steering_rad) == ("arm", 5, 0.0, 1.0, 0.0)
    bench.state("driving")
    (drive,) = bench.view()
    assert (drive.mode, drive.throttle, drive.brake, drive.steering_rad) == ("drive", 0.5, 0.0, 0.125)
    assert drive.sequence > arm.sequence
    assert drive.stamp_ns == WALL_NS


def test_perception_has_a_memory_only_while_it_drives() -> None:
    """Each picture before the drive is looked at as if it were the first: what was tracked before may be wrong."""
    bench = Bench()
    bench.view()
    bench.view()
    assert bench.detector.forgot == 2
    bench.driving()
    before = bench.detector.forgot
    bench.view()
    assert bench.detector.forgot == before


def test_a_command_leaves_every_20_ms_between_pictures() -> None:
    """Between pictures commands go out every 20 ms, numbered on, with the stamp of the newest picture."""
    bench = Bench().driving()
    made = bench.go(100 * NS_PER_MS)
    assert [at_ns for at_ns, _ in made] == [each * 20 * NS_PER_MS for each in range(1, 6)]
    assert len({command.sequence for _, command in made}) == 5
    assert {command.stamp_ns for _, command in made} == {WALL_NS}


def test_without_pictures_it_brakes_after_300_ms_and_stops_after_2500_ms() -> None:
    """300 ms without a new picture: brake. 2.5 s: stop. The vehicle's reports alone keep neither away."""
    bench = Bench().driving()
    made = bench.go(2600 * NS_PER_MS)
    for at_ns, command in made:
        mode = "stop" if at_ns >= 2500 * NS_PER_MS else "drive"
        assert command.mode == mode
        assert (command.throttle == 0) == (at_ns >= 300 * NS_PER_MS)
        assert (command.brake >= CLIENT_LIMITS.brake) == (at_ns >= 300 * NS_PER_MS)
    assert made[-1][1].mode == "stop"


@pytest.mark.parametrize(
    ("lost_ns", "mode", "brakes"), [(280, "drive", False), (300, "drive", True), (2500, "stop", True)]
)
def test_without_the_vehicles_state_it_brakes_and_stops(lost_ns: int, mode: str, *, brakes: bool) -> None:
    """Pictures come but no state of the vehicle: after 300 ms it brakes, after 2.5 s it asks for a stop."""
    bench = Bench().driving()
    for _ in range(lost_ns // 20):
        bench.mono_ns += 20 * NS_PER_MS
        (command,) = bench.view()
    assert command.mode == mode
    assert (command.brake >= CLIENT_LIMITS.brake) == brakes
    assert (command.throttle == 0.0) == brakes


@pytest.mark.parametrize(
    ("lost_ns", "mode", "brakes"), [(480, "drive", False), (520, "drive", True), (2520, "stop", True)]
)
def test_without_a_lane_it_brakes_and_stops(lost_ns: int, mode: str, *, brakes: bool) -> None:
    """Pictures come but no lane is in them: after 0.5 s it brakes, after 2.5 s it asks for a stop."""
    bench = Bench().driving()
    bench.detector.confidence = 0.0
    for _ in range(lost_ns // 20):
        bench.mono_ns += 20 * NS_PER_MS
        bench.state("driving")
        (command,) = bench.view()
    assert command.mode == mode
    assert (command.brake >= CLIENT_LIMITS.brake) == brakes


def test_grey_pictures_lead_to_a_stop() -> None:
    """With the real detector, 2.5 s of grey pictures end in a request to stop."""
    bench = Bench(LaneDetector(CameraModel()))
    bench.take("session_reply", encode(GRANTED))
    bench.state("driving")
    grey = np.full((480, 640, 3), 128, np.uint8)
    modes = []
    for _ in range(77):
        modes += [command.mode for command in bench.view(grey)]
        bench.mono_ns += FRAME_NS
    assert (modes[0], modes[-1]) == ("drive", "stop")


def test_garbage_from_the_vehicle_is_counted() -> None:
    """States and replies that cannot be read are counted and change nothing."""
    bench = Bench().driving()
    for data in (b"", b"\xc1", b"\x93\x01\x02\x03", bytes(2000)):
        assert bench.take("state", data) == []
        assert bench.take("session_reply", data) == []
    assert bench.node.counts["states_unreadable"] == 4
    assert bench.node.counts["session_replies_unreadable"] == 4
    assert bench.session.phase == "driving"


def test_after_every_reply_that_can_be_read_the_vehicle_can_be_stopped() -> None:
    """Whatever a reply says was the last emergency stop, the next one is a message that the vehicle can read."""
    for last in (2**62, 2**62 + 1, 2**63 - 1):
        bench = Bench().driving()
        bench.take("session_reply", encode(replace(GRANTED, emergency_stop=last)))
        sends = bench.take("operator", "emergency_stop")
        assert decode(SessionRequest, of(sends, "session")[0]).operation == "emergency_stop"
        assert commands(sends)[0].emergency_stop > 0


@given(st.binary(max_size=300))
def test_any_bytes_are_survived(data: bytes) -> None:
    """No bytes on any channel from outside raise into the loop."""
    bench = Bench()
    for channel in ("state", "session_reply"):
        bench.take(channel, data)
    bench.take("access_unit", ReceivedUnit(data, 0, True, True, MONO_NS))


def test_a_grant_without_a_token_opens_no_path() -> None:
    """The granted answer to a release has no token, and the receiver is not told one."""
    bench = Bench()
    sends = bench.take("session_reply", encode(SessionReply(True, "", 0, b"", 5600, "kernel", 0)))
    assert of(sends, "path_token") == []


def test_the_emergency_stop_is_in_every_command() -> None:
    """Once raised, its number is in every command, and none of them asks for throttle."""
    bench = Bench().driving()
    number = bench.session.stop_now(Now(0, WALL_NS)).number
    bench.mono_ns += NS_PER_MS
    made = [*bench.view(), *(command for _, command in bench.go(200 * NS_PER_MS))]
    assert len(made) == 11
    assert {(command.emergency_stop, command.mode, command.throttle) for command in made} == {(number, "stop", 0.0)}


@pytest.mark.parametrize(
    ("since_ns", "forgets"),
    [(FRAME_NS, False), (FOLLOWS_FOR_NS, False), (FOLLOWS_FOR_NS + 1, True), (-FRAME_NS, True)],
    ids=["the next", "just in time", "after a gap", "of a clock put back"],
)
def test_after_a_gap_the_lane_is_looked_for_anew(since_ns: int, forgets: bool) -> None:
    """When pictures were missing for so long that another lane may lie where the lane was, it is not followed on."""
    bench = Bench().driving()
    bench.view()
    before = bench.detector.forgot
    bench.mono_ns += since_ns
    bench.view()
    assert (bench.detector.forgot > before) == forgets


def requests(sends: list[Send]) -> list[str]:
    return [decode(SessionRequest, payload).operation for payload in of(sends, "session")]


def test_a_release_ends_the_commands_at_once() -> None:
    """When the person releases the vehicle the query leaves at once, and no command after it."""
    bench = Bench().driving()
    sends = bench.take("operator", "release")
    assert (requests(sends), commands(sends)) == (["release"], [])
    assert bench.view() == []
    bench.take("session_reply", encode(SessionReply(True, "", 0, b"", 5600, "kernel", 0)))
    assert bench.session.released
    assert bench.go(NS_PER_S) == []
    assert bench.node.next_wake_ns() is None
