from __future__ import annotations

import itertools
from fractions import Fraction

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.errors import BadPacket, UserError
from lavt.streams import stream
from lavt.transport.rtp.rtp import AccessUnit, Depacketizer, Packetizer, RtpPacket, parse_packet, split_nal_units
from lavt.transport.video.h264 import Encoder

MAX_ACCESS_UNIT_BYTES = 2 * 1024 * 1024
"""The design's limit, repeated here: a change of the code's limit must change this one, too."""
START = b"\x00\x00\x00\x01"
SPS, PPS, IDR, SLICE = b"\x67\x42\xc0\x1e", b"\x68\xce\x3c\x80", b"\x65", b"\x41"

PACKETS = st.builds(
    RtpPacket,
    payload_type=st.integers(0, 127),
    sequence=st.integers(0, 2**16 - 1),
    timestamp=st.integers(0, 2**32 - 1),
    ssrc=st.integers(0, 2**32 - 1),
    marker=st.booleans(),
    payload=st.binary(max_size=100),
)
# NAL units as an encoder makes them: of types 1 to 23, without start codes, and without a zero at the end.
BODIES = st.binary(max_size=5000).map(lambda body: body.replace(b"\x00", b"\x07"))
NAL_UNITS = st.builds(lambda kind, body: bytes([0x60 | kind]) + body + b"\x80", st.integers(1, 23), BODIES)


def byte_stream(*units: bytes) -> bytes:
    return b"".join(START + unit for unit in units)


def packetize(access_unit: bytes, timestamp: int = 1, max_packet_bytes: int = 1200) -> list[RtpPacket]:
    packetizer = Packetizer(ssrc=7, first_sequence=0, max_packet_bytes=max_packet_bytes)
    return [parse_packet(datagram) for datagram in packetizer.packetize(access_unit, timestamp)]


def push_all(depacketizer: Depacketizer, packets: list[RtpPacket], lost_before: bool = False) -> list[AccessUnit]:
    flags = itertools.chain([lost_before], itertools.repeat(False))
    return [unit for packet in packets for unit in depacketizer.push(packet, next(flags))]


def packet(payload: bytes, timestamp: int = 1, marker: bool = False) -> RtpPacket:
    return RtpPacket(96, 0, timestamp, 7, marker, payload)


KEYFRAME = byte_stream(SPS, PPS, IDR + b"\x88" + b"k" * 5000)
PICTURE = byte_stream(SLICE + b"\x9a" + b"p" * 3000)


@given(PACKETS)
def test_packet_round_trip(sent: RtpPacket) -> None:
    """A written packet is parsed back unchanged."""
    assert parse_packet(sent.to_bytes()) == sent


def test_header_as_in_the_rfc() -> None:
    """The header has the format of RFC 3550."""
    sent = RtpPacket(96, 0x0102, 0x03040506, 0x0708090A, marker=True, payload=b"x")
    assert sent.to_bytes() == bytes.fromhex("80 e0 0102 03040506 0708090a") + b"x"
    parsed = parse_packet(bytes.fromhex("80 80 0102 03040506 0708090a"))
    assert (parsed.payload_type, parsed.marker) == (0, True)


def test_optional_parts_of_a_packet() -> None:
    """Contributing sources, header extension and padding are not part of the payload."""
    fixed = bytes.fromhex("b2 60 0102 03040506 0708090a")
    sources, extension = b"c" * 8, bytes.fromhex("bede 0002") + b"e" * 8
    assert parse_packet(fixed + sources + extension + b"payload" + b"\x00\x00\x03").payload == b"payload"
    assert parse_packet(bytes.fromhex("90 60 0102 03040506 0708090a bede 0000")).payload == b""


@pytest.mark.parametrize(
    "datagram",
    [
        "",
        "80 60 0102 03040506 070809",  # a header that is too short
        "40 60 0102 03040506 0708090a",  # version 1
        "82 60 0102 03040506 0708090a 00000000",  # one contributing source instead of two
        "90 60 0102 03040506 0708090a bede",  # half the header of an extension
        "90 60 0102 03040506 0708090a bede 0002 00000000",  # one word of an extension instead of two
        "a0 60 0102 03040506 0708090a 0000",  # padding of length 0
        "a0 60 0102 03040506 0708090a 0003",  # two bytes of padding instead of three
    ],
)
def test_invalid_rtp_is_rejected(datagram: str) -> None:
    """A datagram of another version, or shorter than its header says, raises `BadPacket`."""
    with pytest.raises(BadPacket):
        parse_packet(bytes.fromhex(datagram))


@given(st.binary(max_size=80))
def test_any_bytes_as_packet(data: bytes) -> None:
    """For any datagram the parser raises nothing but `BadPacket`."""
    for datagram in (data, b"\xbf" + data):
        try:
            parsed = parse_packet(datagram)
        except BadPacket:
            continue
        assert datagram[0] >> 6 == 2
        assert parsed.payload in datagram


def test_nal_units_are_split() -> None:
    """NAL units are found after long and short start codes, without trailing zeros and empty units."""
    assert split_nal_units(b"junk" + START + SPS + b"\x00\x00\x01" + PPS + b"\x00\x00" + START + START + IDR) == [
        SPS,
        PPS,
        IDR,
    ]
    assert split_nal_units(b"\x00\x00\x01" + SPS) == [SPS]
    assert split_nal_units(b"no start code") == []
    assert split_nal_units(b"") == []


@given(st.lists(NAL_UNITS, min_size=1, max_size=8), st.integers(64, 1500), st.integers(0, 2**32 - 1))
def test_access_unit_round_trip(units: list[bytes], max_packet_bytes: int, timestamp: int) -> None:
    """Any access unit is reassembled byte for byte and complete with its last packet."""
    data = byte_stream(*units)
    packets = packetize(data, timestamp, max_packet_bytes)
    depacketizer = Depacketizer()
    assert push_all(depacketizer, packets[:-1]) == []
    keyframe = any(unit[0] & 0x1F == 5 for unit in units)
    assert depacketizer.push(packets[-1], False) == [AccessUnit(data, timestamp, complete=True, keyframe=keyframe)]
    assert depacketizer.malformed == 0


@given(st.lists(NAL_UNITS, min_size=1, max_size=8), st.integers(64, 1500))
def test_size_and_numbers_of_packets(units: list[bytes], max_packet_bytes: int) -> None:
    """Packets have the size limit, one timestamp and consecutive numbers, also at the wrap; the last has the marker."""
    packetizer = Packetizer(ssrc=9, first_sequence=65_534, payload_type=99, max_packet_bytes=max_packet_bytes)
    datagrams = packetizer.packetize(byte_stream(*units), 1234)
    packets = [parse_packet(datagram) for datagram in datagrams]
    assert max(len(datagram) for datagram in datagrams) <= max_packet_bytes
    assert [sent_packet.sequence for sent_packet in packets] == [
        (65_534 + index) % 2**16 for index in range(len(packets))
    ]
    assert [sent_packet.marker for sent_packet in packets] == [False] * (len(packets) - 1) + [True]
    assert {(sent_packet.timestamp, sent_packet.ssrc, sent_packet.payload_type) for sent_packet in packets} == {
        (1234, 9, 99)
    }
    assert packetizer.next_sequence == (65_534 + len(packets)) % 2**16


def test_packet_types() -> None:
    """Small units share a STAP-A, a single small unit is sent unchanged, and a large one is split into equal FU-As."""
    packets = packetize(KEYFRAME)
    assert packets[0].payload == bytes([0x78]) + b"\x00\x04" + SPS + b"\x00\x04" + PPS
    fragments = packets[1:]
    assert [sent_packet.payload[0] for sent_packet in fragments] == [0x7C] * 5
    assert [sent_packet.payload[1] for sent_packet in fragments] == [0x85, 0x05, 0x05, 0x05, 0x45]
    sizes = [len(sent_packet.payload) for sent_packet in fragments]
    assert max(sizes) - min(sizes) <= 1
    assert [sent_packet.payload for sent_packet in packetize(START + SLICE + b"small")] == [SLICE + b"small"]


@pytest.mark.parametrize("units", [(b"\x06sei", b"\x41slice"), (b"\x41slice", b"\x06sei")])
def test_nal_ref_idc_of_a_stap_a(units: tuple[bytes, bytes]) -> None:
    """A STAP-A has the highest NRI of its units (RFC 6184, section 5.7.1)."""
    (shared,) = packetize(byte_stream(*units))
    assert shared.payload[0] == 0x58


def test_headers_of_fragments() -> None:
    """Each fragment has the NRI and type of its unit, the first also the start bit and the last the end bit."""
    payloads = [sent_packet.payload for sent_packet in packetize(START + b"\x46" + b"s" * 5000)]
    assert [payload[:2].hex() for payload in payloads] == ["5c86", "5c06", "5c06", "5c06", "5c46"]


@pytest.mark.parametrize(
    ("unit_bytes", "types"),
    [([1188], [1]), ([1189], [28, 28]), ([1000, 183], [24]), ([1000, 184], [1, 1]), ([100, 1189, 100], [1, 28, 28, 1])],
)
def test_capacity_of_a_packet(unit_bytes: list[int], types: list[int]) -> None:
    """A packet of 1200 bytes has room for one unit of 1188 bytes, or for several units and their size fields."""
    packets = packetize(byte_stream(*(SLICE + b"p" * (size - 1) for size in unit_bytes)))
    assert [sent_packet.payload[0] & 0x1F for sent_packet in packets] == types


def test_the_first_sequence_number_wraps() -> None:
    """A first sequence number is taken modulo 2^16."""
    assert Packetizer(1, 2**16).next_sequence == 0
    assert Packetizer(1, 2**16 - 1).next_sequence == 2**16 - 1


def test_nothing_to_send() -> None:
    """An access unit without NAL units gives no packets."""
    assert Packetizer(1, 0).packetize(b"", 1) == []


@pytest.mark.parametrize("size", [0, 63, 65_508])
def test_invalid_packet_size_is_rejected(size: int) -> None:
    """A packet size that no stream can use is rejected."""
    with pytest.raises(UserError, match="choose"):
        Packetizer(1, 0, max_packet_bytes=size)


@pytest.mark.parametrize("size", [64, 65_507])
def test_smallest_and_largest_packet_size(size: int) -> None:
    """Packets may have 64 to 65 507 bytes, the most that a datagram has room for."""
    sizes = [
        len(sent_packet.to_bytes())
        for sent_packet in packetize(START + SLICE + b"p" * (size - 13), max_packet_bytes=size)
    ]
    assert sizes == [size]


@pytest.mark.parametrize("missing", range(6))
def test_a_packet_is_lost(missing: int) -> None:
    """If any packet of a keyframe is lost, the keyframe is returned once, incomplete; the next one is complete."""
    depacketizer = Depacketizer()
    first, second = packetize(KEYFRAME, 1), packetize(KEYFRAME, 2)
    units = push_all(depacketizer, first[:missing])
    units += push_all(depacketizer, first[missing + 1 :] + second[:1], lost_before=True)
    units += push_all(depacketizer, second[1:])
    assert [(unit.timestamp, unit.complete) for unit in units] == [(1, False), (2, True)]
    assert units[0].data != KEYFRAME
    assert units[1].data == KEYFRAME
    assert depacketizer.malformed == 0


def test_fragments_before_a_gap_are_kept() -> None:
    """If a fragment of a NAL unit is lost, the earlier fragments are kept and the later ones are dropped."""
    packets = packetize(KEYFRAME)
    depacketizer = Depacketizer()
    push_all(depacketizer, packets[:3])
    (unit,) = push_all(depacketizer, packets[4:], lost_before=True)
    assert unit.data == KEYFRAME[: len(unit.data)]
    assert len(unit.data) == len(byte_stream(SPS, PPS)) + 4 + 1 + sum(
        len(sent_packet.payload) - 2 for sent_packet in packets[1:3]
    )


def test_a_whole_access_unit_is_lost() -> None:
    """A picture directly after a lost one is incomplete, unless it is a keyframe with parameter sets."""
    depacketizer = Depacketizer()
    units = push_all(depacketizer, packetize(PICTURE, 1), lost_before=True)
    units += push_all(depacketizer, packetize(PICTURE, 2))
    units += push_all(depacketizer, packetize(KEYFRAME, 3), lost_before=True)
    units += push_all(depacketizer, packetize(START + IDR + b"alone", 4), lost_before=True)
    assert [unit.complete for unit in units] == [False, True, True, False]


def test_only_a_keyframe_is_complete_after_a_loss() -> None:
    """After a loss an access unit that is not a keyframe is incomplete, even if it begins with a delimiter."""
    for head in (b"\x09\x10", SPS):
        (unit,) = push_all(Depacketizer(), packetize(byte_stream(head, SLICE + b"p"), 1), lost_before=True)
        assert not unit.complete


@pytest.mark.parametrize(
    ("head", "complete"), [(b"\x09\x10", True), (SPS, True), (PPS, False), (b"\x06sei", False), (b"\x0aend", False)]
)
def test_a_keyframe_after_a_loss(head: bytes, *, complete: bool) -> None:
    """After a loss a keyframe is complete only if it begins with a delimiter or a sequence parameter set."""
    packets = packetize(byte_stream(head, IDR + b"k"))
    assert [unit.complete for unit in push_all(Depacketizer(), packets, lost_before=True)] == [complete]


def test_empty_fragments() -> None:
    """A fragment of a unit may be empty (RFC 6184, section 5.8)."""
    payloads = [b"\x7c\x85", b"\x7c\x05", b"\x7c\x05k", b"\x7c\x45"]
    packets = [packet(payload, marker=payload is payloads[-1]) for payload in payloads]
    assert push_all(Depacketizer(), packets) == [AccessUnit(byte_stream(IDR + b"k"), 1, complete=True, keyframe=True)]


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_a_slice_is_lost(missing: int) -> None:
    """A picture with a slice in each packet is incomplete if any slice is lost."""
    packets = [packet(SLICE + b"%d" % number, 1, marker=number == 2) for number in range(3)]
    depacketizer = Depacketizer()
    units = push_all(depacketizer, packets[:missing])
    units += push_all(depacketizer, [*packets[missing + 1 :], packet(SLICE, 2)], lost_before=True)
    assert [(unit.timestamp, unit.complete) for unit in units] == [(1, False)]


def test_access_unit_of_useless_fragments() -> None:
    """An access unit of which only useless fragments arrived is returned empty and incomplete."""
    (unit,) = push_all(Depacketizer(), packetize(PICTURE)[1:], lost_before=True)
    assert unit == AccessUnit(b"", 1, complete=False, keyframe=False)


def test_next_packet_replaces_a_lost_marker() -> None:
    """If the marker packet is lost, the access unit is returned with the first packet of the next one."""
    depacketizer = Depacketizer()
    small = byte_stream(SPS, PPS, IDR + b"s")
    assert push_all(depacketizer, packetize(PICTURE, 1)[:-1]) == []
    units = push_all(depacketizer, packetize(small, 2), lost_before=True)
    assert [(unit.timestamp, unit.complete) for unit in units] == [(1, False), (2, True)]


def test_sender_without_markers() -> None:
    """Without markers an access unit is returned complete when the next one begins."""
    depacketizer = Depacketizer()
    assert depacketizer.push(packet(SLICE + b"one", 1), False) == []
    assert depacketizer.push(packet(SLICE + b"two", 2), False) == [
        AccessUnit(byte_stream(SLICE + b"one"), 1, complete=True, keyframe=False)
    ]


MALFORMED = {
    "empty": b"",
    "forbidden bit": b"\xc1abc",
    "forbidden bit of a STAP-A": b"\xf8\x00\x01A",
    "forbidden bit of an FU-A": b"\xfc\x05abc",
    "type 0": b"\x60abc",
    "type 31": b"\x7fabc",
    "STAP-B": b"\x79abc",
    "FU-B": b"\x7d\x85abc",
    "empty STAP-A": b"\x78",
    "STAP-A cut off": b"\x78\x00\x04abc",
    "STAP-A with an empty unit": b"\x78\x00\x00\x00\x01A",
    "STAP-A that ends with an empty unit": b"\x78\x00\x00",
    "STAP-A with half a size": b"\x78\x00",
    "STAP-A in STAP-A": b"\x78\x00\x01\x78",
    "FU-A without header": b"\x7c",
    "FU-A that starts and ends": b"\x7c\xc5abc",
    "FU-A of type 28": b"\x7c\x9cabc",
    "FU-A that starts type 0": b"\x7c\x80abc",
    "FU-A that continues type 0": b"\x7c\x00abc",
    "FU-A that ends type 0": b"\x7c\x40abc",
}


@pytest.mark.parametrize("payload", MALFORMED.values(), ids=MALFORMED.keys())
def test_malformed_payload_is_counted(payload: bytes) -> None:
    """A payload that is not H.264 in mode 1 is counted and makes only its access unit incomplete."""
    depacketizer = Depacketizer()
    assert depacketizer.push(packet(SLICE + b"good"), False) == []
    (unit,) = depacketizer.push(packet(payload, marker=True), False)
    assert depacketizer.malformed == 1
    assert not unit.complete
    assert unit.data.startswith(byte_stream(SLICE + b"good"))
    (next_unit,) = depacketizer.push(packet(SLICE + b"next", 2, marker=True), False)
    assert next_unit.complete


@pytest.mark.parametrize(
    "payloads",
    [
        [b"\x7c\x81start", SLICE],
        [b"\x7c\x81start", b"\x7c\x81again", b"\x7c\x41end"],
        [b"\x7c\x81start", b"\x7c\x45end of another"],
        [b"\x7c\x81start"],
        [b"\x7c\x41end"],
    ],
)
def test_fragments_without_end(payloads: list[bytes]) -> None:
    """A fragmented unit without start or end makes its access unit incomplete, even if no packet is missing."""
    packets = [packet(payload) for payload in payloads]
    units = push_all(Depacketizer(), [*packets[:-1], packet(payloads[-1], marker=True)])
    assert [unit.complete for unit in units] == [False]


def test_fragments_of_another_unit_end_a_fragmented_unit() -> None:
    """After a fragment of another type the remaining fragments of a unit are dropped."""
    payloads = [b"\x7c\x81start", b"\x7c\x05other", b"\x7c\x41end"]
    packets = [packet(payload, marker=payload is payloads[-1]) for payload in payloads]
    assert push_all(Depacketizer(), packets) == [
        AccessUnit(byte_stream(b"\x61start"), 1, complete=False, keyframe=False)
    ]


def test_access_unit_without_end_uses_bounded_memory() -> None:
    """An access unit without end uses bounded memory; payloads beyond the limit are counted as malformed."""
    depacketizer = Depacketizer()
    piece = packet(SLICE + bytes(60_000))
    count = MAX_ACCESS_UNIT_BYTES // 60_000 + 5
    assert push_all(depacketizer, [piece] * count) == []
    assert depacketizer.malformed > 0
    (unit,) = depacketizer.push(packet(SLICE, marker=True), False)
    assert not unit.complete
    assert len(unit.data) <= MAX_ACCESS_UNIT_BYTES + 4


@pytest.mark.parametrize(("more_bytes", "malformed"), [(0, 0), (1, 1)])
def test_the_largest_access_unit(more_bytes: int, malformed: int) -> None:
    """An access unit of the largest size is complete; a packet that would make it longer is malformed."""
    depacketizer = Depacketizer()
    depacketizer.push(packet(SLICE + bytes(999)), False)
    # The first NAL unit has a start code before its 1000 bytes.
    last = SLICE + bytes(MAX_ACCESS_UNIT_BYTES - 1004 - 1 + more_bytes)
    (unit,) = depacketizer.push(packet(last, marker=True), False)
    assert (depacketizer.malformed, unit.complete) == (malformed, not malformed)


HEADS = st.sampled_from(
    [b"", b"\x41", b"\x65", b"\x67", b"\x78", b"\x78\x00\x02", b"\x7c\x85", b"\x7c\x05", b"\x7c\x45"]
)
PAYLOADS = st.builds(lambda head, tail: head + tail, HEADS, st.binary(max_size=20))


@given(st.lists(st.tuples(PAYLOADS, st.integers(0, 2), st.booleans(), st.booleans()), max_size=30))
def test_any_payloads(steps: list[tuple[bytes, int, bool, bool]]) -> None:
    """Arbitrary payloads raise nothing and do not affect later access units; a push returns at most two units."""
    depacketizer = Depacketizer()
    for payload, timestamp, marker, lost_before in steps:
        units = depacketizer.push(packet(payload, timestamp, marker), lost_before)
        assert len(units) <= 2
        assert all(unit.data or not unit.complete for unit in units)
        if marker:
            assert units[-1].timestamp == timestamp
    depacketizer.push(packet(b"", 3, marker=True), False)
    (last,) = depacketizer.push(packet(SLICE + b"x", 4, marker=True), False)
    assert last == AccessUnit(byte_stream(SLICE + b"x"), 4, complete=True, keyframe=False)


class DatagramList:
    """A file object that collects the datagrams of FFmpeg's RTP sender."""

    def __init__(self) -> None:
        self.datagrams: list[bytes] = []

    def write(self, datagram: bytes) -> int:
        """Store one datagram."""
        self.datagrams.append(bytes(datagram))
        return len(datagram)


def test_stream_of_ffmpeg_is_reassembled() -> None:
    """A stream sent by FFmpeg's RTP sender is reassembled with unchanged NAL units."""
    noise = stream(1, "noise")
    encoder = Encoder(160, 128, rate_hz=30, bit_rate_bps=2_000_000, gop_frames=4)
    sent = [encoder.encode(noise.integers(0, 256, (128, 160, 3), dtype=np.uint8)) for _ in range(8)]
    file = DatagramList()
    options = {"packetsize": "1200", "rtpflags": "skip_rtcp", "payload_type": "96"}
    with av.open(file, "w", format="rtp", options=options) as container:
        video = container.add_stream("libx264", rate=30, width=160, height=128, pix_fmt="yuv420p")
        for number, access_unit in enumerate(sent):
            av_packet = av.Packet(access_unit)
            av_packet.stream, av_packet.time_base, av_packet.pts, av_packet.dts = (
                video,
                Fraction(1, 90_000),
                number * 3000,
                number * 3000,
            )
            container.mux(av_packet)
    units = push_all(Depacketizer(), [parse_packet(datagram) for datagram in file.datagrams])
    assert [split_nal_units(unit.data) for unit in units] == [split_nal_units(access_unit) for access_unit in sent]
    assert all(unit.complete for unit in units)
    assert [unit.keyframe for unit in units] == [number % 4 == 0 for number in range(8)]
    assert {unit.timestamp - units[0].timestamp - 3000 * number for number, unit in enumerate(units)} <= {0, -(2**32)}
