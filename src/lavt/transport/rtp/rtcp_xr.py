"""Extended reports (RFC 3611) that give the receiver the round-trip time: reference times and their answers.

The receiver sends the time of its clock (section 4.4). The sender returns this time with the delay since its arrival
(section 4.5). The sender itself gets the round-trip time from ordinary reports (RFC 3550). `rtcp.py` puts the bodies
written here into RTCP packets of type 207. The header of a block has the layout of an RTCP packet's header (section 3).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Final

from msgspec import Struct

from lavt.errors import BadPacket
from lavt.transport.rtp.ntp_time import delay_to_short, elapsed_to_ntp, ntp_to_short, round_trip_ns, short_to_delay_ns

_HEADER = struct.Struct("!BBH")
_SSRC = struct.Struct("!I")
_REFERENCE_TIME = struct.Struct("!Q")
_ANSWER = struct.Struct("!III")
_REFERENCE_TIME_BLOCK: Final = 4
_ANSWERS_BLOCK: Final = 5


class ReferenceTime(Struct, frozen=True):
    """The time of a receiver's clock when it wrote its report (RFC 3611, section 4.4)."""

    receiver_ssrc: int
    time: int
    """In NTP short format."""


class ReferenceAnswer(Struct, frozen=True):
    """A reference time that a sender returns to its receiver (RFC 3611, section 4.5)."""

    receiver_ssrc: int
    time: int
    """In NTP short format, as received."""
    age_ns: int
    """Time from the arrival of the reference time to this answer; on the wire in steps of 1/65536 s."""


def round_trip_of_answer_ns(answer: ReferenceAnswer, arrived_clock_ns: int) -> int | None:
    """Return the round-trip time from an answer that arrived at `arrived_clock_ns`, or None if that is impossible.

    The clock is that of the reference time. The caller must check that `receiver_ssrc` is its own SSRC.
    """
    return round_trip_ns(ntp_to_short(elapsed_to_ntp(arrived_clock_ns)), answer.time, answer.age_ns)


def write_reference_time(ssrc: int, clock_ns: int) -> bytes:
    """Write the body with the clock of receiver `ssrc`, which may be any clock that is never stepped."""
    return _body(ssrc, _REFERENCE_TIME_BLOCK, _REFERENCE_TIME.pack(elapsed_to_ntp(clock_ns)))


def write_answers(ssrc: int, answers: Sequence[ReferenceAnswer]) -> bytes:
    """Write the body with the answers of sender `ssrc`."""
    entries = [_ANSWER.pack(answer.receiver_ssrc, answer.time, delay_to_short(answer.age_ns)) for answer in answers]
    return _body(ssrc, _ANSWERS_BLOCK, b"".join(entries))


def read_reference_times(body: bytes) -> list[ReferenceTime]:
    """Read the reference times; raises `BadPacket` for a block of a wrong length."""
    times = []
    for kind, block in _blocks(body):
        if kind == _REFERENCE_TIME_BLOCK:
            if len(block) != _REFERENCE_TIME.size:
                raise BadPacket("reference time of a wrong length")
            (receiver_ssrc,), (ntp_time,) = _SSRC.unpack_from(body), _REFERENCE_TIME.unpack(block)
            times.append(ReferenceTime(receiver_ssrc, ntp_to_short(ntp_time)))
    return times


def read_answers(body: bytes) -> list[ReferenceAnswer]:
    """Read the answers to reference times; raises `BadPacket` for a block of a wrong length."""
    answers: list[ReferenceAnswer] = []
    for kind, block in _blocks(body):
        if kind == _ANSWERS_BLOCK:
            if len(block) % _ANSWER.size:
                raise BadPacket("answers to reference times of a wrong length")
            answers += [
                ReferenceAnswer(ssrc, time, short_to_delay_ns(age)) for ssrc, time, age in _ANSWER.iter_unpack(block)
            ]
    return answers


def _body(ssrc: int, kind: int, block: bytes) -> bytes:
    return _SSRC.pack(ssrc) + _HEADER.pack(kind, 0, len(block) // 4) + block


def _blocks(body: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of each block; a body consists of whole words of four bytes."""
    if len(body) < _SSRC.size:
        raise BadPacket("extended report cut off")
    begin = _SSRC.size
    while begin < len(body):
        kind, _, words = _HEADER.unpack_from(body, begin)
        begin += _HEADER.size
        if begin + 4 * words > len(body):
            raise BadPacket("block of an extended report cut off")
        yield kind, body[begin : begin + 4 * words]
        begin += 4 * words
