import math

import numpy as np
import pytest

from lavt.domain import CameraModel
from lavt.errors import UserError
from lavt.perception.bird_eye import STAMP_SIDE_PX, GroundGrid, make_bird_eye
from lavt.perception.calibration import calibrated_pinhole_camera, ground_to_picture

FOCAL_PX, CAMERA_AHEAD_M, CAMERA_HEIGHT_M = 320, 1.6, 1.4
"""Focal length of `CameraModel()`, and its position: ahead of the rear axle, above the ground."""


def pixel_of(model: CameraModel, x_m: float, y_m: float) -> tuple[float, float]:
    u, v, depth = ground_to_picture(calibrated_pinhole_camera(model)) @ np.array([x_m, y_m, 1.0])
    return u / depth, v / depth


def test_a_point_straight_ahead_is_in_the_middle_column() -> None:
    """A point on the vehicle's axis is in the middle column, and a farther point is higher up."""
    model = CameraModel()
    near, far = pixel_of(model, 5.0, 0.0), pixel_of(model, 20.0, 0.0)
    assert near[0] == pytest.approx((model.width_px - 1) / 2)
    assert far[0] == pytest.approx((model.width_px - 1) / 2)
    assert near[1] == pytest.approx((model.height_px - 1) / 2 + FOCAL_PX * CAMERA_HEIGHT_M / (5.0 - CAMERA_AHEAD_M))
    assert far[1] < near[1]


def test_a_point_on_the_left_is_left_of_the_middle() -> None:
    """A point left of the axis is left of the middle column by focal length x offset / depth."""
    model, depth_m, left_m = CameraModel(), 10.0, 2.0
    column, _ = pixel_of(model, CAMERA_AHEAD_M + depth_m, left_m)
    assert column == pytest.approx((model.width_px - 1) / 2 - FOCAL_PX * left_m / depth_m)


def test_a_point_at_the_pitch_angle_is_in_the_middle_row() -> None:
    """A camera pitched down by the angle of a ground point has that point in the middle row."""
    model = CameraModel(pitch_rad=math.atan2(CAMERA_HEIGHT_M, 10.0))
    _, row = pixel_of(model, CAMERA_AHEAD_M + 10.0, 0.0)
    assert row == pytest.approx((model.height_px - 1) / 2)


def test_a_ground_point_maps_to_its_cell() -> None:
    """A spot in the picture at a ground point's projection appears in the grid cell of that point."""
    model, grid = CameraModel(), GroundGrid()
    mapping = make_bird_eye(calibrated_pinhole_camera(model), grid)
    picture = np.zeros((model.height_px, model.width_px), dtype=np.uint8)
    u, v = pixel_of(model, 8.0, -1.5)
    picture[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2] = 255
    rows, columns = np.nonzero(mapping.view_from_above(mapping.region(picture)))
    assert np.mean(grid.row_x_m()[rows]) == pytest.approx(8.0, abs=0.1)
    assert np.mean(grid.column_y_m()[columns]) == pytest.approx(-1.5, abs=0.03)


@pytest.mark.parametrize(
    "model", [CameraModel(), CameraModel(320, 240), CameraModel(1280, 720), CameraModel(pitch_rad=0.5)]
)
def test_the_stamp_is_masked(model: CameraModel) -> None:
    """A picture that is white only in the stamp has an empty bird's-eye view."""
    mapping = make_bird_eye(calibrated_pinhole_camera(model), GroundGrid())
    picture = np.zeros((model.height_px, model.width_px), dtype=np.uint8)
    picture[:STAMP_SIDE_PX, :STAMP_SIDE_PX] = 255
    assert not mapping.view_from_above(mapping.region(picture)).any()


def test_without_a_stamp_its_corner_is_used() -> None:
    """If pictures have no stamp, the bird's-eye view includes the road in the stamp's corner."""
    camera = calibrated_pinhole_camera(CameraModel(field_of_view_rad=0.7, pitch_rad=0.3))
    white = np.full((480, 640), 255, dtype=np.uint8)
    with_stamp, without_stamp = (make_bird_eye(camera, GroundGrid(), stamped=has_stamp) for has_stamp in (True, False))
    assert np.count_nonzero(with_stamp.view_from_above(with_stamp.region(white))) < np.count_nonzero(
        without_stamp.view_from_above(without_stamp.region(white))
    )


@pytest.mark.parametrize(
    "model", [CameraModel(pitch_rad=-0.8), CameraModel(pitch_rad=1.4), CameraModel(64, 64), CameraModel(x_m=25.0)]
)
def test_a_camera_that_does_not_see_the_road_is_rejected(model: CameraModel) -> None:
    """A camera that does not see the road is rejected with a `UserError`."""
    with pytest.raises(UserError, match="does not see the road"):
        make_bird_eye(calibrated_pinhole_camera(model), GroundGrid())
