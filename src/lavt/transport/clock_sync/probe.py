"""The second opinion on the offset between two clocks: four times, over a UDP port of its own that is never delayed.

A request and its reply are 48 bytes each, so that nobody can use a server to send more than was sent to it:

    "LC", version, kind (0 request, 1 reply), sequence (32 bits), t1, t2, t3 (64 bits each, nanoseconds of a wall
    clock), correction and bound of the server's own source of time (doubles, seconds; NaN: not known)

in network order; what only the server knows is zero in a request. t1 is when the client sent, t2 when the server
received, t3 when it answered; t4, when the client received, stays with the client. (RFC 5905, section 8, has the same
four times.)
"""

from __future__ import annotations

import math
import struct

from lavt.errors import BadMessage
from lavt.value import value

DEFAULT_PORT = 5602
"""UDP, of the server."""
VERSION = 1
LAYOUT = struct.Struct(">2sBBIqqqdd")
MAGIC = b"LC"
REQUEST, REPLY = 0, 1
SEQUENCES = 2**32
UNKNOWN = math.nan
LATEST_NS = 2**62
"""In the year 2116; sums of two such times still fit into 64 bits."""


@value
class ProbeReply:
    """A reply as it is on the wire; a request is one of which only `sequence` and `sent_wall_ns` are known."""

    sequence: int
    sent_wall_ns: int
    """t1, on the client's clock."""
    received_wall_ns: int
    """t2, on the server's clock."""
    answered_wall_ns: int
    """t3, on the server's clock."""
    correction_s: float | None
    """What the server's source of time says of the server's clock."""
    bound_s: float | None


@value
class ClockProbe:
    """One exchange as it is written down: all four times."""

    sequence: int
    sent_wall_ns: int
    received_wall_ns: int
    answered_wall_ns: int
    arrived_wall_ns: int

    @property
    def offset_ns(self) -> float:
        """The middle of all that Delta, the server's clock less the client's, can be: each way takes half the time."""
        there_ns = self.received_wall_ns - self.sent_wall_ns
        return (there_ns - (self.arrived_wall_ns - self.answered_wall_ns)) / 2

    @property
    def round_trip_ns(self) -> int:
        """Time on the network: Delta is within half of it from `offset_ns`, however it is shared between both ways."""
        return self.arrived_wall_ns - self.sent_wall_ns - (self.answered_wall_ns - self.received_wall_ns)


def encode_request(sequence: int, sent_wall_ns: int) -> bytes:
    """Ask for the server's time."""
    return LAYOUT.pack(MAGIC, VERSION, REQUEST, sequence, sent_wall_ns, 0, 0, 0.0, 0.0)


def decode_request(data: bytes) -> tuple[int, int]:
    """Read a request's sequence and t1; raises `BadMessage` for anything that is not one."""
    sequence, sent_wall_ns, *_ = _fields(data, REQUEST)
    return sequence, sent_wall_ns


def encode_reply(reply: ProbeReply) -> bytes:
    """Answer a request."""
    known = [UNKNOWN if each is None else each for each in (reply.correction_s, reply.bound_s)]
    times = (reply.sent_wall_ns, reply.received_wall_ns, reply.answered_wall_ns)
    return LAYOUT.pack(MAGIC, VERSION, REPLY, reply.sequence, *times, *known)


def decode_reply(data: bytes) -> ProbeReply:
    """Read a reply; raises `BadMessage` for anything that is not one."""
    sequence, sent_wall_ns, received_wall_ns, answered_wall_ns, correction_s, bound_s = _fields(data, REPLY)
    if received_wall_ns > answered_wall_ns:
        raise BadMessage("a probe that was answered before it came")
    known = math.isfinite(correction_s) and 0 <= bound_s < math.inf
    return ProbeReply(
        sequence,
        sent_wall_ns,
        received_wall_ns,
        answered_wall_ns,
        correction_s if known else None,
        bound_s if known else None,
    )


def _fields(data: bytes, wanted: int) -> tuple[int, int, int, int, float, float]:
    if len(data) != LAYOUT.size:
        raise BadMessage(f"{len(data)} bytes are no probe ({LAYOUT.size})")
    magic, version, kind, sequence, *rest = LAYOUT.unpack(data)
    if (magic, version, kind) != (MAGIC, VERSION, wanted):
        raise BadMessage("not a probe of this version and kind")
    if not all(0 <= time_ns < LATEST_NS for time_ns in rest[:3]):
        raise BadMessage("a probe with a time that cannot be")
    return sequence, rest[0], rest[1], rest[2], rest[3], rest[4]
