"""The clock probe: an estimate of the offset between two clocks from four times, over a UDP port that is never delayed.

A request and its reply are 48 bytes each, so that a server cannot be used for amplification:

    "LC", version, kind (0 request, 1 reply), sequence (32 bits), t1, t2, t3 (64 bits each, nanoseconds of a wall
    clock), correction and bound of the server's own time source (doubles, seconds; NaN: unknown)

in network byte order. A request has zeros in the fields that only the server knows. t1 is when the client sent the
request, t2 when the server received it, t3 when the server replied. t4, when the client received the reply, is not
sent. (RFC 5905, section 8, has the same four times.)
"""

from __future__ import annotations

import math
import struct

from msgspec import Struct

from lavt.errors import BadMessage

DEFAULT_PORT = 5602
"""The server's UDP port."""
VERSION = 1
LAYOUT = struct.Struct(">2sBBIqqqdd")
MAGIC = b"LC"
REQUEST, REPLY = 0, 1
SEQUENCES = 2**32
UNKNOWN = math.nan
LATEST_NS = 2**62
"""In the year 2116; the sum of two such times fits into 64 bits."""


class ProbeReply(Struct, frozen=True):
    """A reply on the wire; in a request only `sequence` and `sent_wall_ns` are known."""

    sequence: int
    sent_wall_ns: int
    """t1, on the client's clock."""
    received_wall_ns: int
    """t2, on the server's clock."""
    answered_wall_ns: int
    """t3, on the server's clock."""
    correction_s: float | None
    """The correction of the server's clock, from the server's time source."""
    bound_s: float | None


class ClockProbe(Struct, frozen=True):
    """One exchange with all four times (t1 to t4, in this order), as it is recorded."""

    sequence: int
    sent_wall_ns: int
    received_wall_ns: int
    answered_wall_ns: int
    arrived_wall_ns: int

    @property
    def offset_ns(self) -> float:
        """The estimate of Delta, the server's clock minus the client's; exact if both directions take the same time."""
        forward_ns = self.received_wall_ns - self.sent_wall_ns
        return (forward_ns - (self.arrived_wall_ns - self.answered_wall_ns)) / 2

    @property
    def round_trip_ns(self) -> int:
        """Time on the network. The error of `offset_ns` is at most half of it, however asymmetric the path is."""
        return self.arrived_wall_ns - self.sent_wall_ns - (self.answered_wall_ns - self.received_wall_ns)


def encode_request(sequence: int, sent_wall_ns: int) -> bytes:
    """Return a request for the server's time."""
    return LAYOUT.pack(MAGIC, VERSION, REQUEST, sequence, sent_wall_ns, 0, 0, 0.0, 0.0)


def decode_request(data: bytes) -> tuple[int, int]:
    """Return a request's sequence and t1. Raise `BadMessage` for anything else."""
    sequence, sent_wall_ns, *_ = _unpack(data, REQUEST)
    return sequence, sent_wall_ns


def encode_reply(reply: ProbeReply) -> bytes:
    """Return a reply in its wire format."""
    estimate = [UNKNOWN if value is None else value for value in (reply.correction_s, reply.bound_s)]
    times = (reply.sent_wall_ns, reply.received_wall_ns, reply.answered_wall_ns)
    return LAYOUT.pack(MAGIC, VERSION, REPLY, reply.sequence, *times, *estimate)


def decode_reply(data: bytes) -> ProbeReply:
    """Parse a reply. Raise `BadMessage` for anything else."""
    sequence, sent_wall_ns, received_wall_ns, answered_wall_ns, correction_s, bound_s = _unpack(data, REPLY)
    if received_wall_ns > answered_wall_ns:
        raise BadMessage("a probe that was answered before it was received")
    is_known = math.isfinite(correction_s) and 0 <= bound_s < math.inf
    return ProbeReply(
        sequence,
        sent_wall_ns,
        received_wall_ns,
        answered_wall_ns,
        correction_s if is_known else None,
        bound_s if is_known else None,
    )


def _unpack(data: bytes, expected_kind: int) -> tuple[int, int, int, int, float, float]:
    if len(data) != LAYOUT.size:
        raise BadMessage(f"a probe has {LAYOUT.size} bytes, not {len(data)}")
    magic, version, kind, sequence, *rest = LAYOUT.unpack(data)
    if (magic, version, kind) != (MAGIC, VERSION, expected_kind):
        raise BadMessage("not a probe of this version and kind")
    t1_ns, t2_ns, t3_ns, correction_s, bound_s = rest
    if not all(0 <= time_ns < LATEST_NS for time_ns in (t1_ns, t2_ns, t3_ns)):
        raise BadMessage("a probe with a time out of range")
    return sequence, t1_ns, t2_ns, t3_ns, correction_s, bound_s
