"""The truth of a software car, and what happened to it, in datagrams to the server on the same machine.

A datagram is a msgpack array `[version, truth, events]`: `truth` has the fields of a `GroundTruth` in their order,
`events` is a list of `[number, mono_ns, kind, detail]`. Events have growing numbers and are said again in the datagrams
that follow, so that none is missed where some are lost. All times are of the monotonic clock of this one machine.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import fields
from operator import attrgetter
from typing import Any, Final, get_args

import msgpack

from lavt.domain import EventKind, GroundTruth, VehicleEvent

VERSION: Final = 1
REPEATS: Final = 20
"""So many datagrams say an event."""
MAX_EVENTS: Final = 16
"""So many events are in a datagram; more have to wait for the next."""
MAX_DETAIL: Final = 200
"""Letters of an event's detail: longer ones are cut."""
MAX_BYTES: Final = 16_384
LATEST: Final = 2**63
KINDS: Final = frozenset(get_args(EventKind))

_NAMES = [field.name for field in fields(GroundTruth)]
_numbers_of = attrgetter(*_NAMES)

Numbered = tuple[int, VehicleEvent]


def write_truth(truth: GroundTruth, events: Sequence[Numbered]) -> bytes:
    """Write a datagram of the truth and of numbered events, at most `MAX_EVENTS`."""
    told = [(number, event.mono_ns, event.kind, event.detail[:MAX_DETAIL]) for number, event in events]
    return bytes(msgpack.packb((VERSION, _numbers_of(truth), told)))


def read_truth(datagram: bytes) -> tuple[GroundTruth, list[Numbered]] | None:
    """Read what `write_truth` wrote; None for anything else."""
    if len(datagram) > MAX_BYTES:
        return None
    try:
        told = msgpack.unpackb(datagram, use_list=False)
    except Exception:
        return None
    if not (type(told) is tuple and len(told) == 3 and type(told[0]) is int and told[0] == VERSION):
        return None
    _, numbers, events = told
    if not (_is_truth(numbers) and type(events) is tuple and len(events) <= MAX_EVENTS and all(map(_is_event, events))):
        return None
    return GroundTruth(*numbers), [(number, VehicleEvent(*event)) for number, *event in events]


def _is_time(value: Any) -> bool:
    return type(value) is int and 0 <= value < LATEST


def _is_truth(numbers: Any) -> bool:
    return (
        type(numbers) is tuple
        and len(numbers) == len(_NAMES)
        and _is_time(numbers[0])
        and all(type(number) is float and math.isfinite(number) for number in numbers[1:])
    )


def _is_event(event: Any) -> bool:
    return (
        type(event) is tuple
        and len(event) == 4
        and _is_time(event[0])
        and _is_time(event[1])
        and type(event[2]) is str
        and event[2] in KINDS
        and type(event[3]) is str
        and len(event[3]) <= MAX_DETAIL
    )


class TruthSender:
    """Numbers events and says each in `REPEATS` datagrams.

    The first number is the time of the start: those of a car that was started again are greater than any before.
    """

    def __init__(self, start_ns: int) -> None:
        self._number = start_ns
        self._waiting: deque[tuple[int, Numbered]] = deque()
        """How often each event is still to be said."""

    def datagram(self, truth: GroundTruth, happened: Sequence[VehicleEvent]) -> bytes:
        """Make the next datagram; `happened` are the events since the last one."""
        for event in happened:
            self._number += 1
            self._waiting.append((REPEATS, (self._number, event)))
        said = [self._waiting.popleft() for _ in range(min(MAX_EVENTS, len(self._waiting)))]
        self._waiting.extendleft((left - 1, event) for left, event in reversed(said) if left > 1)
        return write_truth(truth, [event for _, event in said])


class TruthReceiver:
    """Takes datagrams from the network: anything may come, and whatever is not the truth is counted and dropped."""

    def __init__(self) -> None:
        self.newest: GroundTruth | None = None
        self.counts: Counter[str] = Counter()
        """`truths`, `garbage`, and `old`: older than the newest."""
        self._number = -1

    def take(self, datagram: bytes) -> list[VehicleEvent]:
        """Take a datagram: what is new of the truth is in `newest`; gives events that were not taken before."""
        told = read_truth(datagram)
        if told is None:
            self.counts["garbage"] += 1
            return []
        truth, events = told
        if self.newest is not None and truth.mono_ns < self.newest.mono_ns:
            self.counts["old"] += 1
        else:
            self.counts["truths"] += 1
            self.newest = truth
        new = [(number, event) for number, event in events if number > self._number]
        self._number = max([self._number, *(number for number, _ in new)])
        return [event for _, event in new]
