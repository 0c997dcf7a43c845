"""Make the targets for the UDP inputs of the vehicle: RTCP feedback, path validation, and clock probes."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count

from benchmarks.fuzzing.mutation import Chance, Corpus
from benchmarks.fuzzing.target import START, InvariantViolation, NodeBench, Target, expect, payloads_on, total
from msgspec.structs import replace

from lavt.assembly.entropy import SeededEntropy
from lavt.domain import (
    NS_PER_MS,
    NS_PER_S,
    CameraModel,
    Pose,
)
from lavt.node import Send
from lavt.nodes.camera import CameraNode
from lavt.nodes.clock_sync import ClockSyncNode
from lavt.transport.clock_sync.probe import LAYOUT, decode_reply, encode_request
from lavt.transport.rtp.fec import RepairSender
from lavt.transport.rtp.rtcp import ReceptionReport, is_rtcp, max_bit_rate, picture_loss, receiver_report
from lavt.transport.rtp.rtp import Packetizer
from lavt.transport.video.path_validation import PathClient, PathServer, is_path_datagram
from lavt.transport.video.stream_sender import StreamSender
from lavt.vehicle.camera import CapturedFrame

STEP_NS = NS_PER_MS
"""Time between two inputs."""
INPUTS_PER_HELLO = 2000
"""After this number of inputs the true client validates its path again."""
INPUTS_PER_REPORT = 500
"""After this number of inputs the true client sends a report, so that its path stays open."""

PATH_FIELDS = ((4, 1), (5, 1), (6, 8), (14, 8), (22, 16))
"""Offset and length (bytes) of each field after the magic number in a datagram of the path validation."""
RTCP_FIELDS = ((0, 1), (1, 1), (2, 2), *((offset, 4) for offset in range(4, 64, 4)))
"""Offset and length (bytes) of each field of the RTCP header, and of the 32-bit words after the header."""
PROBE_FIELDS = ((0, 2), (2, 1), (3, 1), (4, 4), (8, 8), (16, 8), (24, 8), (32, 8), (40, 8))
"""Offset and length (bytes) of each field of a clock probe (`LAYOUT`)."""


class FakeCamera:
    """A camera and a codec whose pictures are the frame numbers."""

    model = CameraModel(width_px=64, height_px=64)
    rate_hz = 30.0
    phase_ns = 0

    def __init__(self) -> None:
        self.limit_bps: int | None = None

    def capture(self, number: int, at_ns: int, _pose: Pose | None) -> CapturedFrame:
        """Return a frame whose picture is its number."""
        return CapturedFrame(number, at_ns, number)

    def prepare(self, picture: int) -> tuple[int, int]:
        """Return the picture unchanged, and a hash of it."""
        return picture, picture & 0xFFFFFFFF

    def write_stamp(self, prepared: int, _stamp_ns: int) -> int:
        """Return the picture unchanged."""
        return prepared

    def encode(self, _stamped: int, *, keyframe: bool) -> bytes:
        """Return an access unit of 3005 bytes, or of 6005 bytes for a keyframe."""
        return b"\x00\x00\x00\x01\x65" + bytes([7] * (6000 if keyframe else 3000))

    def limit_bit_rate(self, limit_bps: int | None) -> None:
        """Store the limit; raise `InvariantViolation` for a negative one."""
        if limit_bps is not None and limit_bps < 0:
            raise InvariantViolation(f"a bit rate of {limit_bps}")
        self.limit_bps = limit_bps


CLIENT_ADDRESS: tuple[str, int] = ("198.51.100.2", 4000)
STRANGERS: Sequence[tuple[str, int]] = (
    ("203.0.113.9", 4000),
    ("203.0.113.9", 1),
    ("198.51.100.2", 4001),
    ("::1", 65_535),
)
"""Addresses that are not the client's."""


def rtcp_datagrams() -> list[bytes]:
    """Return the RTCP datagrams that a receiver of the stream with SSRC 2 sends; the first one is a report."""
    report = ReceptionReport(
        media_ssrc=2,
        highest_sequence=500,
        lost_fraction=0.1,
        cumulative_lost=20,
        jitter=30,
        last_report=5,
        last_report_age_ns=NS_PER_S,
    )
    negative_loss = replace(report, cumulative_lost=-5, highest_sequence=700)
    reports = [receiver_report(1, block, clock_ns=START.mono_ns) for block in (report, negative_loss)]
    return [*reports, picture_loss(1, 2), max_bit_rate(1, 2, 2_000_000), reports[0] + picture_loss(1, 2)]


def old_path_datagrams() -> list[bytes]:
    """Return a hello, an answer and a challenge of an earlier session.

    The server answers a client's hello with a challenge, and the client's answer to the challenge opens the video path.
    """
    client, server = PathClient(bytes(16)), PathServer(lambda: bytes(32))
    server.set_token(bytes(16))
    challenge = server.receive(client.hello(0), STRANGERS[0], START.mono_ns) or b""
    return [client.hello(0), client.answer(challenge) or b"", challenge]


def feedback(seed: int) -> Target:
    """Make a target for the vehicle's video port.

    Invariants: video goes to the validated address only, and no reply is longer than its request.
    """
    entropy, camera = SeededEntropy(seed, "feedback"), FakeCamera()
    stream = StreamSender(Packetizer(2, 0), RepairSender(3, 0))
    node = CameraNode(camera, camera, stream, PathServer(lambda: entropy.token(32)), start_ns=START.mono_ns)
    frames = misdirected = 0

    def on_send(send: Send) -> None:
        nonlocal frames, misdirected
        frames += send.channel == "frame"
        # Other datagrams on the channel `rtp` are challenges, which the node is allowed to send to any address.
        is_video = send.channel == "rtp" and not is_path_datagram(send.payload)
        misdirected += is_video and send.peer != CLIENT_ADDRESS

    bench = NodeBench(node, on_send)
    token, rtcp_entries = entropy.token(16), rtcp_datagrams()
    path = Corpus(old_path_datagrams(), fields=PATH_FIELDS)
    rtcp = Corpus(rtcp_entries, fields=RTCP_FIELDS)
    bench.deliver("video_token", token)
    inputs = 0

    client = PathClient(token)

    def validate_path() -> None:
        hello = client.hello(0)
        [challenge] = bench.deliver("feedback", hello, CLIENT_ADDRESS)
        answer = client.answer(challenge.payload) or b""
        bench.deliver("feedback", answer, CLIENT_ADDRESS)
        path.replays.extend((hello, answer))

    def feed(channel: str, data: bytes, chance: Chance) -> None:
        nonlocal inputs
        inputs += 1
        if inputs % INPUTS_PER_HELLO == 1:
            validate_path()
        peer = CLIENT_ADDRESS if channel == "rtcp" and chance.below(2) else chance.choice(STRANGERS)
        sends = bench.deliver("feedback", data, peer)
        for send in sends:
            expect(send.peer == peer and len(send.payload) <= len(data), "a reply was longer than its request")
        expect(is_rtcp(data) or not sends or data in path.replays, "a stranger's hello was answered")
        bench.advance(STEP_NS)
        if inputs % INPUTS_PER_REPORT == 0:
            bench.deliver("feedback", rtcp_entries[0], CLIENT_ADDRESS)
        expect(misdirected == 0, "video went to an address that was not validated")

    def rejected_count() -> int:
        return total(node.counts, "path_", "feedback_")

    def finish() -> str:
        expect(node.counts.get("frames_sent", 0) == frames, "frames were lost")
        return f"{frames} frames sent, {node.counts.get('keyframes_on_request', 0)} keyframes"

    return Target({"path": path, "rtcp": rtcp}, feed, rejected_count, finish)


def probe_at_vehicle(seed: int) -> Target:  # noqa: ARG001 (it uses no random numbers)
    """Make a target for the clock probe of the vehicle. Invariant: a reply is as long as its request."""
    node = ClockSyncNode(START.mono_ns)
    bench = NodeBench(node)
    sequence = count()
    corpus = Corpus(
        [encode_request(next(sequence), START.wall_ns + later_ns) for later_ns in range(8)],
        fields=PROBE_FIELDS,
    )
    inputs = answered = 0

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, answered
        inputs += 1
        for reply in payloads_on(bench.deliver(channel, data, STRANGERS[0]), "probe_reply"):
            decode_reply(reply)
            expect(len(reply) == len(data) == LAYOUT.size, "a reply was longer than its request")
            answered += 1
        bench.advance(STEP_NS)

    def finish() -> str:
        expect(answered + node.counts["probes_rejected"] == inputs, "probes were neither answered nor rejected")
        return f"{answered} answered"

    return Target({"probe_request": corpus}, feed, lambda: node.counts["probes_rejected"], finish)
