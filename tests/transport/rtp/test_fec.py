from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.rtp.fec import RedundancyController, RepairReceiver, RepairSender
from lavt.transport.rtp.rtp import Depacketizer, Packetizer, RtpPacket, parse_packet

REPAIR_PAYLOAD_TYPE, MAX_SYMBOL_BYTES = 97, 1500
MAX_STORED_MEDIA, MAX_OPEN_BLOCKS, BLOCK_TIMEOUT_NS = 4096, 64, 500 * NS_PER_MS
"""The design's limits, repeated here: a change of the code's limits must change these, too."""
MEDIA_SSRC, REPAIR_SSRC = 0x01020304, 0x0A0B0C0D


def frame(
    payloads: Iterable[bytes], first: int = 100, timestamp: int = 9000, ssrc: int = MEDIA_SSRC
) -> list[RtpPacket]:
    payloads = list(payloads)
    last = len(payloads) - 1
    return [
        RtpPacket(96, (first + index) % 2**16, timestamp, ssrc, index == last, payload)
        for index, payload in enumerate(payloads)
    ]


def repair_packets(packets: list[RtpPacket], count: int) -> list[RtpPacket]:
    datagrams = RepairSender(REPAIR_SSRC, 0).repair([packet.to_bytes() for packet in packets], count)
    return [parse_packet(datagram) for datagram in datagrams]


def push_all(receiver: RepairReceiver, packets: Iterable[RtpPacket], now_ns: int = 0) -> list[RtpPacket]:
    return [recovered for packet in packets for recovered in receiver.push(packet, now_ns)]


class Counters(NamedTuple):
    """The counters of a repair receiver."""

    recovered: int = 0
    malformed: int = 0
    unrepaired: int = 0


def counters(receiver: RepairReceiver) -> Counters:
    return Counters(receiver.recovered, receiver.malformed, receiver.unrepaired)


EIGHT_PACKETS = frame(bytes([index]) * (20 + index) for index in range(8))
REPAIRS = repair_packets(EIGHT_PACKETS, 2)


def replace_bytes(packet: RtpPacket, changed_bytes: Mapping[int, int]) -> RtpPacket:
    """Return the repair packet with other bytes at these positions of its payload."""
    payload = bytearray(packet.payload)
    for position, byte in changed_bytes.items():
        payload[position] = byte
    return replace_payload(packet, bytes(payload))


def replace_payload(packet: RtpPacket, payload: bytes) -> RtpPacket:
    return RtpPacket(packet.payload_type, packet.sequence, packet.timestamp, packet.ssrc, packet.marker, payload)


def test_bytes_of_a_repair_packet() -> None:
    """A repair packet has the format of docs/wire.md; for a frame of one packet, both parities are its bytes."""
    media = RtpPacket(96, 0xFFFE, 0x05060708, MEDIA_SSRC, marker=True, payload=b"abc")
    repairs = RepairSender(REPAIR_SSRC, 0xFFFF).repair([media.to_bytes()], 2)
    header = "01 60 fffe 01020304 0001 00"
    assert repairs == [
        bytes.fromhex("80 61 ffff 05060708 0a0b0c0d" + header + "00 0003") + b"abc",
        bytes.fromhex("80 61 0000 05060708 0a0b0c0d" + header + "01 0003") + b"abc",
    ]


def test_bytes_of_p_and_q() -> None:
    """The repair packets of the example frame in docs/wire.md have its parities P and Q."""
    repairs = repair_packets(frame([b"\x61\x62\x63", b"\xc4"]), 2)
    assert [repair.payload[12:].hex(" ") for repair in repairs] == ["00 02 a5 62 63", "00 01 f4 62 63"]


@pytest.mark.parametrize(
    ("packets", "blocks"), [(0, 0), (1, 1), (16, 1), (17, 2), (32, 2), (33, 3), (4080, 255), (4081, 0)]
)
def test_number_of_blocks(packets: int, blocks: int) -> None:
    """A frame is split into as few blocks of up to 16 packets as possible; above 255 blocks there is no repair."""
    media = frame([b"x"] * packets)
    for count in (0, 1, 2):
        assert len(repair_packets(media, count)) == blocks * count


def test_order_of_repair_packets() -> None:
    """The first repair packet of every block is sent before the second one of any block."""
    repairs = repair_packets(frame([b"x"] * 33), 2)
    assert [tuple(repair.payload[10:12]) for repair in repairs] == [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1)]
    assert [repair.sequence for repair in repairs] == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("count", [-1, 3])
def test_invalid_number_of_repair_packets(count: int) -> None:
    """A number of repair packets other than 0, 1 or 2 is rejected."""
    with pytest.raises(UserError, match="choose"):
        RepairSender(1, 0).repair([], count)


def test_repair_packets_are_small() -> None:
    """A repair packet is 14 bytes longer than the packets of 1200 bytes that it protects."""
    media = frame([b"x" * 1188] * 8)
    assert [len(repair.to_bytes()) for repair in repair_packets(media, 2)] == [1214, 1214]


@pytest.mark.parametrize(("payload_bytes", "repairs"), [(1498, 2), (1499, 0)])
def test_long_packets_get_no_repair(payload_bytes: int, repairs: int) -> None:
    """A frame with a payload of more than 1498 bytes gets no repair packets; one with 1498 bytes does."""
    media = frame([b"short", b"x" * payload_bytes])
    assert len(repair_packets(media, 2)) == repairs
    receiver = RepairReceiver()
    assert push_all(receiver, [media[0], *repair_packets(media, 2)]) == media[1:][:repairs]


def test_the_largest_frame() -> None:
    """Packets of a frame of 255 blocks are recovered, and repair packets of a larger one are malformed."""
    media = frame([b"x"] * 4080)
    repairs = repair_packets(media, 1)
    receiver = RepairReceiver()
    assert push_all(receiver, [*media[:4079], repairs[254]]) == [media[4079]]
    # 4081 packets are 256 blocks.
    assert push_all(receiver, [replace_bytes(repairs[0], {8: 0x0F, 9: 0xF1})]) == []
    assert counters(receiver) == Counters(recovered=1, malformed=1)


def test_the_first_sequence_number_wraps() -> None:
    """A first sequence number is taken modulo 2^16."""
    assert RepairSender(1, 2**16).next_sequence == 0
    assert RepairSender(1, 2**16 - 1).next_sequence == 2**16 - 1


def test_burst_is_recovered() -> None:
    """A burst of as many packets as there are blocks is recovered from one repair packet for each block."""
    media = frame(bytes([index]) * 5 for index in range(40))
    receiver = RepairReceiver()
    arrived = [*media[:11], *media[14:], *repair_packets(media, 1)]
    assert sorted(push_all(receiver, arrived), key=lambda packet: packet.sequence) == media[11:14]
    assert counters(receiver) == Counters(recovered=3)


@pytest.mark.parametrize("lost", list(itertools.combinations(range(8), 2)))
def test_any_two_lost_packets_are_recovered(lost: tuple[int, int]) -> None:
    """Any two lost packets of a block are recovered from two repair packets: unchanged, in order and once."""
    receiver = RepairReceiver()
    arrived = [packet for index, packet in enumerate(EIGHT_PACKETS) if index not in lost]
    assert push_all(receiver, arrived) == []
    assert receiver.push(REPAIRS[0], 0) == []
    assert receiver.push(REPAIRS[1], 0) == [EIGHT_PACKETS[index] for index in lost]
    assert push_all(receiver, [*REPAIRS, *EIGHT_PACKETS]) == []
    assert counters(receiver) == Counters(recovered=2)


def test_media_after_repair() -> None:
    """A media packet that arrives after the repair packet also completes a block."""
    receiver = RepairReceiver()
    assert push_all(receiver, [*EIGHT_PACKETS[:6], REPAIRS[0]]) == []
    assert receiver.push(EIGHT_PACKETS[7], 0) == [EIGHT_PACKETS[6]]
    assert receiver.push(EIGHT_PACKETS[6], 0) == []
    assert counters(receiver) == Counters(recovered=1)


def test_nothing_lost() -> None:
    """Without loss no packet is recovered, no block stays open and no counter changes."""
    receiver = RepairReceiver()
    assert push_all(receiver, [*EIGHT_PACKETS, *REPAIRS]) == []
    assert receiver._open == {}
    assert receiver.push(EIGHT_PACKETS[0], BLOCK_TIMEOUT_NS) == []
    assert counters(receiver) == Counters()


def test_repair_before_media() -> None:
    """Two repair packets that arrive before the media replace two media packets, which are then returned only once."""
    receiver = RepairReceiver()
    assert push_all(receiver, [*REPAIRS, *EIGHT_PACKETS[:5]]) == []
    assert receiver.push(EIGHT_PACKETS[5], 0) == EIGHT_PACKETS[6:]
    assert push_all(receiver, EIGHT_PACKETS[6:]) == []
    assert receiver._open == {}
    assert counters(receiver) == Counters(recovered=2)


def test_block_is_given_up_after_half_a_second() -> None:
    """A block with more losses than repair packets is given up after half a second, and counted."""
    receiver = RepairReceiver()
    push_all(receiver, [*EIGHT_PACKETS[:6], REPAIRS[0]], now_ns=7)
    next_frame = frame([b"n"], first=108, timestamp=12_000)
    receiver.push(next_frame[0], 7 + BLOCK_TIMEOUT_NS - 1)
    assert counters(receiver) == Counters()
    assert receiver.push(EIGHT_PACKETS[6], 7 + BLOCK_TIMEOUT_NS) == []
    assert counters(receiver) == Counters(unrepaired=1)


FRAMES = st.lists(st.binary(min_size=1, max_size=60), min_size=1, max_size=60)


@given(FRAMES, FRAMES, st.integers(1, 2), st.integers(0, 2**16 - 1), st.data())
def test_any_loss_within_the_repair_is_recovered(
    payloads: list[bytes], next_payloads: list[bytes], count: int, first: int, data: st.DataObject
) -> None:
    """A block is recovered if at least as many repair packets arrive as packets were lost, in any order."""
    frames = [frame(payloads, first), frame(next_payloads, first + len(payloads), 12_000)]
    sent = [packet for media in frames for packet in media + repair_packets(media, count)]
    lost = data.draw(st.sets(st.integers(0, len(sent) - 1), max_size=12))
    twice = data.draw(st.lists(st.integers(0, len(sent) - 1), max_size=6))
    arrived = [packet for index, packet in enumerate(sent) if index not in lost]
    arrived += [sent[index] for index in twice if index not in lost]
    arrived = data.draw(st.one_of(st.just(arrived), st.permutations(arrived)))
    receiver = RepairReceiver()
    recovered = push_all(receiver, arrived)
    expected = set()
    for media in frames:
        blocks = -(-len(media) // 16)
        repairs = repair_packets(media, count)
        for block in range(blocks):
            missing = [packet for packet in media[block::blocks] if packet not in arrived]
            if len(missing) <= sum(repair in arrived for repair in repairs[block::blocks]):
                expected |= set(missing)
    assert set(recovered) - set(arrived) == expected
    assert set(recovered) <= {packet for media in frames for packet in media}
    assert len(set(recovered)) == len(recovered)
    assert receiver.recovered == len(recovered)
    assert receiver.malformed == 0


MALFORMED_HEADERS = [
    replace_payload(REPAIRS[0], b""),
    replace_payload(REPAIRS[0], REPAIRS[0].payload[:12]),  # no symbol
    replace_payload(REPAIRS[0], REPAIRS[0].payload[:14]),  # a symbol without payload
    replace_payload(REPAIRS[0], REPAIRS[0].payload.ljust(12 + MAX_SYMBOL_BYTES + 1, b"\x00")),
    replace_bytes(REPAIRS[0], {0: 2}),  # version
    replace_bytes(REPAIRS[0], {1: 0x80}),  # payload type of the media
    replace_bytes(REPAIRS[0], {1: 0xE0}),
    replace_bytes(REPAIRS[0], {1: REPAIR_PAYLOAD_TYPE}),
    replace_bytes(REPAIRS[0], {7: 5}),  # SSRC of the media
    replace_bytes(REPAIRS[0], {8: 0, 9: 0}),  # number of the frame's packets
    replace_bytes(REPAIRS[0], {8: 0xFF, 9: 0xFF}),
    replace_bytes(REPAIRS[0], {10: 1}),  # number of the block
    replace_bytes(REPAIRS[0], {11: 2}),  # neither P nor Q
]
"""Repair packets with an invalid field of the header, which is described in docs/wire.md."""


@pytest.mark.parametrize("repair", MALFORMED_HEADERS)
def test_malformed_header(repair: RtpPacket) -> None:
    """A repair packet with an invalid header is counted even if no packet was lost."""
    receiver = RepairReceiver()
    assert push_all(receiver, [*EIGHT_PACKETS, repair]) == []
    assert counters(receiver) == Counters(malformed=1)


@pytest.mark.parametrize(
    "repair",
    [
        *MALFORMED_HEADERS,
        # Cut off: shorter than the media of its block.
        replace_payload(REPAIRS[0], REPAIRS[0].payload[:-1]),
        # The recovered payload would be longer than the packet, have bytes after its end, or be empty.
        replace_bytes(REPAIRS[0], {12: REPAIRS[0].payload[12] ^ 1}),
        replace_bytes(REPAIRS[0], {40: REPAIRS[0].payload[40] ^ 1}),
        repair_packets([*EIGHT_PACKETS[:3], replace_payload(EIGHT_PACKETS[3], b""), *EIGHT_PACKETS[4:]], 1)[0],
    ],
)
def test_malformed(repair: RtpPacket) -> None:
    """A malformed repair packet is counted and leaves no state."""
    receiver = RepairReceiver()
    assert push_all(receiver, [*EIGHT_PACKETS[:3], *EIGHT_PACKETS[4:], repair]) == []
    assert counters(receiver) == Counters(malformed=1)
    assert receiver._open == {}
    assert receiver.push(REPAIRS[1], 0) == [EIGHT_PACKETS[3]]


@pytest.mark.parametrize(
    "repair",
    [
        replace_bytes(REPAIRS[1], {1: 98}),  # payload type of the media
        replace_bytes(REPAIRS[1], {3: 101}),  # first sequence number
        replace_bytes(REPAIRS[1], {9: 9}),  # number of the frame's packets
        replace_payload(REPAIRS[1], REPAIRS[1].payload + b"\x00"),
        replace_bytes(REPAIRS[0], {20: REPAIRS[0].payload[20] ^ 1}),  # another P
    ],
)
def test_contradicting_repair_packets(repair: RtpPacket) -> None:
    """The second of two contradicting repair packets of a block is counted as malformed and dropped."""
    receiver = RepairReceiver()
    assert push_all(receiver, [*EIGHT_PACKETS[:6], REPAIRS[0], repair]) == []
    assert counters(receiver) == Counters(malformed=1)
    assert receiver.push(REPAIRS[1], 0) == EIGHT_PACKETS[6:]


REPAIR_LIKE_PAYLOADS = st.tuples(
    st.sampled_from([b"\x01", b"\x00"]),
    st.sampled_from([b"\x60", b"\x61", b"\xff"]),
    st.integers(98, 110).map(lambda sequence: sequence.to_bytes(2, "big")),
    st.sampled_from([MEDIA_SSRC.to_bytes(4, "big"), b"none"]),
    st.one_of(st.integers(0, 40), st.integers(0, 2**16 - 1)).map(lambda packets: packets.to_bytes(2, "big")),
    st.integers(0, 3).map(lambda block: bytes([block])),
    st.integers(0, 2).map(lambda which: bytes([which])),
    st.binary(max_size=40),
).map(b"".join)
"""Payloads that resemble those of repair packets for EIGHT_PACKETS."""


@given(st.lists(st.one_of(st.binary(max_size=60), REPAIR_LIKE_PAYLOADS, st.sampled_from(EIGHT_PACKETS)), max_size=30))
def test_any_bytes(pushed: list[bytes | RtpPacket]) -> None:
    """No repair payload raises an error, and invalid ones are counted as malformed."""
    receiver = RepairReceiver()
    surely_malformed = 0
    for pushed_item in pushed:
        packet = (
            RtpPacket(REPAIR_PAYLOAD_TYPE, 0, 9000, 1, marker=False, payload=pushed_item)
            if isinstance(pushed_item, bytes)
            else pushed_item
        )
        surely_malformed += isinstance(pushed_item, bytes) and (len(pushed_item) < 15 or pushed_item[0] != 1)
        recovered = receiver.push(packet, 0)
        assert all(packet.timestamp == 9000 and packet.payload for packet in recovered)
    assert surely_malformed <= receiver.malformed <= len(pushed)


def test_bounded_memory() -> None:
    """At most the newest 64 open blocks and 4096 packets are stored."""
    receiver = RepairReceiver()
    for number in range(3 * MAX_OPEN_BLOCKS):
        media = frame([b"m"] * 4, first=4 * number, timestamp=number)
        push_all(receiver, [media[0], *repair_packets(media, 2)])
    assert len(receiver._open) == MAX_OPEN_BLOCKS
    assert counters(receiver) == Counters(unrepaired=2 * MAX_OPEN_BLOCKS)
    newest = frame([b"m"] * 4, first=4 * (3 * MAX_OPEN_BLOCKS - 1), timestamp=3 * MAX_OPEN_BLOCKS - 1)
    assert receiver.push(newest[1], 0) == newest[2:]
    size = sys.getsizeof(receiver._media)
    push_all(receiver, (RtpPacket(96, number % 2**16, 7, MEDIA_SSRC, False, b"") for number in range(70_000)))
    assert sys.getsizeof(receiver._media) == size
    assert len(receiver._media) == MAX_STORED_MEDIA


def test_bounded_memory_of_long_packets() -> None:
    """Media packets that are too long for repair are not stored."""
    receiver = RepairReceiver()
    push_all(receiver, frame(b"x" * size for size in (1498, 1499, 65_000)))
    assert [stored.sequence for stored in receiver._media if stored] == [100]


def test_repair_packet_from_long_ago() -> None:
    """A repair packet that is repeated when its media packets are no longer stored recovers nothing."""
    receiver = RepairReceiver()
    single_packet = frame([b"alone"])
    repair = repair_packets(single_packet, 1)[0]
    assert receiver.push(repair, 0) == single_packet
    push_all(receiver, (RtpPacket(96, 101 + number, 7, MEDIA_SSRC, False, b"") for number in range(MAX_STORED_MEDIA)))
    assert receiver.push(repair, 0) == []
    assert counters(receiver) == Counters(recovered=1)


def test_new_stream_gives_up_old_blocks() -> None:
    """When the media stream changes, the blocks of the previous stream are given up and its repair packets rejected."""
    receiver = RepairReceiver()
    push_all(receiver, [*EIGHT_PACKETS[:6], REPAIRS[0]])
    # The sequence numbers and timestamp are the same: only the SSRC differs.
    other = frame((b"other" for _ in range(8)), ssrc=9)
    assert push_all(receiver, [*other[:6], other[7]]) == []
    assert receiver.push(REPAIRS[1], 0) == []
    assert counters(receiver) == Counters(malformed=1, unrepaired=1)
    assert receiver.push(repair_packets(other, 1)[0], 0) == [other[6]]


def test_same_numbers_of_another_frame() -> None:
    """Media packets with the sequence numbers of a block but another timestamp do not belong to that block."""
    receiver = RepairReceiver()
    stale = frame((b"stale" for _ in range(8)), timestamp=1)
    later = frame((b"later" for _ in range(8)), timestamp=2)
    assert push_all(receiver, [*stale, *EIGHT_PACKETS[:6], REPAIRS[0], later[7]]) == []
    assert receiver.push(EIGHT_PACKETS[7], 0) == [EIGHT_PACKETS[6]]


def test_same_numbers_of_another_stream() -> None:
    """Media packets of another SSRC with a block's sequence numbers and timestamp do not belong to that block."""
    receiver = RepairReceiver()
    other = frame((b"other" for _ in range(8)), ssrc=9)
    assert push_all(receiver, [*other, *EIGHT_PACKETS[:6], EIGHT_PACKETS[7], REPAIRS[0]]) == [EIGHT_PACKETS[6]]


def test_same_storage_index() -> None:
    """Media packets with the same storage index are not confused."""
    receiver = RepairReceiver()
    before = frame((b"before" for _ in range(8)), first=(100 - MAX_STORED_MEDIA) % 2**16)
    assert push_all(receiver, [*before, *EIGHT_PACKETS[:6], EIGHT_PACKETS[7], REPAIRS[0]]) == [EIGHT_PACKETS[6]]


def test_access_unit_from_recovered_packets() -> None:
    """A depacketizer that gets the recovered packets returns the access unit that was sent."""
    access_unit = b"\x00\x00\x00\x01\x67\x42\x80" + b"\x00\x00\x00\x01\x65" + bytes(range(1, 256)) * 30
    datagrams = Packetizer(MEDIA_SSRC, 65_533).packetize(access_unit, 9000)
    repairs = RepairSender(REPAIR_SSRC, 0).repair(datagrams, 2)
    receiver = RepairReceiver()
    packets = []
    for datagram in [*datagrams[1:-1], *repairs]:
        packet = parse_packet(datagram)
        recovered = receiver.push(packet, 0)
        packets += recovered if packet.payload_type == REPAIR_PAYLOAD_TYPE else [packet, *recovered]
    packets.sort(key=lambda packet: (packet.sequence - 65_533) % 2**16)
    depacketizer = Depacketizer()
    units = [unit for packet in packets for unit in depacketizer.push(packet, lost_before=False)]
    assert len(datagrams) > 5
    assert [(unit.data, unit.complete, unit.keyframe) for unit in units] == [(access_unit, True, True)]


@pytest.mark.parametrize(
    ("notes", "now_s", "count"),  # a note: lost packets, expected packets, time in s
    [
        ([], 0, 0),
        ([(0, 1000, 0)], 1, 0),
        ([(1, 1000, 0)], 1, 1),
        ([(1, 1000, 0)], 29.999, 1),
        ([(1, 1000, 0)], 30, 0),
        ([(1, 1000, 0), (1, 1000, 20)], 49, 1),
        ([(25, 1000, 0)], 0, 2),
        ([(24, 1000, 0)], 0, 1),
        ([(25, 1000, 0)], 4.999, 2),
        ([(25, 1000, 0)], 5, 1),
        ([(25, 1000, 0), (0, 1, 1)], 1, 1),
        ([(0, 1000, 0), (25, 1000, 4)], 4, 1),
        ([(0, 1000, 0), (25, 1000, 4)], 5, 2),
        # Packets that arrived later, counted as lost in the previous report.
        ([(25, 1000, 0), (-25, 0, 1)], 1, 1),
        ([(0, 0, 0)], 0, 0),
        ([(1, 40, 0)], 0, 2),
    ],
)
def test_redundancy_controller(notes: list[tuple[int, int, float]], now_s: float, count: int) -> None:
    """A block gets one repair packet for 30 s after a loss, and two while 2.5 % were lost in the last 5 s."""
    controller = RedundancyController()
    for lost, expected, at_s in notes:
        controller.note_loss(lost, expected, int(at_s * NS_PER_S))
    assert controller.repair_packets(int(now_s * NS_PER_S)) == count


def test_redundancy_controller_forgets() -> None:
    """The controller keeps only the notes of the last 5 s."""
    controller = RedundancyController()
    for number in range(1000):
        controller.note_loss(0, 10, number * 100 * NS_PER_MS)
    assert len(controller._notes) == 50
