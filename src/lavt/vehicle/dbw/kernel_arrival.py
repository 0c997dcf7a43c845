"""Arrival times of frames on the monotonic clock, from the kernel's wall-clock timestamps."""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_MS, Now

TOLERANCE_NS: Final = NS_PER_MS
"""A time may be outside its limits by this: the two clocks are not read at the same instant, and NTP slews one."""


class ArrivalTimes:
    """A conversion of the timestamps of one receive queue, in order. After a step of the wall clock it is still right.

    A frame arrived after the queue was last found empty, not before the previous frame, and not after it was read. If
    the wall clock was stepped meanwhile, the timestamp is from before or from after the step, which gives two times.
    The one that satisfies these conditions is taken. If both do, the earlier one is taken, and if none does, the
    earliest possible time, so that no frame seems newer than it is.
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
        outside_ns, at_ns = min((max(earliest_ns - at_ns, at_ns - latest_ns, 0), at_ns) for at_ns in candidates)
        self._earliest_ns = earliest_ns if outside_ns > TOLERANCE_NS else min(max(at_ns, earliest_ns), latest_ns)
        return self._earliest_ns
