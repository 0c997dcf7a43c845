"""A detector for lanes that come without pixels: step 9 of the life of a frame where nothing is rendered."""

from __future__ import annotations

from dataclasses import replace

from lavt.domain import Lane, SeenLane
from lavt.perception.lane_detector import FORGET_AFTER, GRID, LANE_WIDTH_M, TRACK_CONFIDENCE, average_lane


class GivenLane:
    """Averages lanes over pictures as `LaneDetector` does, so that the loop has the dynamics it has with pixels.

    With little of a lane in view the confidence says so, and the lane is the one seen last.
    """

    def __init__(self) -> None:
        self._lane = Lane((0.0, 0.0, 0.0), LANE_WIDTH_M, GRID.near_m, GRID.far_m, 0.0)
        self._misses = FORGET_AFTER

    def forget(self) -> None:
        """Take the next lane as the first one."""
        self._misses = FORGET_AFTER

    def detect(self, picture: SeenLane) -> Lane:
        """Give the average of the lane in the next picture and those before."""
        seen = picture.lane
        if seen.confidence < TRACK_CONFIDENCE:
            self._misses += 1
            self._lane = replace(self._lane, confidence=seen.confidence)
        else:
            self._lane = average_lane(self._lane if self._misses < FORGET_AFTER else None, seen)
            self._misses = 0
        return self._lane
