"""How long a packet that came after a gap waits for those before it: as long as the network has lately needed."""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S

MIN_HOLD_NS: Final = 10 * NS_PER_MS
"""Of a network that keeps packets in order: what is missing there is lost, and waiting for it is delay."""
MAX_HOLD_NS: Final = 300 * NS_PER_MS
"""A picture that comes later than this by itself is of no use: keyframes are asked for instead."""
WINDOW_NS: Final = 30 * NS_PER_S


class AdaptiveHold:
    """A quarter longer than any packet of the last 30 to 60 s was overtaken by; within `LEAST_` and `MAX_HOLD_NS`.

    Packets that were overtaken by more than `MAX_HOLD_NS` count for nothing.
    """

    def __init__(self) -> None:
        self._longest_ns = self._longest_before_ns = 0
        self._began_ns: int | None = None

    def at(self, now_ns: int) -> int:
        """Give the hold of a gap that is noticed at `now_ns`."""
        self._begin_window(now_ns)
        longest_ns = max(self._longest_ns, self._longest_before_ns)
        return min(max(MIN_HOLD_NS, longest_ns * 5 // 4), MAX_HOLD_NS)

    def note(self, reordered_ns: int, now_ns: int) -> None:
        """A packet came so long after the first sign that it was missing, or was made again then."""
        self._begin_window(now_ns)
        if reordered_ns <= MAX_HOLD_NS:
            self._longest_ns = max(self._longest_ns, reordered_ns)

    def _begin_window(self, now_ns: int) -> None:
        if self._began_ns is None:
            self._began_ns = now_ns
        windows = (now_ns - self._began_ns) // WINDOW_NS
        if windows > 0:
            self._longest_ns, self._longest_before_ns = 0, self._longest_ns if windows == 1 else 0
            self._began_ns += windows * WINDOW_NS
