"""Arrival times of frames on the monotonic clock, from the kernel's wall-clock timestamps."""

from __future__ import annotations

from lavt.domain import Now


class ArrivalTimes:
    """A conversion of the timestamps of one receive queue, in order. A step of the wall clock does not falsify it.

    A frame arrived after the queue was last found empty, not before the previous frame, and not after it was read. If
    the wall clock was stepped meanwhile, the timestamp is from before or from after the step, which gives two times.
    The one that satisfies these conditions is taken; if both do, the earlier one, so that no frame seems newer than it
    is.
    """

    def __init__(self, now: Now) -> None:
        self.note_empty(now)

    def note_empty(self, now: Now) -> None:
        """Note that the queue was found empty after `now`."""
        self._earliest_ns, self._wall_ahead_ns = now.mono_ns, now.wall_ns - now.mono_ns

    def arrived_ns(self, timestamp_ns: int, now: Now) -> int:
        """Return when a frame with the wall-clock time `timestamp_ns`, read just before `now`, arrived."""
        earliest_ns, latest_ns = self._earliest_ns, now.mono_ns
        candidates = (timestamp_ns - self._wall_ahead_ns, timestamp_ns - (now.wall_ns - now.mono_ns))
        nearest_ns = min(candidates, key=lambda at_ns: (max(earliest_ns - at_ns, at_ns - latest_ns, 0), at_ns))
        self._earliest_ns = min(max(nearest_ns, earliest_ns), latest_ns)
        return self._earliest_ns
