"""What to do when no lane is seen: nothing at first, then brake, then stop."""

from __future__ import annotations

from typing import Literal

from lavt.control.driver_limits import CLIENT_LIMITS

LaneState = Literal["ok", "brake", "stop"]

LANE_CONFIDENCE = 0.2
"""With less there is no lane: one line over 40 % of the length; a broken line alone gives twice that."""
BRAKE_AFTER_NS = CLIENT_LIMITS.no_lane_brake_ns
STOP_AFTER_NS = CLIENT_LIMITS.no_lane_stop_ns


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
        frame_age_ns = now_ns - self._seen_ns
        if frame_age_ns >= STOP_AFTER_NS:
            return "stop"
        return "brake" if frame_age_ns >= BRAKE_AFTER_NS else "ok"
