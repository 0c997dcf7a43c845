"""RTCP: the control messages between the sender and the receiver of a video.

The sender sends sender reports (RFC 3550, section 6.4.1) and, in extended reports (RFC 3611), the answer to the
receiver's reference time (section 4.5). The receiver sends receiver reports (RFC 3550, section 6.4.2), its reference
time (RFC 3611, section 4.4), picture-loss indications (RFC 4585, section 6.3.1) and its limit of the bit rate (RFC
5104, section 4.2.1). Both ends can compute the round-trip time without a common clock.

Every datagram written here begins with a report and a source description (RFC 3550, section 6.1). RTCP shares the port
with RTP; the second byte of a datagram distinguishes them (RFC 5761).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Final

from msgspec import Struct

from lavt.errors import BadPacket
from lavt.transport.rtp.ntp_time import delay_to_short, short_to_delay_ns, wall_to_ntp
from lavt.transport.rtp.rtcp_xr import (
    ReferenceAnswer,
    ReferenceTime,
    read_answers,
    read_reference_times,
    write_answers,
    write_reference_time,
)

RECEIVER_CNAME: Final = "receiver@lavt"
OVERHEAD_BYTES: Final = 40
"""Headers of each packet: IPv4 20, UDP 8, RTP 12."""

_HEADER = struct.Struct("!BBH")
_SSRC = struct.Struct("!I")
_REPORT = struct.Struct("!IIIIII")
_SENDER_INFORMATION = struct.Struct("!IQIII")
_FEEDBACK = struct.Struct("!II")
_BIT_RATE = struct.Struct("!II")

_VERSION_2: Final = 0x80
_PADDING: Final = 0x20
_COUNT: Final = 0x1F

_SENDER_REPORT: Final = 200
_RECEIVER_REPORT: Final = 201
_SOURCE_DESCRIPTION: Final = 202
_TRANSPORT_FEEDBACK: Final = 205
_PAYLOAD_FEEDBACK: Final = 206
_EXTENDED_REPORT: Final = 207

_CNAME: Final = 1
"""Type of an item in a source description."""
_MAX_BIT_RATE: Final = 3
"""Type of a transport feedback; it stands in the header's field for the count."""
_PICTURE_LOSS: Final = 1
"""Type of a payload feedback; it stands in the header's field for the count."""

_BEFORE_BLOCKS: Final = {_SENDER_REPORT: _SENDER_INFORMATION.size, _RECEIVER_REPORT: _SSRC.size}
"""Bytes of a report's body before its report blocks."""
_MAX_LOST: Final = 2**23 - 1
_MAX_WORD: Final = 2**32 - 1
_MAX_BIT_RATE_BPS: Final = (2**17 - 1) << 63
_RTCP_HEADER_BYTES: Final = 8


class SenderReport(Struct, frozen=True):
    """The time of a sender's report, and the counts of what was sent until then (RFC 3550, section 6.4.1)."""

    ssrc: int
    ntp_time: int
    """NTP timestamp (64 bits) of the report, by the sender's wall clock."""
    rtp_timestamp: int
    """RTP timestamp of the same moment."""
    packets: int
    octets: int
    """Bytes of payload sent, without headers."""


class ReceptionReport(Struct, frozen=True):
    """Reception quality of a stream at one receiver (RFC 3550, section 6.4.1)."""

    media_ssrc: int
    highest_sequence: int
    """Extended by the number of wraps, modulo 2^32."""
    lost_fraction: float
    """Share of packets lost since the previous report, in [0, 1), in steps of 1/256."""
    cumulative_lost: int
    """Packets lost since the stream began; duplicates can make it negative."""
    jitter: int
    """Mean deviation of the arrival spacing, in ticks of the RTP clock (90 kHz)."""
    last_report: int = 0
    """NTP time of the last sender report received, in short format; 0: none."""
    last_report_age_ns: int = 0
    """Time from the arrival of that sender report to this report, in steps of 1/65536 s."""


class BitRateLimit(Struct, frozen=True):
    """A receiver's limit of the bit rate of one stream (RFC 5104, section 4.2.1.1)."""

    media_ssrc: int
    bit_rate_bps: int
    """Includes `overhead_bytes` of headers for each packet."""
    overhead_bytes: int


class Feedback(Struct, frozen=True):
    """The contents of an RTCP datagram that concern a sender."""

    reports: tuple[ReceptionReport, ...] = ()
    picture_loss: bool = False
    """The receiver lost a picture and requests a keyframe."""
    limits: tuple[BitRateLimit, ...] = ()
    reference_times: tuple[ReferenceTime, ...] = ()


class Announcement(Struct, frozen=True):
    """The contents of an RTCP datagram that concern a receiver."""

    reports: tuple[SenderReport, ...] = ()
    answers: tuple[ReferenceAnswer, ...] = ()


def sender_report(
    ssrc: int,
    *,
    wall_ns: int,
    rtp_timestamp: int,
    packets: int,
    octets: int,
    cname: str,
    answered: Sequence[ReferenceAnswer] = (),
) -> bytes:
    """Write a sender report with answers to the reference times of receivers.

    `rtp_timestamp` and `wall_ns` (ns since 1970) are the same moment. Counts wrap at 2^32.
    """
    information = _SENDER_INFORMATION.pack(ssrc, wall_to_ntp(wall_ns), rtp_timestamp, packets % 2**32, octets % 2**32)
    datagram = _packet(_SENDER_REPORT, 0, information) + _description(ssrc, cname)
    if answered:
        datagram += _packet(_EXTENDED_REPORT, 0, write_answers(ssrc, answered))
    return datagram


def receiver_report(ssrc: int, report: ReceptionReport, *, clock_ns: int, cname: str = RECEIVER_CNAME) -> bytes:
    """Write the receiver report of receiver `ssrc` with its reference time; values are clamped to their fields.

    `clock_ns` is any clock of the receiver that is never stepped; `round_trip_of_answer_ns` needs the same clock.
    """
    fraction = min(max(int(report.lost_fraction * 256), 0), 255)
    lost = min(max(report.cumulative_lost, -_MAX_LOST - 1), _MAX_LOST) % 2**24
    block = _REPORT.pack(
        report.media_ssrc,
        fraction << 24 | lost,
        report.highest_sequence % 2**32,
        min(report.jitter, _MAX_WORD),
        report.last_report,
        delay_to_short(report.last_report_age_ns),
    )
    return (
        _packet(_RECEIVER_REPORT, 1, _SSRC.pack(ssrc) + block)
        + _description(ssrc, cname)
        + _packet(_EXTENDED_REPORT, 0, write_reference_time(ssrc, clock_ns))
    )


def picture_loss(ssrc: int, media_ssrc: int, *, cname: str = RECEIVER_CNAME) -> bytes:
    """Write the picture-loss indication of receiver `ssrc` for the stream `media_ssrc` (RFC 4585, section 6.3.1).

    It requests a keyframe.
    """
    return _empty_report(ssrc, cname) + _packet(_PAYLOAD_FEEDBACK, _PICTURE_LOSS, _FEEDBACK.pack(ssrc, media_ssrc))


def max_bit_rate(
    ssrc: int,
    media_ssrc: int,
    bit_rate_bps: int,
    *,
    overhead_bytes: int = OVERHEAD_BYTES,
    cname: str = RECEIVER_CNAME,
) -> bytes:
    """Write the request of receiver `ssrc` to send `media_ssrc` with at most `bit_rate_bps` (RFC 5104, section 4.2.1).

    The bit rate includes `overhead_bytes` (at most 511) for each packet. It is sent with 17 significant bits, rounded
    down; values are clamped to their fields.
    """
    rate = min(max(bit_rate_bps, 0), _MAX_BIT_RATE_BPS)
    exponent = max(rate.bit_length() - 17, 0)
    word = exponent << 26 | rate >> exponent << 9 | min(overhead_bytes, 511)
    # The SSRC of the stream is in the entry with its limit, not in the header (RFC 5104, section 4.2.1.2).
    body = _FEEDBACK.pack(ssrc, 0) + _BIT_RATE.pack(media_ssrc, word)
    return _empty_report(ssrc, cname) + _packet(_TRANSPORT_FEEDBACK, _MAX_BIT_RATE, body)


def parse_feedback(datagram: bytes) -> Feedback:
    """Parse an RTCP datagram as a sender; contents that do not concern a sender are skipped.

    Raises `BadPacket` for a datagram that fails the checks of RFC 3550, A.2, or has a part of an impossible length.
    """
    reports: list[ReceptionReport] = []
    limits: list[BitRateLimit] = []
    references: list[ReferenceTime] = []
    picture_lost = False
    for count, kind, body in _packets(datagram):
        if kind in _BEFORE_BLOCKS:
            reports += _report_blocks(kind, count, body)
        elif (kind, count) == (_PAYLOAD_FEEDBACK, _PICTURE_LOSS):
            _check(len(body) == _FEEDBACK.size, "picture-loss indication of a wrong length")
            picture_lost = True
        elif (kind, count) == (_TRANSPORT_FEEDBACK, _MAX_BIT_RATE):
            limits += _limits(body)
        elif kind == _EXTENDED_REPORT:
            references += read_reference_times(body)
    return Feedback(tuple(reports), picture_lost, tuple(limits), tuple(references))


def parse_announcement(datagram: bytes) -> Announcement:
    """Parse an RTCP datagram as a receiver; contents that do not concern a receiver are skipped.

    Raises `BadPacket` for a datagram that fails the checks of RFC 3550, A.2, or has a part of an impossible length.
    """
    reports: list[SenderReport] = []
    answers: list[ReferenceAnswer] = []
    for count, kind, body in _packets(datagram):
        if kind in _BEFORE_BLOCKS:
            _report_blocks(kind, count, body)  # checks their lengths
        if kind == _SENDER_REPORT:
            reports.append(SenderReport(*_SENDER_INFORMATION.unpack_from(body)))
        elif kind == _EXTENDED_REPORT:
            answers += read_answers(body)
    return Announcement(tuple(reports), tuple(answers))


def is_rtcp(datagram: bytes) -> bool:
    """Return whether a datagram on a port of RTP and RTCP is RTCP (RFC 5761, section 4)."""
    return len(datagram) >= _RTCP_HEADER_BYTES and datagram[0] >> 6 == 2 and 192 <= datagram[1] <= 223


def _packet(kind: int, count: int, body: bytes) -> bytes:
    """Return an RTCP packet with its header, which has the packet's length in words of four bytes, minus one."""
    return _HEADER.pack(_VERSION_2 | count, kind, len(body) // 4) + body


def _empty_report(ssrc: int, cname: str) -> bytes:
    """Write the empty report and description with which a request must begin (RFC 4585, section 3.1)."""
    return _packet(_RECEIVER_REPORT, 0, _SSRC.pack(ssrc)) + _description(ssrc, cname)


def _description(ssrc: int, cname: str) -> bytes:
    """Write the source description with the CNAME, its first 255 bytes (RFC 3550, section 6.5)."""
    text = cname.encode()[:255]
    item = bytes([_CNAME, len(text)]) + text
    return _packet(_SOURCE_DESCRIPTION, 1, _SSRC.pack(ssrc) + item + bytes(4 - len(item) % 4))


def _check(valid: bool, reason: str) -> None:
    if not valid:
        raise BadPacket(reason)


def _packets(datagram: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield count, type and body without padding of each RTCP packet in a datagram (RFC 3550, A.2)."""
    begins_with_report = len(datagram) >= _RTCP_HEADER_BYTES and datagram[1] in {_SENDER_REPORT, _RECEIVER_REPORT}
    _check(begins_with_report, "an RTCP datagram must begin with a report")
    begin = 0
    while begin < len(datagram):
        _check(begin + _HEADER.size <= len(datagram), "RTCP header cut off")
        first, kind, words = _HEADER.unpack_from(datagram, begin)
        end = begin + _HEADER.size + 4 * words
        _check(first >> 6 == 2 and end <= len(datagram), "not RTCP version 2, or cut off")
        body = datagram[begin + _HEADER.size : end]
        if first & _PADDING:
            _check(end == len(datagram), "padding before the last RTCP packet")
            padding = datagram[-1]
            _check(padding % 4 == 0 and 0 < padding <= len(body), "padding of a wrong length")
            body = body[:-padding]
        yield first & _COUNT, kind, body
        begin = end


def _report_blocks(kind: int, count: int, body: bytes) -> list[ReceptionReport]:
    """Parse the `count` report blocks of a report; extensions may follow them."""
    begin = _BEFORE_BLOCKS[kind]
    end = begin + count * _REPORT.size
    _check(end <= len(body), "fewer report blocks than announced")
    reports = []
    for media_ssrc, loss, highest, jitter, last, age in _REPORT.iter_unpack(body[begin:end]):
        lost = loss & 0xFF_FFFF
        signed = lost - 2**24 if lost > _MAX_LOST else lost
        fraction = (loss >> 24) / 256
        reports.append(ReceptionReport(media_ssrc, highest, fraction, signed, jitter, last, short_to_delay_ns(age)))
    return reports


def _limits(body: bytes) -> list[BitRateLimit]:
    """Parse the entries of a bit rate request: exponent 6 bits, mantissa 17, overhead 9."""
    entries = body[_FEEDBACK.size :]
    _check(bool(entries) and len(entries) % _BIT_RATE.size == 0, "bit rate limits of a wrong length")
    return [
        BitRateLimit(media_ssrc, (word >> 9 & 0x1_FFFF) << (word >> 26), word & 0x1FF)
        for media_ssrc, word in _BIT_RATE.iter_unpack(entries)
    ]
