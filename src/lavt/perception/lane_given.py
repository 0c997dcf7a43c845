"""A detector that receives the lane itself instead of pixels, for fidelity `geometry`."""

from __future__ import annotations

from msgspec.structs import replace

from lavt.domain import Lane, SeenLane
from lavt.perception.lane_detector import FORGET_AFTER, GRID, LANE_WIDTH_M, TRACK_CONFIDENCE, average_lane


class GivenLane:
    """A detector that averages given lanes as `LaneDetector` does, so the control loop has the same dynamics.

    When little of the lane is visible, the confidence is low and the lane is the last one detected.
    """

    def __init__(self) -> None:
        self._lane = Lane((0.0, 0.0, 0.0), LANE_WIDTH_M, GRID.near_m, GRID.far_m, 0.0)
        self._misses = FORGET_AFTER

    def forget(self) -> None:
        """Restart the average with the next lane."""
        self._misses = FORGET_AFTER

    def detect(self, picture: SeenLane) -> Lane:
        """Return the average of the lanes in this picture and those before."""
        seen = picture.lane
        if seen.confidence < TRACK_CONFIDENCE:
            self._misses += 1
            self._lane = replace(self._lane, confidence=seen.confidence)
        else:
            self._lane = average_lane(self._lane if self._misses < FORGET_AFTER else None, seen)
            self._misses = 0
        return self._lane
