"""Forward error correction of the video: repair packets from which a receiver recovers lost packets of a frame.

A frame's packets are divided into n blocks of at most 16 packets. Packet i goes into block i modulo n, so that a burst
of losses is spread over the blocks. Each block has 0, 1 or 2 repair packets (`parity.py`), which recover as many lost
packets. The repair packets are sent after the frame's last packet, so they delay no media. Wire format: docs/wire.md,
"Repair packets".
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from msgspec import Struct

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import BadPacket, UserError
from lavt.transport.rtp.parity import compute_parity, recover
from lavt.transport.rtp.rtp import RtpPacket, parse_packet

REPAIR_PAYLOAD_TYPE: Final = 97
MAX_REPAIR_PACKETS: Final = 2
"""For one block: the first has the parity symbol P, the second Q (`parity.py`)."""
MAX_BLOCK_PACKETS: Final = 16
MAX_BLOCKS: Final = 255
"""In one frame; a frame of more than 16 * 255 packets gets no repair packets."""
MAX_SYMBOL_BYTES: Final = 1500
"""Longest payload with its length field: longer than in any Ethernet packet. It limits the memory."""
MAX_STORED_MEDIA: Final = 4096
"""Number of media packets that are stored to recover lost ones: more than those of the largest frame, and as many as
those of some seconds of any stream."""
MAX_OPEN_BLOCKS: Final = 64
"""Largest number of blocks that wait for more packets: enough for a second of small frames that all lack packets."""
BLOCK_TIMEOUT_NS: Final = 500 * NS_PER_MS
"""Longest wait of a block: a packet that is recovered later would be too late for its frame."""

_VERSION: Final = 1
_HEADER = struct.Struct("!BBHIHBB")
_RTP_HEADER_BYTES: Final = 12
_LENGTH_BYTES: Final = 2
_SEQUENCES: Final = 2**16


class RepairSender:
    """A sender of repair packets, which are a stream with its own SSRC and sequence numbers."""

    def __init__(self, ssrc: int, first_sequence: int) -> None:
        self.ssrc = ssrc
        self.next_sequence = first_sequence % _SEQUENCES

    def make_repair_packets(self, datagrams: Sequence[bytes], count: int) -> list[bytes]:
        """Return `count` repair packets for each block of a frame, to be sent after it.

        `datagrams` are all RTP packets of the frame, in order, as the `Packetizer` returned them. A frame of more than
        `MAX_BLOCKS` blocks or with a packet too long for `MAX_SYMBOL_BYTES` gets no repair packets. Raises `UserError`
        for another `count` than 0, 1 or 2.
        """
        if not 0 <= count <= MAX_REPAIR_PACKETS:
            raise UserError(f"a block cannot have {count} repair packets: choose 0, 1 or {MAX_REPAIR_PACKETS}")
        blocks = _block_count(len(datagrams))
        if count == 0 or not 1 <= blocks <= MAX_BLOCKS:
            return []
        first = parse_packet(datagrams[0])
        symbols = [_to_symbol(datagram[_RTP_HEADER_BYTES:]) for datagram in datagrams]
        if max(map(len, symbols)) > MAX_SYMBOL_BYTES:
            return []
        coded = [compute_parity(symbols[block::blocks], count) for block in range(blocks)]
        repairs = []
        # The second packets of all blocks follow the first ones, so that a burst does not hit both packets of a block.
        for parity in range(count):
            for block in range(blocks):
                header = _HEADER.pack(
                    _VERSION, first.payload_type, first.sequence, first.ssrc, len(datagrams), block, parity
                )
                repairs.append(self._packet(first.timestamp, header + coded[block][parity]))
        return repairs

    def _packet(self, timestamp: int, payload: bytes) -> bytes:
        """Return the next datagram of this stream."""
        sequence, self.next_sequence = self.next_sequence, (self.next_sequence + 1) % _SEQUENCES
        return RtpPacket(REPAIR_PAYLOAD_TYPE, sequence, timestamp, self.ssrc, marker=False, payload=payload).to_bytes()


class _BlockHeader(Struct, frozen=True):
    """The fields that identify the media packets of a block; all repair packets of the block have the same."""

    payload_type: int
    first_sequence: int
    """First sequence number of the frame."""
    ssrc: int
    timestamp: int
    frame_packets: int
    """Number of media packets of the frame."""
    block: int
    """Number of the block in the frame."""
    symbol_bytes: int

    @property
    def sequences(self) -> list[int]:
        """The sequence numbers of the block's packets."""
        indices = range(self.block, self.frame_packets, _block_count(self.frame_packets))
        return [(self.first_sequence + index) % _SEQUENCES for index in indices]

    def packet(self, sequence: int, payload: bytes) -> RtpPacket:
        """Return the packet of the frame with this sequence number."""
        last = (self.first_sequence + self.frame_packets - 1) % _SEQUENCES
        return RtpPacket(self.payload_type, sequence, self.timestamp, self.ssrc, sequence == last, payload)


@dataclass(slots=True)
class _Block:
    """The received part of a block in which media packets are still missing."""

    header: _BlockHeader
    opened_ns: int
    packets: dict[int, RtpPacket | None]
    """The block's packets by sequence number, in order; None: missing."""
    symbols: dict[int, bytes]
    """The received parity symbols by `P` and `Q`."""

    def lacks(self, packet: RtpPacket) -> bool:
        """Return whether `packet`, which has the block's SSRC, is missing in this block."""
        return packet.timestamp == self.header.timestamp and self.packets.get(packet.sequence, packet) is None


class RepairReceiver:
    """A receiver that recovers lost media packets from the other packets of their block and its repair packets.

    It never raises. It stores at most `MAX_STORED_MEDIA` packets and `MAX_OPEN_BLOCKS` blocks, with symbols of at most
    `MAX_SYMBOL_BYTES`. Public counters: `recovered`, recovered media packets, including those that arrive later;
    `malformed`, repair packets that are invalid, contradict another repair packet of their block or belong to another
    media stream; `unrepaired`, blocks given up because more packets were lost than could be recovered.
    """

    def __init__(self) -> None:
        self.recovered = 0
        self.malformed = 0
        self.unrepaired = 0
        # Indexed by sequence number modulo the length: the newest packets overwrite the oldest.
        self._media: list[RtpPacket | None] = [None] * MAX_STORED_MEDIA
        self._ssrc: int | None = None
        self._open: dict[tuple[int, int, int], _Block] = {}
        """The blocks that wait for more packets, oldest first, by SSRC, timestamp and number of the block."""

    def push(self, packet: RtpPacket, now_ns: int) -> list[RtpPacket]:
        """Add a media or repair packet; return the media packets that are recovered by it.

        Each recovered packet is returned once, with all its fields as sent. `packet` itself is not returned.
        """
        if self._open:
            self._expire(now_ns)
        if packet.payload_type == REPAIR_PAYLOAD_TYPE:
            try:
                return self._add_repair(packet, now_ns)
            except BadPacket:
                self.malformed += 1
                return []
        if packet.ssrc != self._ssrc:
            self._change_stream(packet.ssrc)
        too_long = len(packet.payload) + _LENGTH_BYTES > MAX_SYMBOL_BYTES
        if too_long or not self._store(packet):
            return []
        recovered: list[RtpPacket] = []
        for key, block in list(self._open.items()):
            if block.lacks(packet):
                block.packets[packet.sequence] = packet
                recovered += self._try_recover(key, block)
        return recovered

    def _add_repair(self, packet: RtpPacket, now_ns: int) -> list[RtpPacket]:
        """Add a repair packet; raises `BadPacket` for one that is invalid."""
        header, parity, symbol = _parse_repair(packet)
        if self._ssrc not in {None, header.ssrc}:
            raise BadPacket("repair packet of another stream")
        key = header.ssrc, header.timestamp, header.block
        block = self._open.get(key)
        if block is None:
            packets = {
                sequence: self._stored_media(header.ssrc, header.timestamp, sequence) for sequence in header.sequences
            }
            if None not in packets.values() or any(self._is_displaced(header, sequence) for sequence in packets):
                return []
            block = self._open[key] = _Block(header, now_ns, packets, {})
            if len(self._open) > MAX_OPEN_BLOCKS:
                self._give_up(next(iter(self._open)))
        elif block.header != header:
            raise BadPacket("repair packets of one block contradict each other")
        if block.symbols.setdefault(parity, symbol) != symbol:
            raise BadPacket("duplicate repair packet with different bytes")
        return self._try_recover(key, block)

    def _try_recover(self, key: tuple[int, int, int], block: _Block) -> list[RtpPacket]:
        """Recover the missing packets of a block and close it, if enough of its packets have arrived."""
        lost = sum(packet is None for packet in block.packets.values())
        if lost > len(block.symbols):
            return []
        del self._open[key]
        try:
            recovered = _recover_packets(block)
        except BadPacket:
            self.malformed += 1
            return []
        new = [packet for packet in recovered if self._store(packet)]
        self.recovered += len(new)
        return new

    def _store(self, packet: RtpPacket) -> bool:
        """Store a media packet; return False if it was stored already."""
        if self._stored_media(packet.ssrc, packet.timestamp, packet.sequence) is not None:
            return False
        self._media[packet.sequence % MAX_STORED_MEDIA] = packet
        return True

    def _stored_media(self, ssrc: int, timestamp: int, sequence: int) -> RtpPacket | None:
        """Return a media packet if it is stored."""
        stored = self._media[sequence % MAX_STORED_MEDIA]
        if stored is not None and (stored.sequence, stored.timestamp, stored.ssrc) == (sequence, timestamp, ssrc):
            return stored
        return None

    def _is_displaced(self, header: _BlockHeader, sequence: int) -> bool:
        """Return whether a newer packet is stored in the place of the packet `sequence`.

        Then `sequence` is too old: nobody knows whether it was received or recovered before.
        """
        stored = self._media[sequence % MAX_STORED_MEDIA]
        if stored is None or stored.ssrc != header.ssrc:
            return False
        return 0 < (stored.sequence - sequence) % _SEQUENCES < 2**15

    def _change_stream(self, ssrc: int) -> None:
        """Begin another media stream and give up the blocks of the previous one."""
        self._ssrc = ssrc
        for block_ssrc, timestamp, number in list(self._open):
            if block_ssrc != ssrc:
                self._give_up((block_ssrc, timestamp, number))

    def _expire(self, now_ns: int) -> None:
        """Give up the blocks that have timed out; `_open` has the oldest block first."""
        for key, block in list(self._open.items()):
            if now_ns - block.opened_ns < BLOCK_TIMEOUT_NS:
                return
            self._give_up(key)

    def _give_up(self, key: tuple[int, int, int]) -> None:
        del self._open[key]
        self.unrepaired += 1


LOSS_REMEMBERED_NS: Final = 30 * NS_PER_S
"""Loss occurs in clusters: after a loss the stream is protected for this long."""
HEAVY_LOSS_WINDOW_NS: Final = 5 * NS_PER_S
"""Some thousand packets at 2 Mb/s. In such a window one lost packet is not heavy loss, and heavy loss is detected
within seconds."""
HEAVY_LOSS_PER_MILLE: Final = 25
"""The smallest loss rate that counts as heavy. From it on, one repair packet a block is not enough: more than 2 % of
frames remain damaged (computed: of 8 media packets and 1 repair packet, two or more are lost)."""


class _LossNote(NamedTuple):
    """Lost and expected media packets since the previous note."""

    noted_ns: int
    lost: int
    expected: int


class RedundancyController:
    """A controller that sets the number of repair packets for each block by the loss that the receiver reports."""

    def __init__(self) -> None:
        self._notes: deque[_LossNote] = deque()
        """The notes in the window, oldest first."""
        self._lost = 0
        self._expected = 0
        self._last_loss_ns: int | None = None

    def note_loss(self, lost: int, expected: int, now_ns: int) -> None:
        """Note that `lost` of `expected` media packets, before repair, were lost since the previous note."""
        self._notes.append(_LossNote(now_ns, lost, expected))
        self._lost += lost
        self._expected += expected
        if lost > 0:
            self._last_loss_ns = now_ns
        self._forget(now_ns)

    def repair_packets(self, now_ns: int) -> int:
        """Return the number of repair packets for each block: 0 without loss, 1 after a loss, 2 during heavy loss."""
        self._forget(now_ns)
        if self._lost > 0 and 1000 * self._lost >= HEAVY_LOSS_PER_MILLE * self._expected:
            return 2
        return int(self._last_loss_ns is not None and now_ns - self._last_loss_ns < LOSS_REMEMBERED_NS)

    def _forget(self, now_ns: int) -> None:
        """Remove the notes that are older than the window."""
        while self._notes and now_ns - self._notes[0].noted_ns >= HEAVY_LOSS_WINDOW_NS:
            _, lost, expected = self._notes.popleft()
            self._lost -= lost
            self._expected -= expected


def _block_count(packets: int) -> int:
    """Return the number of blocks of a frame."""
    return -(-packets // MAX_BLOCK_PACKETS)


def _parse_repair(packet: RtpPacket) -> tuple[_BlockHeader, int, bytes]:
    """Parse a repair packet; return its header, whether it has P or Q, and its parity symbol."""
    symbol = packet.payload[_HEADER.size :]
    if not _LENGTH_BYTES < len(symbol) <= MAX_SYMBOL_BYTES:
        raise BadPacket("repair packet cut off, or too long")
    version, payload_type, first_sequence, ssrc, frame_packets, block, parity = _HEADER.unpack_from(packet.payload)
    if version != _VERSION or payload_type > 0x7F or payload_type == REPAIR_PAYLOAD_TYPE:
        raise BadPacket("repair packet of another format")
    if not block < _block_count(frame_packets) <= MAX_BLOCKS or parity >= MAX_REPAIR_PACKETS:
        raise BadPacket("block or repair packet number too high for the frame's size")
    header = _BlockHeader(payload_type, first_sequence, ssrc, packet.timestamp, frame_packets, block, len(symbol))
    return header, parity, symbol


def _to_symbol(payload: bytes) -> bytes:
    """Return a payload with its length in front, because the erasure code pads symbols to the same length."""
    return len(payload).to_bytes(_LENGTH_BYTES, "big") + payload


def _recover_packets(block: _Block) -> list[RtpPacket]:
    """Return the missing packets of a block that has enough parity symbols.

    Raises `BadPacket` if the symbols cannot belong to these packets.
    """
    symbols = [None if packet is None else _to_symbol(packet.payload) for packet in block.packets.values()]
    sequences = [sequence for sequence, packet in block.packets.items() if packet is None]
    recovered = zip(sequences, recover(symbols, block.symbols), strict=True)
    return [block.header.packet(sequence, _payload_of(symbol)) for sequence, symbol in recovered]


def _payload_of(symbol: bytes) -> bytes:
    """Return the payload of a recovered symbol.

    Raises `BadPacket` for an empty payload, and for bytes other than zeros after the payload.
    """
    end = _LENGTH_BYTES + int.from_bytes(symbol[:_LENGTH_BYTES], "big")
    if not _LENGTH_BYTES < end <= len(symbol) or symbol.count(0, end) != len(symbol) - end:
        raise BadPacket("repair packet that gives no valid payload")
    return symbol[_LENGTH_BYTES:end]
