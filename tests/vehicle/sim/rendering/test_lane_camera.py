from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from lavt.domain import CameraModel, Lane, Pose
from lavt.vehicle.sim.rendering.lane_camera import LaneCamera, LaneNoise
from lavt.vehicle.sim.road.road import Road, load_road, parse_road

ROAD = load_road("a_key")
S_M = 5.0


def camera(*, model: CameraModel = CameraModel(), road: Road = ROAD, **keys: Any) -> LaneCamera:  # noqa: B008 (frozen)
    return LaneCamera(
        model=model, rate_hz=30.0, phase_ns=0, road=road, near_m=3.6, far_m=20.0, half_width_m=7.0, **keys
    )


def pose_at(s_m: float, lateral_m: float = 0.0, turned_rad: float = 0.0, *, at_ns: int = 0, road: Road = ROAD) -> Pose:
    x_m, y_m = road.point_at(s_m, lateral_m).tolist()
    return Pose(at_ns, x_m, y_m, float(road.centre_at(s_m).heading_rad) + turned_rad)


def y_at(lane: Lane, x_m: float) -> float:
    c0, c1, c2 = lane.centre
    return c0 + (c1 + c2 * x_m) * x_m


@pytest.mark.parametrize("turned_rad", [0.0, 0.1, -0.1])
@pytest.mark.parametrize("lateral_m", [0.0, 0.5, -1.0])
def test_the_lane_follows_the_road(lateral_m: float, turned_rad: float) -> None:
    """The fitted centre is within 2 cm of the true centre on a straight, and within 15 cm elsewhere.

    Where a straight changes to a radius of 42 m, no parabola fits better than 15 cm, not even a parabola from pixels.
    """
    lane_camera = camera()
    for s_m in range(0, int(ROAD.route_length_m) - 25, 3):
        pose = pose_at(s_m, lateral_m, turned_rad)
        lane = lane_camera.observe_lane(pose)
        assert lane.confidence > 0.8
        for ahead_m in (6.0, 10.0, 14.0):
            truth_x, truth_y = ROAD.point_at(s_m + ahead_m, 0.0).tolist()
            dx, dy = truth_x - pose.x_m, truth_y - pose.y_m
            x_m = dx * math.cos(pose.heading_rad) + dy * math.sin(pose.heading_rad)
            y_m = dy * math.cos(pose.heading_rad) - dx * math.sin(pose.heading_rad)
            straight = not ROAD.centre_at(np.arange(s_m, s_m + 22.0)).curvature_per_m.any()
            assert abs(y_at(lane, x_m) - y_m) < (0.02 if straight else 0.15)


def test_confidence_is_the_visible_share_of_the_lane() -> None:
    """The confidence falls from 1 in the lane to 0 more than 7 m beside the lane, or if the car is turned away."""
    beside = [camera().observe_lane(pose_at(S_M, lateral_m)).confidence for lateral_m in (0.0, 2.0, 4.0, 6.0, 10.0)]
    turned = [camera().observe_lane(pose_at(S_M, 0.0, math.radians(deg))).confidence for deg in (0, 20, 40, 90, 180)]
    for confidences in (beside, turned):
        assert confidences[0] > 0.95
        assert confidences == sorted(confidences, reverse=True)
        assert confidences[-1] == 0.0
    _, _, _, at_6_m, _ = beside
    assert 0.3 < at_6_m < 0.5, "from 6 m beside the centre, one line is visible and the other is beyond 7 m"


@pytest.mark.parametrize(
    ("yaw_deg", "y_m", "confidence"),
    [
        (0.0, 0.0, 1.0),
        (20.0, 0.0, 0.9),
        (-20.0, 0.0, 0.9),
        (46.0, 0.0, 0.5),
        (120.0, 0.0, 0.0),
        (180.0, 0.0, 0.0),
        (0.0, 5.0, 0.8),
    ],
)
def test_a_camera_turned_aside_has_less_confidence(yaw_deg: float, y_m: float, confidence: float) -> None:
    """A camera turned by 46 degrees sees half of the lane's lines; a camera turned backwards sees no line."""
    model = CameraModel(yaw_rad=math.radians(yaw_deg), y_m=y_m)
    lane = camera(model=model).observe_lane(pose_at(S_M))
    assert lane.confidence == pytest.approx(confidence, abs=0.1)


def test_there_is_no_picture_without_a_pose() -> None:
    """There is no picture before the first pose."""
    assert camera().capture(0, 0, None) is None
    assert camera().capture_after_exposure(0, 0, []) is None


def test_an_exposed_lane_is_that_of_the_middle_of_the_exposure() -> None:
    """With an exposure, the lane and the capture time are those of the middle of the exposure."""
    poses = [pose_at(S_M, at_ns=0), pose_at(S_M, 0.4, at_ns=10_000_000), pose_at(S_M, 9.0, at_ns=20_000_000)]
    frame = camera(exposure_ns=10_000_000).capture_after_exposure(3, 0, poses)
    expected = camera().capture(3, 5_000_000, pose_at(S_M, 0.2))
    assert frame is not None
    assert expected is not None
    assert (frame.number, frame.capture_ns) == (3, 5_000_000)
    assert frame.picture.lane.centre == pytest.approx(expected.picture.lane.centre)


def test_the_width_of_the_lane_is_that_at_the_car() -> None:
    """On a lane that narrows, the camera reports the width at the car's station."""
    text = "title: x\nsegments: [{length_m: 100}]\nlanes: {changes: [{from_m: 20, to_m: 60, widths_m: [2.5]}]}"
    road = parse_road(text, source="x")
    lane_camera = camera(road=road)
    widths_m = [lane_camera.observe_lane(pose_at(s_m, road=road)).width_m for s_m in range(10, 71, 10)]
    assert widths_m == pytest.approx([3.5, 3.5, 3.25, 3.0, 2.75, 2.5, 2.5])


def test_the_noise_of_a_lane_depends_on_seed_and_frame_only() -> None:
    """Position and direction of a lane have noise of the given deviations, which is equal for equal frame numbers."""
    exact = camera().observe_lane(pose_at(S_M)).centre
    noise = LaneNoise(3, 0.1, 0.01)
    noisy = camera(noise=noise)
    frames = [noisy.capture(number, 0, pose_at(S_M)) for number in (*range(400), 7)]
    errors = np.array([frame.picture.lane.centre for frame in frames if frame]) - exact
    assert errors[7].tolist() == errors[-1].tolist()
    np.testing.assert_allclose(errors[:400].std(axis=0), [0.1, 0.01, 0.0], rtol=0.15)
    np.testing.assert_allclose(errors[:400].mean(axis=0), 0.0, atol=0.02)
