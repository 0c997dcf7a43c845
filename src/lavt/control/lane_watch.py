"""What to do when no lane is seen: nothing at first, then brake, then stop."""

from __future__ import annotations

from typing import Literal

from lavt.domain import NS_PER_MS

LaneState = Literal["ok", "brake", "stop"]

LANE_CONFIDENCE = 0.2
"""With less there is no lane: one line over 40 % of the length; a broken line alone gives twice that."""
BRAKE_AFTER_NS = 500 * NS_PER_MS
"""Without a lane: at 30 km/h 4 m have gone by, of the 16 m that were seen; a gap of broken marks is over."""
STOP_AFTER_NS = 2500 * NS_PER_MS
"""Without a lane: 2 s of braking have taken 6 m/s off 30 km/h, and the last path seen is nearly used up."""


class LaneWatch:
    """Knows since when no lane has been seen."""

    def __init__(self) -> None:
        self._seen_ns: int | None = None

    def check(self, confidence: float, now_ns: int) -> LaneState:
        """Take the confidence in the newest picture's lane, at `now_ns` (monotonic), and tell what to do.

        Time counts from the first call. A lane seen again makes all well; whether a stop holds is not decided here.
        """
        if self._seen_ns is None or confidence >= LANE_CONFIDENCE:
            self._seen_ns = now_ns
        blind_ns = now_ns - self._seen_ns
        if blind_ns >= STOP_AFTER_NS:
            return "stop"
        return "brake" if blind_ns >= BRAKE_AFTER_NS else "ok"
