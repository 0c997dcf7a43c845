"""RTP packets (RFC 3550) that carry H.264 (RFC 6184, packetization mode 1): access units to packets and back.

An access unit is one encoded picture: NAL units behind start codes (H.264, annex B). The packetizer uses single NAL
unit packets, STAP-A for small consecutive units such as the parameter sets, and FU-A fragments of equal size; the
depacketizer accepts any mix of these. It finishes an access unit when the packet with the marker arrives, so that no
frame waits for the next frame.
"""

from __future__ import annotations

import struct
from itertools import pairwise
from typing import Final

from msgspec import Struct

from lavt.errors import BadPacket, UserError

VIDEO_PAYLOAD_TYPE: Final = 96
MAX_PACKET_BYTES: Final = 1200
MAX_ACCESS_UNIT_BYTES: Final = 2 * 1024 * 1024
"""More than any picture needs. This limits the memory if a peer never ends its access unit."""

_HEADER = struct.Struct("!BBHII")
RTP_HEADER_BYTES: Final = _HEADER.size
_VERSION_2: Final = 0x80
_START_CODE: Final = b"\x00\x00\x00\x01"
_SHORT_START_CODE: Final = b"\x00\x00\x01"
_MIN_PACKET_BYTES: Final = 64

_NAL_TYPE: Final = 0x1F
_NAL_REF_IDC: Final = 0x60
_FORBIDDEN: Final = 0x80
_NO_NAL_TYPE: Final = 0
"""No NAL unit has this type."""
_SLICE_OF_IDR: Final = 5
_PARAMETER_SET: Final = 7
_DELIMITER: Final = 9
_LAST_SINGLE_NAL: Final = 23
_STAP_A: Final = 24
_FU_A: Final = 28
_FU_START: Final = 0x80
_FU_END: Final = 0x40


class RtpPacket(Struct, frozen=True):
    """An RTP packet without contributing sources and extensions (RFC 3550, section 5.1)."""

    payload_type: int
    sequence: int
    timestamp: int
    ssrc: int
    marker: bool
    payload: bytes

    def to_bytes(self) -> bytes:
        """Write the packet as a datagram."""
        second = self.marker << 7 | self.payload_type
        return _HEADER.pack(_VERSION_2, second, self.sequence, self.timestamp, self.ssrc) + self.payload


def parse_packet(datagram: bytes) -> RtpPacket:
    """Parse a datagram as an RTP packet, without contributing sources, header extension and padding.

    Raises `BadPacket` for a datagram that is not RTP version 2 or is shorter than its header says.
    """
    if len(datagram) < _HEADER.size:
        raise BadPacket("shorter than an RTP header")
    first, second, sequence, timestamp, ssrc = _HEADER.unpack_from(datagram)
    if first >> 6 != 2:
        raise BadPacket("not RTP version 2")
    begin = _HEADER.size + 4 * (first & 0x0F)
    end = len(datagram)
    if first & 0x10:
        if begin + 4 > end:
            raise BadPacket("header extension cut off")
        begin += 4 + 4 * int.from_bytes(datagram[begin + 2 : begin + 4], "big")
    if first & 0x20:
        padding = datagram[-1]
        if padding == 0:
            raise BadPacket("padding of no length")
        end -= padding
    if begin > end:
        raise BadPacket("header and padding longer than the packet")
    return RtpPacket(second & 0x7F, sequence, timestamp, ssrc, second >= 0x80, datagram[begin:end])


def split_nal_units(access_unit: bytes) -> list[bytes]:
    """Return the NAL units of an annex B byte stream; bytes before the first start code are ignored."""
    units = []
    begin = access_unit.find(_SHORT_START_CODE)
    while begin >= 0:
        begin += len(_SHORT_START_CODE)
        end = access_unit.find(_SHORT_START_CODE, begin)
        # A NAL unit never ends with a zero byte: trailing zeros belong to the next start code or are stuffing.
        unit = access_unit[begin : end if end >= 0 else None].rstrip(b"\x00")
        if unit:
            units.append(unit)
        begin = end
    return units


class Packetizer:
    """A packetizer of access units into RTP packets of one stream with consecutive sequence numbers.

    `max_packet_bytes` includes the RTP header, but not the UDP and IP headers. Raises `UserError` for a size that is
    not possible.
    """

    def __init__(
        self,
        ssrc: int,
        first_sequence: int,
        payload_type: int = VIDEO_PAYLOAD_TYPE,
        max_packet_bytes: int = MAX_PACKET_BYTES,
    ) -> None:
        if not _MIN_PACKET_BYTES <= max_packet_bytes <= 65_507:
            raise UserError(f"RTP packets cannot have {max_packet_bytes} bytes: choose {_MIN_PACKET_BYTES} to 65507")
        self.ssrc = ssrc
        self.next_sequence = first_sequence % 2**16
        self._payload_type = payload_type
        self._max_payload_bytes = max_packet_bytes - _HEADER.size

    def packetize(self, access_unit: bytes, timestamp: int) -> list[bytes]:
        """Return the datagrams of one access unit (annex B) with one 90 kHz `timestamp`; the last has the marker."""
        payloads = self._to_payloads(split_nal_units(access_unit))
        last = len(payloads) - 1
        datagrams = []
        for index, payload in enumerate(payloads):
            second = (index == last) << 7 | self._payload_type
            datagrams.append(_HEADER.pack(_VERSION_2, second, self.next_sequence, timestamp, self.ssrc) + payload)
            self.next_sequence = (self.next_sequence + 1) % 2**16
        return datagrams

    def _to_payloads(self, units: list[bytes]) -> list[bytes]:
        """Pack NAL units in order: small ones share packets, large ones are split into fragments."""
        payloads: list[bytes] = []
        small_units: list[bytes] = []
        free_bytes = self._max_payload_bytes - 1
        for unit in units:
            if len(unit) + 2 > free_bytes and small_units:
                payloads.append(_aggregate(small_units))
                small_units, free_bytes = [], self._max_payload_bytes - 1
            if len(unit) > self._max_payload_bytes:
                payloads += _fragment(unit, self._max_payload_bytes)
            else:
                small_units.append(unit)
                free_bytes -= 2 + len(unit)
        if small_units:
            payloads.append(_aggregate(small_units))
        return payloads


def _aggregate(units: list[bytes]) -> bytes:
    """Return a STAP-A of several NAL units (RFC 6184, section 5.7.1); return a single unit unchanged."""
    if len(units) == 1:
        return units[0]
    ref_idc = max(unit[0] & _NAL_REF_IDC for unit in units)
    return bytes([ref_idc | _STAP_A]) + b"".join(len(unit).to_bytes(2, "big") + unit for unit in units)


def _fragment(unit: bytes, max_payload_bytes: int) -> list[bytes]:
    """Split one NAL unit into FU-A of nearly equal size (RFC 6184, section 5.8)."""
    body_bytes = len(unit) - 1
    count = -(-body_bytes // (max_payload_bytes - 2))
    indicator = unit[0] & ~_NAL_TYPE | _FU_A
    kind = unit[0] & _NAL_TYPE
    cuts = [1 + body_bytes * index // count for index in range(count + 1)]
    flags = [_FU_START, *[0] * (count - 2), _FU_END]
    pieces = zip(flags, pairwise(cuts), strict=True)
    return [bytes((indicator, flag | kind)) + unit[begin:end] for flag, (begin, end) in pieces]


class AccessUnit(Struct, frozen=True):
    """The received H.264 data of one picture."""

    data: bytes
    """Annex B; b"" if nothing of it can be decoded."""
    timestamp: int
    complete: bool
    """True if no packet of this access unit and no packet directly before it is missing. For a keyframe with parameter
    sets, packets before it do not matter. Errors of an incomplete picture persist in the pictures predicted from it, so
    pictures are in doubt until the next complete keyframe."""
    keyframe: bool
    """True if it has slices of an IDR picture: decoding can begin with this access unit."""


class Depacketizer:
    """A depacketizer that assembles access units from RTP packets in the order of their sequence numbers.

    It never raises: payloads that are not H.264 are counted in `malformed` and make their access unit incomplete.
    """

    def __init__(self) -> None:
        self.malformed = 0
        self._begun = False

    def push(self, packet: RtpPacket, lost_before: bool) -> list[AccessUnit]:
        """Add the next packet; return the access units that are finished, oldest first: at most two.

        `lost_before`: packets between the previous packet and this one are missing. An access unit whose marker packet
        is missing is finished when the next access unit begins.
        """
        finished = []
        if self._begun and packet.timestamp != self._timestamp:
            if lost_before:
                self._damaged = True
            finished.append(self._finish())
        if not self._begun:
            self._begin(packet.timestamp, after_loss=lost_before)
        elif lost_before:
            self._damaged = True
            self._open_fragment = _NO_NAL_TYPE
        if not self._add_payload(packet.payload):
            self.malformed += 1
            self._damaged = True
        if packet.marker:
            finished.append(self._finish())
        return finished

    def _begin(self, timestamp: int, *, after_loss: bool) -> None:
        """Start an empty access unit."""
        self._begun = True
        self._timestamp = timestamp
        self._after_loss = after_loss
        self._data = bytearray()
        self._first_kind = _NO_NAL_TYPE
        self._keyframe = False
        self._damaged = False
        self._open_fragment = _NO_NAL_TYPE

    def _finish(self) -> AccessUnit:
        """Finish the current access unit and return it."""
        damaged = self._damaged or self._open_fragment != _NO_NAL_TYPE
        # After a loss, perhaps the first packets of this unit or a picture that it refers to were lost. A keyframe that
        # begins with its parameter sets or a delimiter has its first packets, and refers to no picture.
        is_self_contained = self._keyframe and self._first_kind in (_PARAMETER_SET, _DELIMITER)
        complete = not damaged and bool(self._data) and (is_self_contained or not self._after_loss)
        unit = AccessUnit(bytes(self._data), self._timestamp, complete, self._keyframe)
        self._begun = False
        return unit

    def _add_payload(self, payload: bytes) -> bool:
        """Add the contents of a payload; return False if it is not H.264 in packetization mode 1."""
        if not payload or payload[0] & _FORBIDDEN or len(self._data) + len(payload) > MAX_ACCESS_UNIT_BYTES:
            return False
        kind = payload[0] & _NAL_TYPE
        if kind == _FU_A:
            return self._add_fragment(payload)
        if self._open_fragment != _NO_NAL_TYPE:
            self._damaged = True
            self._open_fragment = _NO_NAL_TYPE
        if kind == _STAP_A:
            return self._add_aggregate(payload)
        return self._begin_nal_unit(payload[0]) and self._append(payload[1:])

    def _add_aggregate(self, payload: bytes) -> bool:
        """Add the NAL units of a STAP-A up to the first malformed one; return whether all are well formed."""
        end = 1
        while end < len(payload):
            length_begin, begin = end, end + 2
            end = begin + int.from_bytes(payload[length_begin:begin], "big")
            if end > len(payload) or end == begin or not self._begin_nal_unit(payload[begin]):
                return False
            self._append(payload[begin + 1 : end])
        return len(payload) > 1

    def _add_fragment(self, payload: bytes) -> bool:
        """Add an FU-A; return False if it is malformed.

        Fragments after a gap are dropped: a decoder copes better with a NAL unit that ends early.
        """
        if len(payload) < 2:
            return False
        kind = payload[1] & _NAL_TYPE
        starts, ends = bool(payload[1] & _FU_START), bool(payload[1] & _FU_END)
        if kind == _NO_NAL_TYPE or (starts and ends):
            return False
        if starts:
            self._damaged = self._damaged or self._open_fragment != _NO_NAL_TYPE
            if not self._begin_nal_unit(payload[0] & ~_NAL_TYPE | kind):
                return False
        elif self._open_fragment != kind:
            self._damaged = True
            self._open_fragment = _NO_NAL_TYPE
            return True
        self._open_fragment = _NO_NAL_TYPE if ends else kind
        return self._append(payload[2:])

    def _begin_nal_unit(self, header: int) -> bool:
        """Start a NAL unit with its header byte; return False if its type is not that of a single NAL unit."""
        kind = header & _NAL_TYPE
        if not 1 <= kind <= _LAST_SINGLE_NAL or header & _FORBIDDEN:
            return False
        if self._first_kind == _NO_NAL_TYPE:
            self._first_kind = kind
        self._keyframe = self._keyframe or kind == _SLICE_OF_IDR
        self._data += _START_CODE
        self._data.append(header)
        return True

    def _append(self, part: bytes) -> bool:
        """Append bytes to the current NAL unit; return True."""
        self._data += part
        return True
