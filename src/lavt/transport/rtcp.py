"""What a receiver of video tells its sender: receiver reports (RFC 3550) and picture-loss indications (RFC 4585).

RTCP shares the port with RTP; which of the two a datagram is shows in its second byte (RFC 5761).
"""

from __future__ import annotations

import struct
from typing import Final

from lavt.errors import BadPacket
from lavt.value import value

_HEADER = struct.Struct("!BBH")
_SSRC = struct.Struct("!I")
_REPORT = struct.Struct("!IIIIII")
_VERSION_2: Final = 0x80
_PADDING: Final = 0x20
_COUNT: Final = 0x1F

_SENDER_REPORT: Final = 200
_RECEIVER_REPORT: Final = 201
_PAYLOAD_FEEDBACK: Final = 206
_PICTURE_LOSS: Final = 1
_SENDER_INFORMATION_BYTES: Final = 20

_MAX_LOST: Final = 2**23 - 1
_RTP_HEADER_BYTES: Final = 12
_RTCP_HEADER_BYTES: Final = 8


@value
class ReceptionReport:
    """How a stream arrives at one receiver (RFC 3550, section 6.4.1)."""

    media_ssrc: int
    highest_sequence: int
    """Extended by the number of wraps, modulo 2^32."""
    lost_fraction: float
    """Share of packets lost since the report before, in [0, 1), in steps of 1/256."""
    cumulative_lost: int
    """Packets lost since the beginning; duplicates can make it negative."""
    jitter: int
    """Mean deviation of the arrival spacing, in ticks of the RTP clock (90 kHz)."""


@value
class Feedback:
    """What one RTCP datagram says."""

    reports: tuple[ReceptionReport, ...]
    picture_loss: bool
    """The receiver asks for a keyframe."""


def receiver_report(
    ssrc: int, media_ssrc: int, *, highest_sequence: int, lost_fraction: float, cumulative_lost: int, jitter: int
) -> bytes:
    """Write the receiver report of receiver `ssrc` about the stream `media_ssrc`; values beyond their field are cut."""
    fraction = min(max(int(lost_fraction * 256), 0), 255)
    lost = min(max(cumulative_lost, -_MAX_LOST - 1), _MAX_LOST) % 2**24
    block = _REPORT.pack(media_ssrc, fraction << 24 | lost, highest_sequence % 2**32, min(jitter, 2**32 - 1), 0, 0)
    return _packet(_RECEIVER_REPORT, 1, _SSRC.pack(ssrc) + block)


def picture_loss(ssrc: int, media_ssrc: int) -> bytes:
    """Write the request of receiver `ssrc` for a keyframe of the stream `media_ssrc` (RFC 4585, section 6.3.1).

    It follows an empty receiver report, since every RTCP datagram begins with a report (RFC 3550, section 6.1).
    """
    request = _SSRC.pack(ssrc) + _SSRC.pack(media_ssrc)
    return _packet(_RECEIVER_REPORT, 0, _SSRC.pack(ssrc)) + _packet(_PAYLOAD_FEEDBACK, _PICTURE_LOSS, request)


def parse_feedback(datagram: bytes) -> Feedback:
    """Read an RTCP datagram; kinds of packets that say nothing of interest are passed over.

    Raises `BadPacket` for what fails the checks of RFC 3550, A.2, or holds a packet shorter than its own contents.
    """
    if len(datagram) < _RTCP_HEADER_BYTES or datagram[1] not in {_SENDER_REPORT, _RECEIVER_REPORT}:
        raise BadPacket("an RTCP datagram begins with a report")
    reports: list[ReceptionReport] = []
    lost = False
    begin = 0
    while begin < len(datagram):
        count, kind, body = _next_packet(datagram, begin)
        begin += _HEADER.size + len(body)
        if kind == _RECEIVER_REPORT:
            reports += _blocks(body, _SSRC.size, count)
        elif kind == _SENDER_REPORT:
            reports += _blocks(body, _SSRC.size + _SENDER_INFORMATION_BYTES, count)
        elif kind == _PAYLOAD_FEEDBACK and count == _PICTURE_LOSS:
            if len(body) < 2 * _SSRC.size:
                raise BadPacket("picture-loss indication cut off")
            lost = True
    return Feedback(tuple(reports), lost)


def is_rtcp(datagram: bytes) -> bool:
    """Tell whether a datagram on a port of RTP and RTCP is RTCP (RFC 5761, section 4)."""
    return len(datagram) >= _RTCP_HEADER_BYTES and datagram[0] >> 6 == 2 and 192 <= datagram[1] <= 223


def is_rtp(datagram: bytes) -> bool:
    """Tell whether a datagram on a port of RTP and RTCP is RTP: payload types 64 to 95 cannot be (RFC 5761)."""
    return len(datagram) >= _RTP_HEADER_BYTES and datagram[0] >> 6 == 2 and not 64 <= datagram[1] & 0x7F <= 95


def _packet(kind: int, count: int, body: bytes) -> bytes:
    """Put a header before the body of an RTCP packet; its length is in words of four bytes, less one."""
    return _HEADER.pack(_VERSION_2 | count, kind, len(body) // 4) + body


def _next_packet(datagram: bytes, begin: int) -> tuple[int, int, bytes]:
    """Take count, type and body of the RTCP packet at `begin`."""
    if begin + _HEADER.size > len(datagram):
        raise BadPacket("RTCP header cut off")
    first, kind, words = _HEADER.unpack_from(datagram, begin)
    end = begin + _HEADER.size + 4 * words
    if first >> 6 != 2 or end > len(datagram):
        raise BadPacket("not RTCP version 2, or cut off")
    if first & _PADDING and end != len(datagram):
        raise BadPacket("padding before the last RTCP packet")
    return first & _COUNT, kind, datagram[begin + _HEADER.size : end]


def _blocks(body: bytes, begin: int, count: int) -> list[ReceptionReport]:
    """Read the `count` report blocks of a report, which begin at `begin`."""
    if begin + count * _REPORT.size > len(body):
        raise BadPacket("fewer report blocks than announced")
    reports = []
    for at in range(begin, begin + count * _REPORT.size, _REPORT.size):
        media_ssrc, loss, highest, jitter, _, _ = _REPORT.unpack_from(body, at)
        lost = loss & 0xFF_FFFF
        signed = lost - 2**24 if lost > _MAX_LOST else lost
        reports.append(ReceptionReport(media_ssrc, highest, (loss >> 24) / 256, signed, jitter))
    return reports
