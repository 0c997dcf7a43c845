"""Adaptive hold of the jitter buffer: packets after a gap wait about as long as reordering has recently taken."""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S

MIN_HOLD_NS: Final = 10 * NS_PER_MS
"""The hold on a network that keeps packets in order. There a missing packet is lost, and waiting only adds delay."""
MAX_HOLD_NS: Final = 300 * NS_PER_MS
"""A frame that waits longer than this is too old to be useful: a keyframe is requested instead."""
WINDOW_NS: Final = 30 * NS_PER_S
"""The hold depends on the reordering delays of the current window and of the previous one."""


class AdaptiveHold:
    """A hold of 1.25 times the longest reordering delay of the last 30 to 60 s.

    It is at least `MIN_HOLD_NS` and at most `MAX_HOLD_NS`. Reordering delays longer than `MAX_HOLD_NS` are ignored.
    """

    def __init__(self) -> None:
        self._longest_ns = self._previous_longest_ns = 0
        self._began_ns: int | None = None

    def hold_ns(self, now_ns: int) -> int:
        """Return the hold for a gap that is detected at `now_ns`."""
        self._update_windows(now_ns)
        longest_ns = max(self._longest_ns, self._previous_longest_ns)
        return min(max(MIN_HOLD_NS, longest_ns * 5 // 4), MAX_HOLD_NS)

    def note_delay(self, reordered_ns: int, now_ns: int) -> None:
        """Note that a packet arrived, or was recovered, `reordered_ns` after it was found missing."""
        self._update_windows(now_ns)
        if reordered_ns <= MAX_HOLD_NS:
            self._longest_ns = max(self._longest_ns, reordered_ns)

    def _update_windows(self, now_ns: int) -> None:
        if self._began_ns is None:
            self._began_ns = now_ns
        windows = (now_ns - self._began_ns) // WINDOW_NS
        if windows > 0:
            self._longest_ns, self._previous_longest_ns = 0, self._longest_ns if windows == 1 else 0
            self._began_ns += windows * WINDOW_NS
