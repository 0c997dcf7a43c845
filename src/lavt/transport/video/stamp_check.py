"""Check of the stamps of a foreign sender, whose RTP timestamps have an arbitrary base (RFC 3550, section 5.1).

LAVT's sender uses the stamp as the RTP timestamp, and `stamp_agrees` compares both with a tolerance of 12 us. A foreign
sender's timestamps start anywhere and give the time of capture, some milliseconds before the stamp. So the check is
that stamps advance as much as the timestamps: plotted over the timestamps, the stamps lie on one line, which is learned
from the first stamps.
"""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S

TOLERANCE_NS: Final = 5 * NS_PER_MS
"""Largest distance of a stamp from the line. It is more than the variation of a sender's delay from capture to stamp.
At up to 200 Hz it is not more than the frame interval, so that the stamp of the previous picture is rejected."""
LEARNED_AFTER: Final = 5
"""Number of stamps that must agree with each other before the first is accepted."""
RELEARN_AFTER_NS: Final = 12 * NS_PER_S
"""If the timestamps continue without a jump, a new line replaces the old one only if the stamps have agreed with the
new line, and none with the old one, for this time. It is longer than a lost packet can have an effect: if a cell of an
older stamp stays in the high bits, all stamps are wrong by the same amount until the next keyframe, for up to 8.3 s at
x264's default of 250 frames and 30 Hz."""
JUMP_NS: Final = 60 * NS_PER_S
"""If timestamps went back, or forward by more than this, the sender has restarted: the line is replaced as
soon as `LEARNED_AFTER` stamps agree with each other."""

_AVERAGED_STAMPS: Final = 16
"""The line is the mean of this many stamps: at 30 Hz it follows a clock that drifts by 100 ppm with a lag of 53 us."""


class LearnedBase:
    """A check that stamps advance as their RTP timestamps do; it learns the base from the stamps themselves.

    No stamp is accepted until `LEARNED_AFTER` stamps agree. When the sender restarts or steps its clock, the base is
    learned again. An accepted stamp can be wrong by twice `TOLERANCE_NS`. A stamp of 64 random bits is accepted with a
    probability of 5e-13 (10 ms in 2^64 ns). But concealed pixels are not random: stamps of pictures in doubt have been
    observed to agree with each other on a base that was wrong by 1 s. So pass only stamps of pictures that are not in
    doubt, read by `read_clear_stamp`.
    """

    def __init__(self) -> None:
        self._line: _StampLine | None = None
        self._candidate: _StampLine | None = None
        self._votes = 0

    def agrees(self, stamp_ns: int, rtp_timestamp_of_frame: int) -> bool:
        """Return whether a stamp is newer than the last accepted stamp, by as much as its RTP timestamp is newer."""
        if self._line is not None and self._line.accept(stamp_ns, rtp_timestamp_of_frame):
            self._candidate = None
            return True
        if self._candidate is not None and self._candidate.accept(stamp_ns, rtp_timestamp_of_frame):
            self._votes += 1
        elif self._candidate is not None and self._votes > 1:
            self._votes -= 1
            return False
        else:
            self._candidate, self._votes = _StampLine(stamp_ns, rtp_timestamp_of_frame), 1
        if self._votes < LEARNED_AFTER or (self._line is not None and not self._candidate.can_replace(self._line)):
            return False
        self._line, self._candidate = self._candidate, None
        return True


class _StampLine:
    """A line of stamps over RTP timestamps, at the mean of its stamps; the newest stamp has the largest weight."""

    def __init__(self, stamp_ns: int, timestamp: int) -> None:
        self.first_ns = self.newest_ns = stamp_ns
        self.first_timestamp = self.newest_timestamp = timestamp
        self._mean_ns = stamp_ns
        self._accepted = 1

    def accept(self, stamp_ns: int, timestamp: int) -> bool:
        """Extend the line by a stamp that lies on it and is newer than its newest stamp; return whether this is so."""
        expected_ns = self._mean_ns + _ns_between(self.newest_timestamp, timestamp)
        error_ns = stamp_ns - expected_ns
        if abs(error_ns) > TOLERANCE_NS or stamp_ns <= self.newest_ns:
            return False
        self._accepted += 1
        self._mean_ns = expected_ns + error_ns // min(self._accepted, _AVERAGED_STAMPS)
        self.newest_ns, self.newest_timestamp = stamp_ns, timestamp
        return True

    def can_replace(self, other: _StampLine) -> bool:
        """Return whether this line can replace the line `other`, which began earlier."""
        continues = 0 <= _ns_between(other.newest_timestamp, self.first_timestamp) <= JUMP_NS
        return not continues or self.newest_ns - self.first_ns >= RELEARN_AFTER_NS


def _ns_between(earlier: int, later: int) -> int:
    """Return the time from one RTP timestamp to another, across the wrap; negative if the second is older."""
    ticks = (later - earlier + 2**31) % 2**32 - 2**31
    return ticks * 100_000 // 9
