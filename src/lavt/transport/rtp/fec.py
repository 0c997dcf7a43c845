"""Forward error correction of the video: repair packets from which a receiver makes lost packets of a frame again.

A frame's packets are cut into blocks of at most 16, packet i into block i mod blocks, so that a burst is shared out.
Each block has 0, 1 or 2 repair packets (`erasure.py`), and as many lost packets of it come back. They leave after the
frame's last packet, so they delay nothing. Every byte of them: docs/wire.md, "Repair packets".
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import BadPacket, UserError
from lavt.transport.rtp.parity import missing, parity
from lavt.transport.rtp.rtp import RtpPacket, parse_packet
from lavt.value import value

REPAIR_PAYLOAD_TYPE: Final = 97
MAX_REPAIR_PACKETS: Final = 2
"""For one block: P, and Q where a second one is asked for."""
MAX_BLOCK_PACKETS: Final = 16
MAX_BLOCKS: Final = 255
"""In one frame; a frame of more than 16 * 255 packets gets no repair packets."""
MAX_SYMBOL_BYTES: Final = 1500
"""Of a payload with its length: more than a packet on Ethernet has, so that what is kept stays small."""
MEDIA_KEPT: Final = 4096
"""Media packets kept to make lost ones from: more than the largest frame has, some seconds of any stream."""
OPEN_BLOCKS: Final = 64
"""Blocks that wait for more packets at most: a second of small frames of which each lacks some."""
BLOCK_LIFE_NS: Final = 500 * NS_PER_MS
"""A block waits no longer: whatever it gave then would be late for its picture."""

_VERSION: Final = 1
_HEADER = struct.Struct("!BBHIHBB")
_RTP_HEADER_BYTES: Final = 12
_LENGTH_BYTES: Final = 2
_SEQUENCES: Final = 2**16


class RepairSender:
    """Makes the repair packets of frames: a stream with an SSRC and sequence numbers of its own."""

    def __init__(self, ssrc: int, first_sequence: int) -> None:
        self.ssrc = ssrc
        self.next_sequence = first_sequence % _SEQUENCES

    def repair(self, datagrams: Sequence[bytes], count: int) -> list[bytes]:
        """Make `count` repair packets for each block of a frame, to be sent after it.

        `datagrams` are all RTP packets of the frame, in order, as the `Packetizer` gave them; a frame of more than
        `MAX_BLOCKS` blocks or with a packet too long for `MAX_SYMBOL_BYTES` gets none. Raises `UserError` for another
        `count` than 0, 1 or 2.
        """
        if not 0 <= count <= MAX_REPAIR_PACKETS:
            raise UserError(f"{count} repair packets for a block: choose 0, 1 or {MAX_REPAIR_PACKETS}")
        blocks = _blocks_of(len(datagrams))
        if count == 0 or not 1 <= blocks <= MAX_BLOCKS:
            return []
        first = parse_packet(datagrams[0])
        symbols = [_symbol(datagram[_RTP_HEADER_BYTES:]) for datagram in datagrams]
        if max(map(len, symbols)) > MAX_SYMBOL_BYTES:
            return []
        coded = [parity(symbols[block::blocks], count) for block in range(blocks)]
        repairs = []
        # The second packets of all blocks follow the first ones, so that a burst at the end does not hit both of one.
        for which in range(count):
            for block in range(blocks):
                header = _HEADER.pack(
                    _VERSION, first.payload_type, first.sequence, first.ssrc, len(datagrams), block, which
                )
                repairs.append(self._packet(first.timestamp, header + coded[block][which]))
        return repairs

    def _packet(self, timestamp: int, payload: bytes) -> bytes:
        """Make the next datagram of this stream."""
        sequence, self.next_sequence = self.next_sequence, (self.next_sequence + 1) % _SEQUENCES
        return RtpPacket(REPAIR_PAYLOAD_TYPE, sequence, timestamp, self.ssrc, marker=False, payload=payload).to_bytes()


@value
class _Shape:
    """Which packets a block is of; all its repair packets say the same."""

    payload_type: int
    first_sequence: int
    """Of the frame."""
    ssrc: int
    timestamp: int
    packets: int
    """Of the frame."""
    block: int
    symbol_bytes: int

    @property
    def sequences(self) -> list[int]:
        """The sequence numbers of the block's packets."""
        places = range(self.block, self.packets, _blocks_of(self.packets))
        return [(self.first_sequence + place) % _SEQUENCES for place in places]

    def packet(self, sequence: int, payload: bytes) -> RtpPacket:
        """Give the packet of the frame that has this sequence number."""
        last = (self.first_sequence + self.packets - 1) % _SEQUENCES
        return RtpPacket(self.payload_type, sequence, self.timestamp, self.ssrc, sequence == last, payload)


@dataclass(slots=True)
class _Block:
    """What is there of a block that still lacks packets."""

    shape: _Shape
    opened_ns: int
    packets: dict[int, RtpPacket | None]
    """All of the block by sequence number, in order; None is missing."""
    symbols: dict[int, bytes]
    """Of parity: what the repair packets carry, by which one of the block it is."""

    def lacks(self, packet: RtpPacket) -> bool:
        """Tell whether a packet of the same SSRC is one that is missing here."""
        return packet.timestamp == self.shape.timestamp and self.packets.get(packet.sequence, packet) is None


class RepairReceiver:
    """Makes lost media packets again from the other packets of their block and its repair packets.

    It never raises and holds `MEDIA_KEPT` packets and `OPEN_BLOCKS` blocks at most, none with symbols longer than
    `MAX_SYMBOL_BYTES`. Public counters: `recovered`, media packets made again, also such as come later themselves;
    `malformed`, repair packets that cannot be right, do not fit the others of their block or are of another stream than
    the media; `unrepaired`, blocks given up that lacked more than could be made again.
    """

    def __init__(self) -> None:
        self.recovered = 0
        self.malformed = 0
        self.unrepaired = 0
        # By sequence number modulo the length: the newest packets are there, and nothing has to be thrown away.
        self._media: list[RtpPacket | None] = [None] * MEDIA_KEPT
        self._ssrc: int | None = None
        self._open: dict[tuple[int, int, int], _Block] = {}

    def push(self, packet: RtpPacket, now_ns: int) -> list[RtpPacket]:
        """Take a media or repair packet; return the media packets that could be made again because of it.

        Each comes once and has all its fields as sent; the packet itself is not among them.
        """
        if self._open:
            self._expire(now_ns)
        if packet.payload_type == REPAIR_PAYLOAD_TYPE:
            try:
                return self._take_repair(packet, now_ns)
            except BadPacket:
                self.malformed += 1
                return []
        if packet.ssrc != self._ssrc:
            self._change_stream(packet.ssrc)
        too_long = len(packet.payload) + _LENGTH_BYTES > MAX_SYMBOL_BYTES
        if too_long or not self._keep(packet):
            return []
        recovered: list[RtpPacket] = []
        for key, block in list(self._open.items()):
            if block.lacks(packet):
                block.packets[packet.sequence] = packet
                recovered += self._settle(key, block)
        return recovered

    def _take_repair(self, packet: RtpPacket, now_ns: int) -> list[RtpPacket]:
        """Take a repair packet; raises `BadPacket` for one that does not fit."""
        shape, which, symbol = _parse(packet)
        if self._ssrc not in {None, shape.ssrc}:
            raise BadPacket("repair of another stream")
        key = shape.ssrc, shape.timestamp, shape.block
        block = self._open.get(key)
        if block is None:
            packets = {sequence: self._find(shape.ssrc, shape.timestamp, sequence) for sequence in shape.sequences}
            if None not in packets.values() or any(self._passed(shape, sequence) for sequence in packets):
                return []
            block = self._open[key] = _Block(shape, now_ns, packets, {})
            if len(self._open) > OPEN_BLOCKS:
                self._give_up(next(iter(self._open)))
        elif block.shape != shape:
            raise BadPacket("repair packets of one block that disagree")
        if block.symbols.setdefault(which, symbol) != symbol:
            raise BadPacket("a repair packet twice, with other bytes")
        return self._settle(key, block)

    def _settle(self, key: tuple[int, int, int], block: _Block) -> list[RtpPacket]:
        """Make the missing packets of a block when there is enough of it, and be done with it."""
        lost = sum(packet is None for packet in block.packets.values())
        if lost > len(block.symbols):
            return []
        del self._open[key]
        try:
            made = _missing_packets(block)
        except BadPacket:
            self.malformed += 1
            return []
        fresh = [packet for packet in made if self._keep(packet)]
        self.recovered += len(fresh)
        return fresh

    def _keep(self, packet: RtpPacket) -> bool:
        """Keep a media packet; False: it was there already."""
        if self._find(packet.ssrc, packet.timestamp, packet.sequence) is not None:
            return False
        self._media[packet.sequence % MEDIA_KEPT] = packet
        return True

    def _find(self, ssrc: int, timestamp: int, sequence: int) -> RtpPacket | None:
        """Give a media packet if it is kept."""
        kept = self._media[sequence % MEDIA_KEPT]
        if kept is not None and (kept.sequence, kept.timestamp, kept.ssrc) == (sequence, timestamp, ssrc):
            return kept
        return None

    def _passed(self, shape: _Shape, sequence: int) -> bool:
        """Tell whether a newer packet took the place of this one: then it is too late, and it may have been given."""
        kept = self._media[sequence % MEDIA_KEPT]
        return kept is not None and kept.ssrc == shape.ssrc and 0 < (kept.sequence - sequence) % _SEQUENCES < 2**15

    def _change_stream(self, ssrc: int) -> None:
        """Begin with another media stream: nothing of the one before is made again."""
        self._ssrc = ssrc
        for key in [key for key in self._open if key[0] != ssrc]:
            self._give_up(key)

    def _expire(self, now_ns: int) -> None:
        """Give up the blocks that have waited too long; the oldest are first."""
        for key, block in list(self._open.items()):
            if now_ns - block.opened_ns < BLOCK_LIFE_NS:
                return
            self._give_up(key)

    def _give_up(self, key: tuple[int, int, int]) -> None:
        del self._open[key]
        self.unrepaired += 1


LOSS_REMEMBERED_NS: Final = 30 * NS_PER_S
"""Loss comes in spells: who has lost a packet is protected against the next one for this long."""
HEAVY_LOSS_WINDOW_NS: Final = 5 * NS_PER_S
"""Some thousand packets at 2 Mb/s: a single lost one is not heavy loss, and a spell is noticed within seconds."""
HEAVY_LOSS_PER_MILLE: Final = 25
"""From here on one repair packet leaves more than 2 % of frames damaged (computed: two or more lost of 8 + 1)."""


class RepairChooser:
    """Chooses how many repair packets a block gets by the loss that the receiver reports."""

    def __init__(self) -> None:
        self._notes: deque[tuple[int, int, int]] = deque()
        self._lost = 0
        self._expected = 0
        self._last_loss_ns: int | None = None

    def note(self, lost: int, expected: int, now_ns: int) -> None:
        """Take in that `lost` of `expected` media packets did not come, before repair, since the note before."""
        self._notes.append((now_ns, lost, expected))
        self._lost += lost
        self._expected += expected
        if lost > 0:
            self._last_loss_ns = now_ns
        self._forget(now_ns)

    def count(self, now_ns: int) -> int:
        """Give the repair packets for each block: 0 without loss, 1 after some, 2 while it is heavy."""
        self._forget(now_ns)
        if self._lost > 0 and 1000 * self._lost >= HEAVY_LOSS_PER_MILLE * self._expected:
            return 2
        return int(self._last_loss_ns is not None and now_ns - self._last_loss_ns < LOSS_REMEMBERED_NS)

    def _forget(self, now_ns: int) -> None:
        """Leave out the notes that are older than the window."""
        while self._notes and now_ns - self._notes[0][0] >= HEAVY_LOSS_WINDOW_NS:
            _, lost, expected = self._notes.popleft()
            self._lost -= lost
            self._expected -= expected


def _blocks_of(packets: int) -> int:
    """Tell into how many blocks a frame is cut."""
    return -(-packets // MAX_BLOCK_PACKETS)


def _parse(packet: RtpPacket) -> tuple[_Shape, int, bytes]:
    """Read a repair packet: its block, which one of the block it is, and its coded bytes."""
    symbol = packet.payload[_HEADER.size :]
    if not _LENGTH_BYTES < len(symbol) <= MAX_SYMBOL_BYTES:
        raise BadPacket("repair packet cut off, or longer than any of ours")
    version, payload_type, first_sequence, ssrc, packets, block, which = _HEADER.unpack_from(packet.payload)
    if version != _VERSION or payload_type > 0x7F or payload_type == REPAIR_PAYLOAD_TYPE:
        raise BadPacket("not a repair packet of ours")
    if not block < _blocks_of(packets) <= MAX_BLOCKS or which >= MAX_REPAIR_PACKETS:
        raise BadPacket("no such block or repair packet in a frame of this size")
    return _Shape(payload_type, first_sequence, ssrc, packet.timestamp, packets, block, len(symbol)), which, symbol


def _symbol(payload: bytes) -> bytes:
    """Put its length before a payload, since padding hides it."""
    return len(payload).to_bytes(_LENGTH_BYTES, "big") + payload


def _missing_packets(block: _Block) -> list[RtpPacket]:
    """Make the missing packets of a block that has symbols enough.

    Raises `BadPacket` when the symbols cannot be of these packets.
    """
    symbols = [None if packet is None else _symbol(packet.payload) for packet in block.packets.values()]
    sequences = [sequence for sequence, packet in block.packets.items() if packet is None]
    made = zip(sequences, missing(symbols, block.symbols), strict=True)
    return [block.shape.packet(sequence, _payload(symbol)) for sequence, symbol in made]


def _payload(symbol: bytes) -> bytes:
    """Take the payload out of what was made; there is always one, and nothing but zeros after it."""
    end = _LENGTH_BYTES + int.from_bytes(symbol[:_LENGTH_BYTES], "big")
    if not _LENGTH_BYTES < end <= len(symbol) or symbol.count(0, end) != len(symbol) - end:
        raise BadPacket("repair that gives no packet")
    return symbol[_LENGTH_BYTES:end]
