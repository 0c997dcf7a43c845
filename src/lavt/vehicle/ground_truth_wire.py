"""Datagrams that carry a software car's ground truth and events to the server on the same machine.

A datagram is a msgpack array `[version, truth, events]`: `truth` has the fields of a `GroundTruth` in order,
`events` is a list of `[number, mono_ns, kind, detail]`. Event numbers increase. Each event is repeated in the
following datagrams, so that no event is lost with a datagram. All times are of the monotonic clock of this machine.
"""

from __future__ import annotations

import sys
from collections import Counter, deque
from collections.abc import Sequence
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from lavt.domain import EventKind, GroundTruth, VehicleEvent

VERSION: Final = 1
REPEATS: Final = 20
"""An event is sent in this many datagrams."""
MAX_EVENTS: Final = 16
"""Largest number of events in a datagram; further events wait for the next datagram."""
MAX_DETAIL: Final = 200
"""Largest number of characters of an event's detail; a longer detail is cut."""
MAX_BYTES: Final = 16_384
"""Largest length of a datagram."""

Time = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Finite = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Event = tuple[Time, Time, EventKind, Annotated[str, Meta(max_length=MAX_DETAIL)]]
Datagram = tuple[
    Annotated[int, Meta(ge=VERSION, le=VERSION)],
    tuple[Time, Finite, Finite, Finite, Finite, Finite, Finite, Finite, Finite],
    Annotated[tuple[Event, ...], Meta(max_length=MAX_EVENTS)],
]
_ENCODER = msgspec.msgpack.Encoder()
_DECODER: msgspec.msgpack.Decoder[Datagram] = msgspec.msgpack.Decoder(Datagram)

NumberedEvent = tuple[int, VehicleEvent]
"""The number of an event, and the event."""


def encode_truth(truth: GroundTruth, events: Sequence[NumberedEvent]) -> bytes:
    """Return a datagram with the ground truth and at most `MAX_EVENTS` numbered events."""
    encoded = [(number, event.mono_ns, event.kind, event.detail[:MAX_DETAIL]) for number, event in events]
    return _ENCODER.encode((VERSION, msgspec.structs.astuple(truth), encoded))


def decode_truth(datagram: bytes) -> tuple[GroundTruth, list[NumberedEvent]] | None:
    """Decode a datagram of `encode_truth`; return None for anything else."""
    if len(datagram) > MAX_BYTES:
        return None
    try:
        _, truth, events = _DECODER.decode(datagram)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    return GroundTruth(*truth), [(number, VehicleEvent(at_ns, kind, detail)) for number, at_ns, kind, detail in events]


class TruthSender:
    """An encoder that numbers events and sends each event in `REPEATS` datagrams.

    The first number follows `start_ns`, so that the numbers of a restarted car exceed all earlier numbers.
    """

    def __init__(self, start_ns: int) -> None:
        self._number = start_ns
        self._pending: deque[tuple[int, NumberedEvent]] = deque()
        """The events that are still to be sent, each after the number of datagrams in which it is still to be sent."""

    def make_datagram(self, truth: GroundTruth, new_events: Sequence[VehicleEvent]) -> bytes:
        """Return the next datagram; `new_events` are the events since the last datagram."""
        for event in new_events:
            self._number += 1
            self._pending.append((REPEATS, (self._number, event)))
        chosen = [self._pending.popleft() for _ in range(min(MAX_EVENTS, len(self._pending)))]
        self._pending.extendleft((repeats - 1, event) for repeats, event in reversed(chosen) if repeats > 1)
        return encode_truth(truth, [event for _, event in chosen])


class TruthReceiver:
    """A decoder for untrusted datagrams; anything but a valid ground truth is counted and dropped."""

    def __init__(self) -> None:
        self.newest: GroundTruth | None = None
        self.counts: Counter[str] = Counter()
        """Datagrams by kind: `truths`, `garbage`, and `old` (older than the newest truth)."""
        self._last_number = -1
        """The number of the last returned event."""

    def receive(self, datagram: bytes) -> list[VehicleEvent]:
        """Update `newest` from a datagram, and return the datagram's events that were not returned before."""
        decoded = decode_truth(datagram)
        if decoded is None:
            self.counts["garbage"] += 1
            return []
        truth, events = decoded
        if self.newest is not None and truth.mono_ns < self.newest.mono_ns:
            self.counts["old"] += 1
        else:
            self.counts["truths"] += 1
            self.newest = truth
        new_events = [(number, event) for number, event in events if number > self._last_number]
        self._last_number = max([self._last_number, *(number for number, _ in new_events)])
        return [event for _, event in new_events]
