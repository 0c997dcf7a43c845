"""Make the targets for the inputs of the client: states, replies, video datagrams, clock-probe replies and pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from benchmarks.fuzzing.camera import PROBE_FIELDS, RTCP_FIELDS
from benchmarks.fuzzing.mutation import Chance, Corpus
from benchmarks.fuzzing.target import START, NodeBench, Target, expect, payloads_on, total
from msgspec.structs import replace

from lavt.control.client_limits import CLIENT_LIMITS
from lavt.control.drive_controller import make_controller
from lavt.control.preset import PRESETS
from lavt.domain import (
    NS_PER_MS,
    NS_PER_S,
    Command,
    FramePayload,
    Lane,
    NetemReply,
    Picture,
    SessionReply,
    SessionRequest,
    State,
)
from lavt.errors import BadPacket
from lavt.node import Send
from lavt.nodes.client_session import ClientSession
from lavt.nodes.clock_sync import ProbingClockSyncNode
from lavt.nodes.driver import DriverNode
from lavt.nodes.injection import InjectionClient
from lavt.nodes.payloads import DecodedFrame, PathToken, ReceivedUnit
from lavt.nodes.picture_reader import PictureReader
from lavt.nodes.receiver import SSRC as RECEIVER_SSRC
from lavt.nodes.receiver import ReceiverNode
from lavt.streams import stream
from lavt.transport.clock_sync.probe import ProbeReply, decode_request, encode_reply
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.transport.messages import decode, encode
from lavt.transport.netem.injector import InjectionResult
from lavt.transport.rtp.fec import RepairSender
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.rtcp import parse_feedback, sender_report
from lavt.transport.rtp.rtcp_xr import ReferenceAnswer
from lavt.transport.rtp.rtp import Depacketizer, Packetizer
from lavt.transport.video.frame_codec import RenderedPicture, VideoReceiver
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.transport.video.path_validation import PathClient, PathServer, is_path_datagram
from lavt.transport.video.stamp import (
    STAMP_PX,
    read_clear_stamp,
    read_stamp,
    rtp_timestamp,
    stamp_agrees,
    write_stamp,
    write_stamp_luma,
)

FRAME_NS = NS_PER_S // 30
STEP_NS = NS_PER_MS
"""Time between two inputs."""
INPUTS_PER_FRAME = FRAME_NS // STEP_NS
"""After this number of inputs a true frame arrives."""
INPUTS_PER_RESTART = 50
"""After this number of inputs a new client takes the place of one that lost control or noticed an emergency stop."""
FEWEST_INPUTS = 1000
"""After fewer inputs than this, a target need not have sent a command or shown a picture."""
WIDTH_PX, HEIGHT_PX = 128, 96
TOKEN = bytes(range(16))


class FixedLaneDetector:
    """A lane detector that always returns the same lane."""

    def forget(self) -> None:
        """Do nothing."""

    def detect(self, _picture: FramePayload) -> Lane:
        """Return the lane."""
        return Lane((0.3, 0.01, 0.001), 3.5, 3.6, 20.0, 1.0)


def new_driver() -> DriverNode:
    """Make a driver node with the real controller and the real decoder."""
    return DriverNode(
        PictureReader(VideoReceiver(Decoder(), (HEIGHT_PX, WIDTH_PX))),
        FixedLaneDetector(),
        make_controller("lane_keeper", PRESETS["designed"], 2.8448),
        ClientSession("alice", 7, rearm=True, start_ns=START.mono_ns, clear_stop=True),
        CLIENT_LIMITS,
    )


def driver(seed: int, *, stops_after: int | None = None) -> Target:  # noqa: ARG001 (it uses no random numbers)
    """Make a target for states and replies.

    Invariant: the vehicle can decode every command and request that the driver node sends. The client is restarted
    repeatedly, because after an emergency stop it arms no more. With `stops_after` a person stops the vehicle after
    that many inputs, and the client is not restarted from then on.
    """
    commands = drive_commands = rejected_before_restarts = 0

    def on_send(send: Send) -> None:
        nonlocal commands, drive_commands
        if send.channel == "control":
            command = decode(Command, send.payload)
            commands += 1
            drive_commands += command.mode == "drive"
        elif send.channel == "session":
            decode(SessionRequest, send.payload)
        elif send.channel == "path_token":
            PathClient(send.payload.token)

    bench = NodeBench(new_driver(), on_send)
    wall_ns = START.wall_ns
    state = State(
        wall_ns, START.mono_ns, 8.0, 0.01, "drive", "driving", "armed by the client", 12, "", active_operator="alice"
    )
    stopped = replace(state, speed_mps=0.0, safety="safe_stop", rejected="not the epoch in force", requested_by="bob")
    reply = SessionReply(True, "", 2**63 + 1, TOKEN, 5600, "kernel", 0)
    states = Corpus(
        [encode(message) for message in (state, stopped, replace(stopped, safety="emergency_stop"))], packed=True
    )
    rejection = SessionReply(False, "held by bob", 0, b"", 5600, "", wall_ns)
    replies = Corpus([encode(answer) for answer in (reply, rejection)], packed=True)
    picture = RenderedPicture(np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8))
    inputs = 0

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, rejected_before_restarts
        inputs += 1
        if inputs % INPUTS_PER_RESTART == 0 and (stops_after is None or inputs < stops_after):
            rejected_before_restarts = rejected_count()
            bench.node = new_driver()
        bench.deliver(channel, data)
        bench.advance(STEP_NS)
        if inputs % INPUTS_PER_FRAME == 0:
            bench.deliver("view", DecodedFrame(bench.now.wall_ns, bench.now.wall_ns, picture))
        if inputs == stops_after:
            bench.deliver("operator", "emergency_stop")

    def rejected_count() -> int:
        rejected_since = total(bench.node.counts, "states_unreadable", "session_replies_unreadable")
        return rejected_before_restarts + rejected_since

    def finish() -> str:
        may_be_none = inputs < FEWEST_INPUTS or stops_after is not None  # few inputs come before the stop
        expect(may_be_none or commands > 0, "the driver sent no commands")
        return f"{commands} commands, {drive_commands} of them in mode drive"

    return Target({"state": states, "session_reply": replies}, feed, rejected_count, finish)


def condition_at_operator(seed: int) -> Target:  # noqa: ARG001 (it uses no random numbers)
    """Make a target for replies to requests of a network condition. Invariant: each readable reply is reported once."""
    node = InjectionClient(
        "alice",
        7,
        condition="L4",
        control=ImpairedFlow("control", "udp", 7448, "destination", Impairment(75.0)),
        video=Impairment(150.0),
        state_delay_ms=0.0,
        start_ns=START.mono_ns,
    )
    bench = NodeBench(node)
    inputs = reported = 0

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs, reported
        inputs += 1
        reported += len(payloads_on(bench.deliver(channel, data), "condition_in_force"))
        bench.advance(STEP_NS)
        if inputs % 500 == 0:
            bench.deliver("injected", InjectionResult(1, "", "", (("control", 75.1),)))

    def rejected_count() -> int:
        return node.counts["netem_replies_unreadable"]

    def finish() -> str:
        expect(reported + rejected_count() == inputs, "replies were neither reported nor rejected")
        return f"{reported} reported to the driver"

    corpus = Corpus([encode(NetemReply(True, "")), encode(NetemReply(False, "bob has control"))], packed=True)
    return Target({"netem_reply": corpus}, feed, rejected_count, finish)


def units(seed: int, number: int) -> list[tuple[int, bytes]]:
    """Return the stamps and access units of `number` small pictures of noise; every tenth access unit is a keyframe."""
    encoder = Encoder(WIDTH_PX, HEIGHT_PX, rate_hz=30, bit_rate_bps=1_000_000, gop_frames=10)
    generator = stream(seed, "fuzz pictures")
    stamped_units = []
    for frame in range(number):
        picture: Picture = generator.integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)
        stamp_ns = START.wall_ns + frame * FRAME_NS
        write_stamp(picture, stamp_ns)
        stamped_units.append((stamp_ns, encoder.encode(picture)))
    return stamped_units


RTP_FIELDS = ((0, 1), (1, 1), (2, 2), (4, 4), (8, 4), (12, 1), (13, 1), (14, 2))
"""Offset and length (bytes) of each field of the RTP header and of the beginning of the payload."""


def video_corpora(encoded: Sequence[bytes]) -> dict[str, Corpus]:
    """Return corpora of media, repair and RTCP datagrams.

    The media and repair datagrams are those of two foreign RTP streams. One of these has the SSRC of the true stream.
    """
    media, repair = [], []
    for foreign in (Packetizer(99, 5), Packetizer(77, 65_100)):
        frames = [foreign.packetize(unit, 3000 * frame) for frame, unit in enumerate(encoded)]
        media += [datagram for frame in frames for datagram in frame]
        repair += RepairSender(98, 0).make_repair_packets(frames[0], 2)
    answer = ReferenceAnswer(RECEIVER_SSRC, 12345, NS_PER_MS)
    reports = [
        sender_report(
            77, wall_ns=START.wall_ns, rtp_timestamp=5, packets=9, octets=900, cname="x@lavt", answered=answers
        )
        for answers in ([], [answer])
    ]
    server = PathServer(lambda: bytes(32))
    server.set_token(TOKEN)
    challenge = server.receive(PathClient(TOKEN).hello(0), ("198.51.100.2", 4000), START.mono_ns) or b""
    return {
        "rtp": Corpus(media, fields=RTP_FIELDS),
        "repair": Corpus(repair, fields=(*RTP_FIELDS, (16, 4), (20, 2), (22, 1), (23, 1))),
        "rtcp": Corpus([*reports, challenge], fields=RTCP_FIELDS),
    }


def video(seed: int) -> Target:
    """Make a target for the client's video port, which also gets a true stream.

    Invariant: the vehicle can decode all feedback that the client sends.
    """
    node = ReceiverNode(JitterBuffer(), Depacketizer(), 2_000_000)
    units_sent = complete_units = inputs = frame = 0

    def on_send(send: Send) -> None:
        nonlocal units_sent, complete_units
        if send.channel == "feedback" and not is_path_datagram(send.payload):
            parse_feedback(send.payload)
        elif send.channel == "access_unit":
            units_sent += 1
            complete_units += send.payload.complete

    bench = NodeBench(node, on_send)
    bench.deliver("path_token", PathToken(TOKEN, 5600))
    packetizer, repairs = Packetizer(77, 65_000), RepairSender(78, 0)
    encoded = [unit for _, unit in units(seed, 30)]
    corpora = video_corpora(encoded[:10])

    def deliver_true_frame() -> None:
        """Deliver the next frame of the true stream; every second frame loses its first packet."""
        nonlocal frame
        datagrams = packetizer.packetize(encoded[frame % len(encoded)], frame * 3000 % 2**32)
        repair_packets = repairs.make_repair_packets(datagrams, frame % 3)
        corpora["rtp"].replays.extend(datagrams)
        corpora["repair"].replays.extend(repair_packets)
        for datagram in (*datagrams[frame % 2 :], *repair_packets):
            bench.deliver("rtp", datagram)
        frame += 1

    def feed(_channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs
        inputs += 1
        bench.deliver("rtp", data)
        bench.advance(STEP_NS)
        if inputs % INPUTS_PER_FRAME == 0:
            deliver_true_frame()

    def rejected_count() -> int:
        unreadable = total(node.counts, "packets_unreadable", "challenges_unreadable")
        return unreadable + total(node.counts, "repair_malformed", "payloads_malformed")

    def finish() -> str:
        recovered = node.counts["packets_recovered"]
        return f"{units_sent} access units, {complete_units} complete, {recovered} packets recovered"

    return Target(corpora, feed, rejected_count, finish)


def pictures(seed: int) -> Target:
    """Make a target for the decoder. Invariant: no picture is shown if its stamp contradicts its RTP timestamp."""
    node = new_driver()
    bench = NodeBench(node)
    true_units = units(seed, 40)
    corpus = Corpus([unit for _, unit in true_units], fields=tuple((offset, 1) for offset in range(64)))
    inputs = views = 0

    def decode_unit(data: bytes, stamp_ns: int, *, complete: bool) -> Sequence[DecodedFrame]:
        unit = ReceivedUnit(data, rtp_timestamp(stamp_ns), complete, complete, bench.now.mono_ns)
        shown: Sequence[DecodedFrame] = payloads_on(bench.deliver("access_unit", unit), "view")
        for view in shown:
            expect(stamp_agrees(view.stamp_ns, unit.rtp_timestamp), "a picture was shown with a wrong stamp")
        return shown

    def feed(_channel: str, data: bytes, chance: Chance) -> None:
        nonlocal inputs, views
        inputs += 1
        decode_unit(data, chance.choice(true_units)[0], complete=bool(chance.below(2)))
        bench.advance(STEP_NS)
        if inputs % 20 == 0:
            views += sum(len(decode_unit(unit, stamp_ns, complete=True)) for stamp_ns, unit in true_units[:2])

    def finish() -> str:
        expect(inputs < FEWEST_INPUTS or views > 0, "no true picture was shown")
        return f"{views} of {inputs // 20 * 2} true pictures shown"

    return Target({"access_unit": corpus}, feed, lambda: node.counts["frames_unreadable"], finish)


def probe_at_operator(seed: int) -> Target:  # noqa: ARG001 (it uses no random numbers)
    """Make a target for clock-probe replies. Invariant: at most one reply to each request is accepted."""
    node = ProbingClockSyncNode(START.mono_ns)
    corpus = Corpus(
        [
            encode_reply(ProbeReply(sequence, START.wall_ns, START.wall_ns + 5, START.wall_ns + 9, 0.1, 0.2))
            for sequence in range(8)
        ],
        fields=PROBE_FIELDS,
    )
    requested = accepted = inputs = 0

    def on_send(send: Send) -> None:
        nonlocal requested, accepted
        accepted += send.channel == "clock_probe"
        if send.channel == "probe_request":
            requested += 1
            sequence, sent_wall_ns = decode_request(send.payload)
            corpus.replays.append(
                encode_reply(ProbeReply(sequence, sent_wall_ns, sent_wall_ns + 5, sent_wall_ns + 9, None, None))
            )

    bench = NodeBench(node, on_send)

    def feed(channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal inputs
        inputs += 1
        bench.deliver(channel, data)
        bench.advance(STEP_NS)

    def finish() -> str:
        expect(accepted <= requested, "two replies to one request were accepted")
        expect(accepted + node.counts["probes_rejected"] == inputs, "replies were neither accepted nor rejected")
        return f"{accepted} of {requested} probes answered"

    return Target({"probe_reply": corpus}, feed, lambda: node.counts["probes_rejected"], finish)


def stamps(seed: int) -> Target:
    """Make a target for stamps in luma planes of any shape. Invariant: a stamp that is read has at most 64 bits."""
    generator = stream(seed, "fuzz planes")
    planes = []
    for number in range(16):
        luma = generator.integers(0, 256, (STAMP_PX, STAMP_PX), dtype=np.uint8)
        write_stamp_luma(luma, START.wall_ns + number)
        planes.append(bytes((STAMP_PX, STAMP_PX)) + luma.tobytes())
    rejections = 0

    def feed(_channel: str, data: bytes, _chance: Chance) -> None:
        nonlocal rejections
        rows, columns = (data[0], data[1]) if len(data) > 1 else (0, 0)
        pixels = np.frombuffer(data[2:], np.uint8)
        is_plane = 0 < rows * columns <= pixels.size
        luma = pixels[: rows * columns].reshape((rows, columns)) if is_plane else pixels
        for read_function in (read_stamp, read_clear_stamp):
            try:
                expect(0 <= read_function(luma) < 2**64, "a stamp of more than 64 bits")
            except BadPacket:
                rejections += 1

    corpus = Corpus(planes, fields=((0, 1), (1, 1), (2, 8)))
    return Target({"luma": corpus}, feed, lambda: rejections)
