"""The check of the stamps of a foreign sender, whose RTP timestamps have a base of their own (RFC 3550, section 5.1).

Ours puts the stamp itself into the RTP timestamp, and `stamp_agrees` compares the two to 12 us. A foreign sender's
timestamps count from anywhere, and say when its picture was taken, some milliseconds before it was stamped. What can be
checked is that the stamps go on as the timestamps do: both lie on one line, which is learned from the first of them.
"""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S

TOLERANCE_NS: Final = 5 * NS_PER_MS
"""How far a stamp may lie from the line: more than a sender's way from camera to stamp varies, and less than the time
between two pictures at up to 200 Hz, so that the stamp of the picture before is none."""
LEARNED_AFTER: Final = 5
"""Stamps that must agree with each other before any is accepted."""
PATIENCE_NS: Final = 12 * NS_PER_S
"""How long stamps must agree with each other, and none with the line, until the line is given up though the timestamps
go on. Where one lost packet has left an old cell in the high bits, all stamps are wrong by the same until the next
keyframe: 8.3 s at x264's default of 250 frames and 30 Hz."""
JUMP_NS: Final = 60 * NS_PER_S
"""Timestamps that went back, or on by more, are those of a sender that started again: no patience is needed."""

_FOLLOWED: Final = 16
"""The line is the mean of so many stamps: at 30 Hz a clock that drifts by 100 ppm is followed with a lag of 53 us."""


class LearnedBase:
    """Tells whether stamps go on as their RTP timestamps do; learns the base from the stamps themselves.

    Nothing is accepted until `LEARNED_AFTER` stamps agree. When the sender starts again, or steps its clock, the base
    is learned anew. An accepted stamp may be wrong by twice `TOLERANCE_NS`; one of 64 random bits is accepted with a
    chance of 5e-13 (10 ms in 2^64 ns). What a decoder makes up is not random: give it only stamps of pictures that are
    not in doubt, read by `read_clear_stamp`. Others have been seen to agree with each other on a base wrong by 1 s.
    """

    def __init__(self) -> None:
        self._line: _Line | None = None
        self._rival: _Line | None = None
        self._votes = 0

    def agrees(self, stamp_ns: int, rtp_timestamp_of_frame: int) -> bool:
        """Tell whether a stamp is newer than the last accepted one and as far from it as its RTP timestamp says."""
        if self._line is not None and self._line.takes(stamp_ns, rtp_timestamp_of_frame):
            self._rival = None
            return True
        if self._rival is not None and self._rival.takes(stamp_ns, rtp_timestamp_of_frame):
            self._votes += 1
        elif self._rival is not None and self._votes > 1:
            self._votes -= 1
            return False
        else:
            self._rival, self._votes = _Line(stamp_ns, rtp_timestamp_of_frame), 1
        if self._votes < LEARNED_AFTER or (self._line is not None and not self._rival.may_replace(self._line)):
            return False
        self._line, self._rival = self._rival, None
        return True


class _Line:
    """Stamps against RTP timestamps; where it lies is the mean of the stamps it took, the newest weighing most."""

    def __init__(self, stamp_ns: int, timestamp: int) -> None:
        self.first_ns = self.newest_ns = stamp_ns
        self.first_timestamp = self.newest_timestamp = timestamp
        self._at_ns = stamp_ns
        self._taken = 1

    def takes(self, stamp_ns: int, timestamp: int) -> bool:
        """Tell whether a stamp is on the line and newer than the newest; if so the line goes on from there."""
        expected_ns = self._at_ns + _ns_between(self.newest_timestamp, timestamp)
        off_ns = stamp_ns - expected_ns
        if abs(off_ns) > TOLERANCE_NS or stamp_ns <= self.newest_ns:
            return False
        self._taken += 1
        self._at_ns = expected_ns + off_ns // min(self._taken, _FOLLOWED)
        self.newest_ns, self.newest_timestamp = stamp_ns, timestamp
        return True

    def may_replace(self, other: _Line) -> bool:
        """Tell whether this line, which began after another one, may take its place."""
        goes_on = 0 <= _ns_between(other.newest_timestamp, self.first_timestamp) <= JUMP_NS
        return not goes_on or self.newest_ns - self.first_ns >= PATIENCE_NS


def _ns_between(earlier: int, later: int) -> int:
    """Time from one RTP timestamp to another, across the wrap, negative when the second is the older one."""
    ticks = (later - earlier + 2**31) % 2**32 - 2**31
    return ticks * 100_000 // 9
