"""Delays: a `DelayModel` computes the delay of an item, and a `DelayLine` queues items until they are due.

The relay and the virtual runtime use both. A model draws the jitter of an item by the item's index from a named
random-number stream. So two runs with one seed get the same jitter, whatever else they draw. A line keeps the order of
its items, unless it has an `EmulatedLink` that reorders them.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from lavt.domain import NS_PER_MS
from lavt.streams import IndexedStream, QuantileStream
from lavt.transport.emulation.link import EmulatedLink


@dataclass(frozen=True, slots=True)
class Lognormal:
    """A lognormal delay: its median, and the standard deviation of its logarithm."""

    median_ms: float
    sigma: float


@dataclass(frozen=True, slots=True)
class DelayModel:
    """A constant delay plus optional jitter, drawn for each index from the random-number stream `name` of `seed`.

    `measured_ns` is a further random delay in nanoseconds, with the distribution of a measurement. An item draws it by
    its index divided by `indices_per_draw`.
    """

    constant_ms: float
    jitter: Lognormal | None = None
    seed: int = 0
    name: str = ""
    measured_ns: QuantileStream | None = None
    indices_per_draw: int = 1

    def median_ms(self) -> float:
        """Return the median delay without the measured part."""
        return max(0.0, self.constant_ms + (0.0 if self.jitter is None else self.jitter.median_ms))

    def delay_ns(self, index: int) -> int:
        """Return the delay of the item with this index in nanoseconds; it is never negative."""
        jitter_ms = 0.0 if self.jitter is None else _lognormal_ms(self.seed, self.name, index, self.jitter)
        delay_ns = max(0, round((self.constant_ms + jitter_ms) * NS_PER_MS))
        return delay_ns if self.measured_ns is None else delay_ns + self.measured_ns.at(index // self.indices_per_draw)


@lru_cache(maxsize=256)
def _lognormal_ms(seed: int, name: str, index: int, delay: Lognormal) -> float:
    """Draw a lognormal delay. It is cached because the packets of one frame share an index."""
    return delay.median_ms * float(_jitter_stream(seed, name).at(index).lognormal(0.0, delay.sigma))


@lru_cache(maxsize=4)
def _jitter_stream(seed: int, name: str) -> IndexedStream:
    return IndexedStream(seed, name)


class DelayLine:
    """A queue that delays items and keeps their order. Its `EmulatedLink` can also drop, reorder or pace items."""

    def __init__(self, delay: DelayModel, link: EmulatedLink | None = None) -> None:
        self.delay = delay
        self.link = link
        self._waiting: list[tuple[int, int, Any]] = []
        """A heap of due time, number and item; the number keeps the order of items that are due at the same time."""
        self._pushed = 0
        """How many items were pushed; the number of the last one."""
        self._last_due_ns = 0

    def push(self, item: Any, now_ns: int, index: int, size_bytes: int = 0) -> int | None:
        """Queue `item`, which arrived at `now_ns`, and return when it is due, or None if the link lost it.

        `index` selects the delay of the item, and `size_bytes` is its size for the rate of the link. Without a link an
        item is due after its delay, but not before any earlier item.
        """
        delay_ns = self.delay.delay_ns(index)
        if self.link is None:
            due_ns = self._last_due_ns = max(now_ns + delay_ns, self._last_due_ns)
        elif (departure_ns := self.link.departure_ns(now_ns, delay_ns, size_bytes)) is None:
            return None
        else:
            due_ns = departure_ns
        self._pushed += 1
        heapq.heappush(self._waiting, (due_ns, self._pushed, item))
        return due_ns

    def next_due_ns(self) -> int | None:
        """Return when the first item is due, or None when the queue is empty."""
        return self._waiting[0][0] if self._waiting else None

    def pop_due(self, now_ns: int) -> list[Any]:
        """Remove and return all items that are due at `now_ns`, in order."""
        due = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            due.append(heapq.heappop(self._waiting)[2])
        return due
