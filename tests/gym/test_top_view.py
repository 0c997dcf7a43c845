"""The view from above."""

from __future__ import annotations

import pytest

pytest.importorskip("gymnasium")

from lavt.domain import GroundTruth, Lane
from lavt.gym.top_view import CAR, CAR_PX, GRASS, PX_PER_M, ROAD, SEEN, SIZE_PX, draw_top_view
from lavt.nodes.payloads import Route

EAST = Route("east", 100.0, tuple((float(x_m), 0.0) for x_m in range(-10, 100)))
LANE = Lane(centre=(3.0, 0.0, 0.0), width_m=3.5, near_m=4.0, far_m=20.0, confidence=1.0)


def colour(truth: GroundTruth | None, ahead_m: float, left_m: float) -> tuple[int, ...]:
    picture = draw_top_view(EAST, truth, LANE)
    assert picture.shape == (SIZE_PX, SIZE_PX, 3)
    row, column = CAR_PX[1] - ahead_m * PX_PER_M, CAR_PX[0] - left_m * PX_PER_M
    return tuple(int(value) for value in picture[round(row), round(column)])


@pytest.mark.parametrize("cross_track_m", [0.0, 5.0])
def test_car_road_and_seen_lane_are_where_they_are(cross_track_m: float) -> None:
    """The car is at its place, the road at its true distance, and the seen lane where the client saw it."""
    truth = GroundTruth(0, 20.0, cross_track_m, 0.0, 5.0, 0.0, cross_track_m, 0.0, 20.0)
    assert colour(truth, 1.0, 0.0) == CAR
    assert colour(truth, 10.0, -cross_track_m) == ROAD
    assert colour(truth, 10.0, 3.0) == SEEN
    assert colour(truth, 10.0, -cross_track_m - 3.0) == GRASS


def test_without_ground_truth_there_is_no_road() -> None:
    """A vehicle without ground truth has no road in the view."""
    assert colour(None, 10.0, 0.0) == GRASS
