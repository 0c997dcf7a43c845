from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import Lane, Picture, SeenLane
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.rtp import AccessUnit, Depacketizer, Packetizer, parse_packet
from lavt.transport.video.frame_codec import MAX_STORED_PICTURES, InMemoryFrameCodec, LaneReceiver, LaneSender

NUMBERS = st.floats(allow_nan=False)
STAMP_NS = 1_790_000_000_123_456_789


def send_over_rtp(access_units: list[bytes], lost: int | None = None) -> list[AccessUnit]:
    """Send access units as packets, of which one may be lost, and return the access units that arrive."""
    packetizer, jitter_buffer, depacketizer = Packetizer(7, 65_530), JitterBuffer(), Depacketizer()
    packets = [packet for number, unit in enumerate(access_units) for packet in packetizer.packetize(unit, number)]
    assert len(packets) == len(access_units), "one packet for each access unit"
    ordered = [
        pair
        for number, packet in enumerate(packets)
        if number != lost
        for pair in jitter_buffer.push(parse_packet(packet), number)
    ]
    ordered += jitter_buffer.expire(10**9)
    return [unit for packet, lost_before in ordered for unit in depacketizer.push(packet, lost_before)]


def picture(number: int) -> Picture:
    return np.random.default_rng(number).integers(0, 256, (96, 128, 3), dtype=np.uint8)


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.lists(NUMBERS, min_size=7, max_size=7))
def test_a_lane_arrives_as_it_was_sent(stamp_ns: int, at_ns: int, values: list[float]) -> None:
    """A lane and its stamp arrive through RTP bit for bit."""
    c0, c1, c2, *rest = values
    sender, receiver = LaneSender(), LaneReceiver()
    stamped = sender.write_stamp(SeenLane(0, at_ns, Lane((c0, c1, c2), *rest)), stamp_ns)
    (unit,) = send_over_rtp([sender.encode(stamped, keyframe=False)])
    received = receiver.decode(unit.data)
    assert received is not None
    assert received.picture == stamped
    assert receiver.read_stamp(received) == stamp_ns


def test_two_lanes_of_a_stationary_car_differ() -> None:
    """The checksum of a lane depends on its time, so a stationary car is not taken for a frozen camera."""
    lane = Lane((0.0, 0.0, 0.0), 3.5, 3.6, 20.0, 1.0)
    one, same, later = (LaneSender().prepare(SeenLane(0, at_ns, lane))[1] for at_ns in (1, 1, 2))
    assert one == same
    assert one != later


@pytest.mark.parametrize("data", [b"", b"\x00\x00\x00\x01\x09\xf0\x00\x00\x00\x01\x65", b"\x00\x00\x00\x01\x65abc"])
def test_foreign_access_units_give_no_picture(data: bytes) -> None:
    """Access units with other contents give no picture and raise nothing."""
    assert LaneReceiver().decode(data) is None
    assert InMemoryFrameCodec().decode(data) is None


def test_pixels_arrive_as_they_were_rendered() -> None:
    """A received picture has the pixels and the stamp that it had when it was encoded, and can be decoded once."""
    codec = InMemoryFrameCodec()
    stamped = codec.write_stamp(picture(1), STAMP_NS)
    (unit,) = send_over_rtp([codec.encode(stamped, keyframe=False)])
    expected = stamped.copy()
    stamped[:] = 0  # the camera reuses its buffer
    received = codec.decode(unit.data)
    assert received is not None
    assert np.array_equal(received.picture, expected)
    assert codec.read_stamp(received) == STAMP_NS
    assert codec.decode(unit.data) is None


def test_a_lost_picture_damages_no_other() -> None:
    """Access units are independent: after a loss the next one is complete, and the lost picture is dropped."""
    codec = InMemoryFrameCodec()
    units = send_over_rtp([codec.encode(picture(number), keyframe=False) for number in range(4)], lost=1)
    assert [unit.complete for unit in units] == [True, True, True]
    received = [codec.decode(unit.data) for unit in units]
    assert [
        np.array_equal(rendered.picture, picture(number))
        for rendered, number in zip(received, (0, 2, 3), strict=True)
        if rendered
    ]
    assert not codec._pictures


def test_pictures_that_never_arrive_fill_no_memory() -> None:
    """If no picture arrives, only the newest 300 are stored."""
    codec = InMemoryFrameCodec()
    units = [codec.encode(picture(0)[:1], keyframe=False) for _ in range(MAX_STORED_PICTURES + 5)]
    assert codec.decode(units[4]) is None
    assert codec.decode(units[5]) is not None
