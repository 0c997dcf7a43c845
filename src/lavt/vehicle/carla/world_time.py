"""The time of an asynchronous CARLA world on the server's monotonic clock.

Such a world says how much time has elapsed in it, and its states arrive some time later. The earliest of them have
waited the least, so the smallest difference between arrival and elapsed time is taken for all: a state's time is then
late by the shortest way from the world to this process.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S

WINDOW_NS: Final = NS_PER_S
"""The smallest difference of this last time counts, so that a world that lost time is followed."""
DRIFT_NS: Final = 10 * NS_PER_MS
"""A change of the difference by this much is reported."""


class WorldTime:
    """Converts elapsed times of a world to times of the server's monotonic clock."""

    def __init__(self) -> None:
        self._differences: deque[tuple[int, int]] = deque()
        """Arrivals with their differences, which increase: the first one is the smallest of the window."""
        self._reported_ns: int | None = None

    def state_ns(self, elapsed_ns: int, arrived_ns: int) -> int:
        """Return the time of a state, at most its arrival; states must arrive in order."""
        difference_ns = arrived_ns - elapsed_ns
        while self._differences and self._differences[-1][1] >= difference_ns:
            self._differences.pop()
        self._differences.append((arrived_ns, difference_ns))
        while self._differences[0][0] < arrived_ns - WINDOW_NS:
            self._differences.popleft()
        return elapsed_ns + self._differences[0][1]

    def take_drift_ns(self) -> int:
        """Return by how much the world and the clock have moved apart since the last report; 0 below `DRIFT_NS`."""
        smallest_ns = self._differences[0][1]
        if self._reported_ns is None:
            self._reported_ns = smallest_ns
        drift_ns = abs(smallest_ns - self._reported_ns)
        if drift_ns < DRIFT_NS:
            return 0
        self._reported_ns = smallest_ns
        return drift_ns
