"""The reaction to a lost lane: nothing at first, then brake, then stop."""

from __future__ import annotations

from typing import Literal

from lavt.control.client_limits import CLIENT_LIMITS

LaneState = Literal["ok", "brake", "stop"]

LANE_CONFIDENCE = 0.2
"""By default a lane with less confidence is treated as lost. One line that is visible over 40 % of the length gives
0.2; a broken line without the other line gives 0.4."""
BRAKE_AFTER_NS = CLIENT_LIMITS.no_lane_brake_ns
STOP_AFTER_NS = CLIENT_LIMITS.no_lane_stop_ns


class LaneWatch:
    """A timer of the time since the last confident lane detection."""

    def __init__(self, lane_confidence: float = LANE_CONFIDENCE) -> None:
        self._lane_confidence = lane_confidence
        self._last_lane_ns: int | None = None

    def check(self, confidence: float, now_ns: int) -> LaneState:
        """Return the reaction to the confidence of the newest picture's lane, at `now_ns` (monotonic).

        The time without a lane begins at the first call or the last confident lane. When a lane is detected again, the
        result is "ok"; the server decides when a stop ends.
        """
        if self._last_lane_ns is None or confidence >= self._lane_confidence:
            self._last_lane_ns = now_ns
        lane_age_ns = now_ns - self._last_lane_ns
        if lane_age_ns >= STOP_AFTER_NS:
            return "stop"
        return "brake" if lane_age_ns >= BRAKE_AFTER_NS else "ok"
