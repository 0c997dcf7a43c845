"""The time of an asynchronous CARLA world on the server's monotonic clock.

Such a world says how much time has elapsed in it, and its states arrive some time later. The earliest of them have
waited the least, so the smallest difference between arrival and elapsed time is taken for all: a state's time is then
late by the shortest way from the world to this process.

If this way becomes longer, it looks as if the world had lost time. But a state also has the time of the clock of
CARLA's machine, which shows whether its way is longer than that of the earliest state of the last minute. A clock whose
rate differs from ours by less than 1e-4 differs by less than `LATE_NS` in this time.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S

WINDOW_NS: Final = NS_PER_S
"""The smallest difference of this last time counts, so that a world that lost time is followed."""
DRIFT_NS: Final = 10 * NS_PER_MS
"""A change of the difference by this much is reported."""
EARLIEST_WINDOW_NS: Final = 60 * NS_PER_S
LATE_NS: Final = 10 * NS_PER_MS
"""A state whose time is late by more than this is counted."""


class SmallestDifference:
    """The smallest difference between arrival and another time in a window of the last arrivals."""

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._differences: deque[tuple[int, int]] = deque()
        """Arrivals with their differences, which increase: the first one is the smallest of the window."""

    def note(self, time_ns: int, arrived_ns: int) -> int:
        """Add an arrival and return the smallest difference; arrivals must be in order."""
        difference_ns = arrived_ns - time_ns
        while self._differences and self._differences[-1][1] >= difference_ns:
            self._differences.pop()
        self._differences.append((arrived_ns, difference_ns))
        while self._differences[0][0] < arrived_ns - self._window_ns:
            self._differences.popleft()
        return self._differences[0][1]


class WorldTime:
    """Converts elapsed times of a world to times of the server's monotonic clock."""

    def __init__(self) -> None:
        self._elapsed = SmallestDifference(WINDOW_NS)
        self._platform = SmallestDifference(EARLIEST_WINDOW_NS)
        self._smallest_ns = 0
        self._reported_ns: int | None = None

    def state_ns(self, elapsed_ns: int, arrived_ns: int) -> int:
        """Return the time of a state, at most its arrival; states must arrive in order."""
        self._smallest_ns = self._elapsed.note(elapsed_ns, arrived_ns)
        return elapsed_ns + self._smallest_ns

    def is_late(self, state_ns: int, platform_ns: int, arrived_ns: int) -> bool:
        """Return whether the time of a state is late by more than `LATE_NS`, by the clock of CARLA's machine."""
        return state_ns - platform_ns - self._platform.note(platform_ns, arrived_ns) > LATE_NS

    def take_drift_ns(self) -> int:
        """Return by how much the world and the clock have moved apart since the last report; 0 below `DRIFT_NS`."""
        if self._reported_ns is None:
            self._reported_ns = self._smallest_ns
        drift_ns = abs(self._smallest_ns - self._reported_ns)
        if drift_ns < DRIFT_NS:
            return 0
        self._reported_ns = self._smallest_ns
        return drift_ns
