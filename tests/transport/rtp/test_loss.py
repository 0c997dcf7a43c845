"""Test when an access unit is `complete`, from encoder to stamp reader, with lost and reordered packets."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, Picture
from lavt.streams import stream
from lavt.transport.rtp.adaptive_hold import MIN_HOLD_NS
from lavt.transport.rtp.jitter_buffer import JitterBuffer, Ordered
from lavt.transport.rtp.rtp import Depacketizer, Packetizer, parse_packet
from lavt.transport.video.h264 import Decoder, Encoder
from lavt.transport.video.stamp import read_stamp, rtp_timestamp, stamp_agrees, write_stamp

FRAMES = 30
GOP_FRAMES = 10
START_NS = 1_790_000_000_000_000_000
FRAME_NS = 33_333_333


def frame_stamp_ns(number: int) -> int:
    return START_NS + number * FRAME_NS


class SentFrames:
    """30 frames with a keyframe every 10: the datagrams of each, and the pictures decoded without loss."""

    def __init__(self) -> None:
        encoder = Encoder(160, 128, rate_hz=30, bit_rate_bps=2_000_000, gop_frames=GOP_FRAMES)
        packetizer = Packetizer(ssrc=7, first_sequence=65_500)
        decoder = Decoder()
        texture = stream(1, "texture").integers(0, 256, (128, 160 + FRAMES, 3), dtype=np.uint8)
        self.datagrams: list[list[bytes]] = []
        self.pictures: dict[int, Picture] = {}
        for number in range(FRAMES):
            picture = texture[:, number : number + 160].copy()
            write_stamp(picture, frame_stamp_ns(number))
            access_unit = encoder.encode(picture)
            self.datagrams.append(packetizer.packetize(access_unit, rtp_timestamp(frame_stamp_ns(number))))
            decoded = decoder.decode(access_unit)
            assert decoded is not None
            self.pictures[rtp_timestamp(frame_stamp_ns(number))] = decoded.picture


@pytest.fixture(scope="module")
def sent() -> SentFrames:
    return SentFrames()


def test_frames_survive_reordering(sent: SentFrames) -> None:
    """If packets are reordered within the hold, every frame arrives complete and with its stamp."""
    generator = stream(1, "delay")
    arrivals = []
    for number, datagrams in enumerate(sent.datagrams):
        delays_ns = generator.integers(0, MIN_HOLD_NS - NS_PER_MS, len(datagrams))
        arrivals += [
            (number * FRAME_NS + int(delay_ns), datagram)
            for delay_ns, datagram in zip(delays_ns, datagrams, strict=True)
        ]
    buffer, depacketizer, decoder = JitterBuffer(), Depacketizer(), Decoder()
    ordered: Ordered = []
    for now_ns, datagram in sorted(arrivals):
        ordered += buffer.push(parse_packet(datagram), now_ns)
    ordered += buffer.expire(FRAMES * FRAME_NS)
    stamps = []
    for packet, lost_before in ordered:
        for unit in depacketizer.push(packet, lost_before):
            decoded = decoder.decode(unit.data)
            assert unit.complete
            assert decoded is not None
            stamps.append(read_stamp(decoded.luma))
            assert stamp_agrees(stamps[-1], unit.timestamp)
    assert stamps == [frame_stamp_ns(number) for number in range(FRAMES)]
    assert buffer.reordered > 0


@settings(max_examples=60)
@given(st.sets(st.integers(0, 500), max_size=12))
@example(set())
def test_only_pictures_before_a_loss_are_trusted(sent: SentFrames, lost: set[int]) -> None:
    """The pictures from a keyframe to the first loss after it are trusted, and equal those decoded without loss."""
    packets = [parse_packet(datagram) for datagrams in sent.datagrams for datagram in datagrams]
    lost = {number % len(packets) for number in lost}
    damaged = {packets[number].timestamp for number in lost}
    depacketizer, decoder = Depacketizer(), Decoder()
    in_doubt, lost_before = True, False
    trusted: list[int] = []
    for number, packet in enumerate(packets):
        if number in lost:
            lost_before = True
            continue
        for unit in depacketizer.push(packet, lost_before):
            in_doubt = not unit.complete or (in_doubt and not unit.keyframe)
            decoded = decoder.decode(unit.data)
            if not in_doubt:
                assert decoded is not None
                assert np.array_equal(decoded.picture, sent.pictures[unit.timestamp])
                assert not decoded.corrupt
                trusted.append(unit.timestamp)
        lost_before = False
    assert depacketizer.malformed == 0
    timestamps = [rtp_timestamp(frame_stamp_ns(number)) for number in range(FRAMES)]
    groups_of_pictures = [timestamps[first : first + GOP_FRAMES] for first in range(0, FRAMES, GOP_FRAMES)]
    assert trusted == [
        timestamp
        for pictures in groups_of_pictures
        for timestamp in itertools.takewhile(lambda timestamp: timestamp not in damaged, pictures)
    ]
