from __future__ import annotations

import pytest

from lavt.domain import Lane, SeenLane
from lavt.perception.lane_detector import FORGET_AFTER, SMOOTHING
from lavt.perception.lane_given import GivenLane


def lane_message(offset_m: float, confidence: float = 1.0) -> SeenLane:
    return SeenLane(1, 2, Lane((offset_m, 0.0, 0.0), 3.5, 3.6, 20.0, confidence))


def test_given_lanes_are_averaged_as_by_the_lane_detector() -> None:
    """The average starts with the first lane, and each newer lane has the weight `SMOOTHING`."""
    given = GivenLane()
    assert given.detect(lane_message(1.0)).centre[0] == 1.0
    assert given.detect(lane_message(2.0)).centre[0] == pytest.approx(1.0 + SMOOTHING)


def test_the_last_lane_is_kept_with_low_confidence() -> None:
    """A lane of low confidence changes only the confidence; after several, or `forget`, the average restarts."""
    given = GivenLane()
    given.detect(lane_message(1.0))
    lost = [given.detect(lane_message(5.0, confidence=0.1)) for _ in range(FORGET_AFTER)]
    assert [(lane.centre[0], lane.confidence) for lane in lost] == [(1.0, 0.1)] * FORGET_AFTER
    assert given.detect(lane_message(3.0)).centre[0] == 3.0
    given.forget()
    assert given.detect(lane_message(7.0)).centre[0] == 7.0
