from __future__ import annotations

from contextlib import closing
from itertools import count
from pathlib import Path

import pytest
from tests.nodes.stand_ins import MONO_NS, SMALL_CAMERA, NoiseCamera, at, deliver, noise, payloads
from tests.support.clocks import ManualClock
from tests.vehicle.moving_video import MODEL as MOVING
from tests.vehicle.moving_video import number_of, write_video

from lavt.clock import MachineClock
from lavt.domain import NS_PER_MS, NS_PER_S, Pose
from lavt.node import WAKE, Send
from lavt.nodes.camera import CameraNode
from lavt.safety.issued_stamps import IssuedStamps
from lavt.transport.rtp.fec import RepairSender
from lavt.transport.rtp.rtcp import (
    ReceptionReport,
    is_rtcp,
    max_bit_rate,
    parse_announcement,
    picture_loss,
    receiver_report,
)
from lavt.transport.rtp.rtp import Packetizer, parse_packet
from lavt.transport.video.frame_codec import VideoReceiver, VideoSender
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.transport.video.path_validation import PathClient, PathServer
from lavt.transport.video.stamp import rtp_timestamp
from lavt.transport.video.stream_sender import StreamSender
from lavt.vehicle.camera import Camera
from lavt.vehicle.video_device import VideoDevice

FRAME_NS = NS_PER_S // 30
TOKEN = bytes(range(16))
HOME, ELSEWHERE = ("198.51.100.2", 4000), ("203.0.113.9", 4000)
REPORT = receiver_report(1, ReceptionReport(2, 1, 0.0, 0, 0), clock_ns=0)
KEYFRAME_REQUEST = picture_loss(1, 2)
KEYFRAME_START = b"\x00\x00\x01\x65"
"""The start code and header of a NAL unit that only keyframes contain."""


def new_node(camera: Camera | None = None, *, send_to: tuple[tuple[str, int], ...] = ()) -> CameraNode:
    numbers = count()
    model = SMALL_CAMERA if camera is None else camera.model
    video_sender = VideoSender(
        Encoder(model.width_px, model.height_px, rate_hz=30, bit_rate_bps=2_000_000, gop_frames=1000)
    )
    path = PathServer(lambda: next(numbers).to_bytes(32, "big"))
    return CameraNode(
        camera or NoiseCamera(),
        video_sender,
        StreamSender(Packetizer(2, 0), RepairSender(3, 0)),
        path,
        start_ns=MONO_NS,
        send_to=send_to,
    )


def wake(node: CameraNode, mono_ns: int, wall_ns: int | None = None) -> list[Send]:
    return deliver(node, WAKE, None, at(mono_ns, wall_ns))


def validate_path(node: CameraNode, address: tuple[str, int] = HOME, mono_ns: int = 0) -> None:
    client = PathClient(TOKEN)
    (challenge,) = payloads(deliver(node, "feedback", client.hello(0), at(mono_ns), address), "rtp")
    assert deliver(node, "feedback", client.answer(challenge), at(mono_ns), address) == []


def test_a_frame_is_sent_reported_and_recorded() -> None:
    """A frame is sent as packets with its RTP timestamp and reported with its stamp and size."""
    node = new_node(send_to=(HOME,))
    sends = wake(node, 0, wall_ns=123_456_789)
    (frame,) = payloads(sends, "frame")
    (unit,) = payloads(sends, "video")
    assert (frame.number, frame.stamped_mono_ns, frame.capture_ns) == (0, MONO_NS, MONO_NS)
    assert frame.stamp_ns == unit.stamp_ns == at(0, 123_456_789).wall_ns
    assert frame.size_bytes == len(unit.data)
    packets = [packet for packet in payloads(sends, "rtp") if not is_rtcp(packet)]
    assert {parse_packet(packet).timestamp for packet in packets} == {rtp_timestamp(frame.stamp_ns)}


def test_a_frame_is_reported_before_its_first_packet() -> None:
    """A frame is reported to the safety gate before its first packet is sent."""
    sends = wake(new_node(send_to=(HOME,)), 0)

    assert sends[0].channel == "frame"
    assert sends[1].channel == "rtp"


def test_a_late_wake_skips_frames_and_counts_them() -> None:
    """A late wake captures the newest due frame at its due time, and counts the skipped ones."""
    camera = NoiseCamera(phase_ns=5)
    node = new_node(camera)
    assert node.next_wake_ns() == MONO_NS + 5
    wake(node, 5)
    wake(node, 4 * FRAME_NS + 10 * NS_PER_MS)
    assert [(number, at_ns) for number, at_ns, _ in camera.captures] == [
        (0, MONO_NS + 5),
        (4, MONO_NS + 5 + round(4 * NS_PER_S / 30)),
    ]
    assert node.counts["frames_skipped"] == 3
    assert node.next_wake_ns() == MONO_NS + 5 + round(5 * NS_PER_S / 30)


def test_the_newest_pose_before_the_capture_is_used() -> None:
    """A frame is rendered from the newest pose that is not later than its due time."""
    camera = NoiseCamera()
    node = new_node(camera)
    poses = [Pose(MONO_NS + offset_ns, 0.0, 0.0, 0.0) for offset_ns in (-5, -1, 0, 1, 7)]
    for pose in poses:
        deliver(node, "pose", pose, at(10))
    wake(node, 10)
    assert camera.captures[0][2] is poses[2]


def test_a_later_pose_is_not_used() -> None:
    """Poses later than the due time are not used."""
    camera = NoiseCamera()
    node = new_node(camera)
    deliver(node, "pose", Pose(MONO_NS + 1, 0.0, 0.0, 0.0), at(2))
    wake(node, 2)
    assert camera.captures[0][2] is None


@pytest.mark.parametrize("wall_times_ns", [[7] * 6, [7, 7, 8, 7, 8, 9], [1000, 1001, 1002, 1000, 1001, 1002]])
def test_no_stamp_is_issued_twice(wall_times_ns: list[int]) -> None:
    """No two frames have the same stamp, even if the wall clock stands still or is set back."""
    node = new_node()
    stamps = [
        payloads(wake(node, i * 2 * FRAME_NS, wall_ns), "frame")[0].stamp_ns for i, wall_ns in enumerate(wall_times_ns)
    ]
    assert len(set(stamps)) == len(stamps)
    assert (
        max(abs(stamp_ns - at(0, wall_ns).wall_ns) for stamp_ns, wall_ns in zip(stamps, wall_times_ns, strict=True))
        < 10
    )


@pytest.mark.parametrize("is_stuck", [True, False])
def test_a_camera_that_repeats_a_picture_is_frozen(*, is_stuck: bool) -> None:
    """After five frames, a camera that repeats one picture is recognized as frozen; a working one is not."""
    node = new_node(NoiseCamera(stuck=noise(0) if is_stuck else None))
    stamps = IssuedStamps(5 * NS_PER_S, 5)
    for number in range(5):
        assert not stamps.is_frozen
        (frame,) = payloads(wake(node, number * FRAME_NS + NS_PER_MS), "frame")
        stamps.add(frame.stamp_ns, frame.number, frame.stamped_mono_ns, frame.pixel_crc)
    assert stamps.is_frozen == is_stuck


def test_a_missing_picture_is_counted_and_not_sent() -> None:
    """A frame without a picture is counted and not sent, and the next frame is captured in time."""
    node = new_node(NoiseCamera(broken=True), send_to=(HOME,))
    assert wake(node, 0) == []
    assert node.counts["frames_missing"] == 1
    assert node.next_wake_ns() == MONO_NS + round(NS_PER_S / 30)


def test_no_video_without_a_validated_path() -> None:
    """Video is sent only to a validated address, and only while reports arrive from this address."""
    node = new_node()
    assert payloads(wake(node, 0), "rtp") == []
    assert deliver(node, "feedback", PathClient(TOKEN).hello(0), at(1), HOME) == []
    deliver(node, "video_token", TOKEN, at(1))
    assert payloads(wake(node, FRAME_NS + 1), "rtp") == []
    validate_path(node, mono_ns=FRAME_NS + 2)
    assert {send.peer for send in wake(node, 2 * FRAME_NS + 1) if send.channel == "rtp"} == {HOME}
    assert payloads(wake(node, 3 * NS_PER_S), "rtp") == []
    assert node.counts["frames_without_receiver"] == 3


def test_configured_receivers_get_video_without_validation() -> None:
    """`send_to` addresses get every frame, in addition to the validated address."""
    node = new_node(send_to=(ELSEWHERE,))
    deliver(node, "video_token", TOKEN, at(0))
    validate_path(node)
    assert {send.peer for send in wake(node, 0) if send.channel == "rtp"} == {HOME, ELSEWHERE}


def test_keyframe_requests_are_rate_limited() -> None:
    """There is at most one requested keyframe in 100 ms."""
    node = new_node()
    deliver(node, "video_token", TOKEN, at(0))
    validate_path(node)
    are_keyframes = []
    for number in range(12):  # 0.4 s
        deliver(node, "feedback", KEYFRAME_REQUEST, at(number * FRAME_NS + NS_PER_MS), HOME)
        (unit,) = payloads(wake(node, number * FRAME_NS + 2 * NS_PER_MS), "video")
        are_keyframes.append(KEYFRAME_START in unit.data)
    assert are_keyframes[0]
    assert 3 <= node.counts["keyframes_on_request"] <= 4
    assert sum(are_keyframes) == node.counts["keyframes_on_request"]


def test_bit_rate_changes_are_rate_limited() -> None:
    """The bit rate changes at most once in 100 ms, because each change restarts the encoder, which sends a keyframe."""
    node = new_node()
    deliver(node, "video_token", TOKEN, at(0))
    validate_path(node)
    keyframes = 0
    for number in range(30):  # 1 s
        limit = max_bit_rate(1, 2, 500_000 + number * 10_000, overhead_bytes=0)
        deliver(node, "feedback", limit, at(number * FRAME_NS + NS_PER_MS), HOME)
        (unit,) = payloads(wake(node, number * FRAME_NS + 2 * NS_PER_MS), "video")
        keyframes += KEYFRAME_START in unit.data
    assert 8 <= keyframes <= 11


def test_other_addresses_have_no_effect() -> None:
    """RTCP and hellos from other addresses have no effect."""
    node = new_node()
    deliver(node, "video_token", TOKEN, at(0))
    validate_path(node)
    wake(node, 0)
    forged = PathClient(bytes(16)).hello(0)
    for number in range(1, 90):
        for datagram in (KEYFRAME_REQUEST, REPORT, forged, b"LAVT", b"\x80\xc9", b""):
            assert deliver(node, "feedback", datagram, at(number * FRAME_NS), ELSEWHERE) == []
        sends = wake(node, number * FRAME_NS + NS_PER_MS)
        assert {send.peer for send in sends if send.channel == "rtp"} <= {HOME}
    assert payloads(sends, "rtp") == [], "HOME has sent no report for 2 s"
    assert node.counts.get("keyframes_on_request", 0) == 0
    assert node.counts["feedback_from_strangers"] == 2 * 89, "the requests and the reports"


def test_reports_keep_the_path_open_and_garbage_is_counted() -> None:
    """Receiver reports keep the video path open; unreadable RTCP is counted."""
    node = new_node()
    deliver(node, "video_token", TOKEN, at(0))
    validate_path(node)
    for number in range(10):
        deliver(node, "feedback", REPORT, at(number * NS_PER_S // 2), HOME)
        deliver(node, "feedback", REPORT[:-3], at(number * NS_PER_S // 2), HOME)
        assert payloads(wake(node, number * NS_PER_S // 2 + 1), "rtp")
    assert node.counts["feedback_unreadable"] == 10
    deliver(node, "video_token", None, at(5 * NS_PER_S))
    assert payloads(wake(node, 5 * NS_PER_S + 1), "rtp") == []


def report_heavy_loss(node: CameraNode, at_ns: int) -> None:
    """Report to the node that 30 of 100 packets were lost."""
    for highest_sequence, lost in ((1000, 0), (1100, 30)):
        report = receiver_report(1, ReceptionReport(2, highest_sequence, lost / 100, lost, 0), clock_ns=at_ns)
        deliver(node, "feedback", report, at(at_ns), HOME)


def test_repair_packets_go_to_the_validated_address_only() -> None:
    """Repair packets are sent after reported loss, to the validated address only."""
    node = new_node(send_to=(ELSEWHERE,))
    deliver(node, "video_token", TOKEN, at(0))
    validate_path(node)
    report_heavy_loss(node, NS_PER_MS)
    payload_types: dict[object, list[int]] = {HOME: [], ELSEWHERE: []}
    for send in wake(node, 2 * NS_PER_MS):
        if send.channel == "rtp" and not is_rtcp(send.payload):
            payload_types[send.peer].append(parse_packet(send.payload).payload_type)
    repairs = node.counts["packets_of_repair"]
    assert repairs in {2, 4}, "two for each block of at most 16 packets"
    assert payload_types[HOME] == [*payload_types[ELSEWHERE], *[97] * repairs]
    assert set(payload_types[ELSEWHERE]) == {96}


def test_a_sender_report_is_sent_every_500_ms() -> None:
    """A sender report every 500 ms maps wall time to RTP timestamps."""
    node = new_node(send_to=(ELSEWHERE,))
    reports = []
    for number in range(46):
        sends = wake(node, number * (FRAME_NS + 1))
        packets = [packet for packet in payloads(sends, "rtp") if not is_rtcp(packet)]
        for datagram in payloads(sends, "rtp"):
            if is_rtcp(datagram):
                (report,) = parse_announcement(datagram).reports
                reports.append((number, report.rtp_timestamp == parse_packet(packets[0]).timestamp))
    assert reports == [(0, True), (15, True), (30, True), (45, True)]


def test_the_receiver_may_request_a_lower_bit_rate() -> None:
    """A requested lower bit rate is applied; a higher one, or one from another address, is not."""
    node = new_node()
    deliver(node, "video_token", TOKEN, at(0))
    validate_path(node)

    def mean_frame_bytes(first_number: int) -> float:
        """Send 40 frames and return the mean size of the last 30, at a settled rate; REPORT keeps the path open."""
        sizes: list[int] = []
        for number in range(first_number, first_number + 40):
            deliver(node, "feedback", REPORT, at(number * FRAME_NS), HOME)
            sizes += [frame.size_bytes for frame in payloads(wake(node, number * FRAME_NS + NS_PER_MS), "frame")]
        return sum(sizes[10:]) / 30

    configured_rate_bytes = mean_frame_bytes(0)
    deliver(node, "feedback", max_bit_rate(1, 2, 500_000, overhead_bytes=0), at(41 * FRAME_NS), HOME)
    assert mean_frame_bytes(42) < 0.5 * configured_rate_bytes
    deliver(node, "feedback", max_bit_rate(1, 2, 9_000_000, overhead_bytes=0), at(90 * FRAME_NS), HOME)
    assert mean_frame_bytes(91) == pytest.approx(configured_rate_bytes, rel=0.2)
    deliver(node, "feedback", max_bit_rate(1, 2, 500_000, overhead_bytes=0), at(140 * FRAME_NS), ELSEWHERE)
    assert mean_frame_bytes(141) == pytest.approx(configured_rate_bytes, rel=0.2)


def test_pictures_of_a_video_device_are_sent(tmp_path: Path) -> None:
    """Each picture of a video device is sent at most once, with its content and stamp."""
    path = write_video(tmp_path / "video.avi", rate_hz=30.0)
    receiver = VideoReceiver(Decoder(), (MOVING.height_px, MOVING.width_px))
    numbers = []
    clock = ManualClock(MONO_NS)
    with closing(VideoDevice(str(path), model=MOVING, rate_hz=30.0, clock=clock)) as device:
        node = new_node(device)
        for number in range(4):
            clock.mono_ns = MONO_NS + number * FRAME_NS
            assert device.wait(20.0)
            (unit,) = payloads(wake(node, number * FRAME_NS), "video")
            received = receiver.decode(unit.data)
            assert received is not None
            assert receiver.read_stamp(received) == unit.stamp_ns
            numbers.append(number_of(received.picture))
    assert numbers == sorted(set(numbers))  # how many pictures are skipped depends on this machine


def test_a_lost_video_device_is_counted(tmp_path: Path) -> None:
    """A lost video device sends no further frames and is counted."""
    path = write_video(tmp_path / "short.avi", rate_hz=30.0, pictures=1)
    clock = MachineClock()
    device = VideoDevice(str(path), model=MOVING, rate_hz=30.0, clock=ManualClock(MONO_NS))
    path.unlink()
    with closing(device):
        node = new_node(device)
        (frame,) = payloads(wake(node, 0), "frame")
        end_ns = clock.now().mono_ns + 20 * NS_PER_S
        while not node.counts.get("camera_times_lost") and clock.now().mono_ns < end_ns:
            device.wait(0.02)
        assert [payloads(wake(node, number * FRAME_NS), "frame") for number in range(1, 20)] == [[]] * 19
    assert (frame.number, frame.capture_ns) == (0, None)
    assert node.counts["camera_pictures_read"] == node.counts["camera_times_lost"] == 1
    assert node.counts["frames_missing"] == 19
