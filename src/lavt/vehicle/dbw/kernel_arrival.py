"""Arrival times of frames on the monotonic clock, from the kernel's wall-clock timestamps."""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_MS, Now

TOLERANCE_NS: Final = NS_PER_MS
"""An arrival time can seem to lie outside its limits by up to this time, because the monotonic and the wall clock are
not read at the same instant, and NTP slews the wall clock."""


class ArrivalTimes:
    """A converter of the timestamps of one receive queue, in order. It is right after a step of the wall clock, too.

    An arrival time has an earliest and a latest possible value. A frame arrived after the queue was last found empty,
    not before the previous frame, and not after it was read. If the wall clock was stepped after the queue was found
    empty, the timestamp was taken before or after the step. So there are two candidates for the arrival time. The
    candidate within the limits is returned; if both are, the earlier one. If neither is, the earliest possible time is
    returned, so that no frame seems newer than it is.
    """

    def __init__(self, now: Now) -> None:
        self.note_empty(now)

    def note_empty(self, now: Now) -> None:
        """Note that the queue was found empty after `now`."""
        self._earliest_ns, self._wall_ahead_ns = now.mono_ns, now.wall_ns - now.mono_ns

    def arrived_ns(self, timestamp_ns: int, now: Now) -> int:
        """Return when a frame arrived that has the wall-clock time `timestamp_ns` and was read just before `now`."""
        earliest_ns, latest_ns = self._earliest_ns, now.mono_ns
        candidates_ns = (timestamp_ns - self._wall_ahead_ns, timestamp_ns - (now.wall_ns - now.mono_ns))
        outside_ns, at_ns = min((max(earliest_ns - at_ns, at_ns - latest_ns, 0), at_ns) for at_ns in candidates_ns)
        self._earliest_ns = earliest_ns if outside_ns > TOLERANCE_NS else min(max(at_ns, earliest_ns), latest_ns)
        return self._earliest_ns
