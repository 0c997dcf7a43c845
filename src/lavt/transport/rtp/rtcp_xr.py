"""Extended reports (RFC 3611) by which a receiver, too, knows the round trip: reference times and their answers.

The receiver sends what its clock says (section 4.4), the sender sends that back with how long it kept it (section 4.5).
`rtcp.py` puts these bodies into RTCP packets of type 207. Blocks have the header of RTCP packets (section 3).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Final

from lavt.errors import BadPacket
from lavt.transport.rtp.ntp_time import delay_ns_of, ntp_of_elapsed, round_trip_ns, short_delay, short_time
from lavt.value import value

_HEADER = struct.Struct("!BBH")
_SSRC = struct.Struct("!I")
_REFERENCE_TIME = struct.Struct("!Q")
_ANSWER = struct.Struct("!III")
_REFERENCE_TIME_BLOCK: Final = 4
_ANSWERS_BLOCK: Final = 5


@value
class ReferenceTime:
    """What a receiver's clock said when it wrote its report (RFC 3611, section 4.4)."""

    receiver_ssrc: int
    time: int
    """Middle 32 bits."""


@value
class ReferenceAnswer:
    """A reference time on its way back to its receiver (RFC 3611, section 4.5)."""

    receiver_ssrc: int
    time: int
    """Middle 32 bits, as they came."""
    age_ns: int
    """How long before this answer it had come; on the wire in steps of 1/65536 s."""


def answered_round_trip_ns(answer: ReferenceAnswer, arrived_clock_ns: int) -> int | None:
    """Give the receiver the round trip from an answer that came at `arrived_clock_ns`; None: it says none.

    The clock is the one of the reference time. Whether the answer is ours, its `receiver_ssrc` says.
    """
    return round_trip_ns(short_time(ntp_of_elapsed(arrived_clock_ns)), answer.time, answer.age_ns)


def write_reference_time(ssrc: int, clock_ns: int) -> bytes:
    """Write the body with what the clock of receiver `ssrc` says; any clock will do that is never set."""
    return _body(ssrc, _REFERENCE_TIME_BLOCK, _REFERENCE_TIME.pack(ntp_of_elapsed(clock_ns)))


def write_answers(ssrc: int, answers: Sequence[ReferenceAnswer]) -> bytes:
    """Write the body with the answers of sender `ssrc`."""
    entries = [_ANSWER.pack(each.receiver_ssrc, each.time, short_delay(each.age_ns)) for each in answers]
    return _body(ssrc, _ANSWERS_BLOCK, b"".join(entries))


def read_reference_times(body: bytes) -> list[ReferenceTime]:
    """Read the reference times; raises `BadPacket` for a block of a length it cannot have."""
    times = []
    for kind, block in _blocks(body):
        if kind == _REFERENCE_TIME_BLOCK:
            if len(block) != _REFERENCE_TIME.size:
                raise BadPacket("reference time of a wrong length")
            (receiver_ssrc,), (ntp_time,) = _SSRC.unpack_from(body), _REFERENCE_TIME.unpack(block)
            times.append(ReferenceTime(receiver_ssrc, short_time(ntp_time)))
    return times


def read_answers(body: bytes) -> list[ReferenceAnswer]:
    """Read the answers to reference times; raises `BadPacket` for a block of a length it cannot have."""
    answers: list[ReferenceAnswer] = []
    for kind, block in _blocks(body):
        if kind == _ANSWERS_BLOCK:
            if len(block) % _ANSWER.size:
                raise BadPacket("answers to reference times of a wrong length")
            answers += [ReferenceAnswer(ssrc, time, delay_ns_of(age)) for ssrc, time, age in _ANSWER.iter_unpack(block)]
    return answers


def _body(ssrc: int, kind: int, block: bytes) -> bytes:
    return _SSRC.pack(ssrc) + _HEADER.pack(kind, 0, len(block) // 4) + block


def _blocks(body: bytes) -> Iterator[tuple[int, bytes]]:
    """Give type and content of each block; a body is whole words of four bytes."""
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
