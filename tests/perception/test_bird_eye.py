import math

import numpy as np
import pytest

from lavt.domain import CameraModel
from lavt.errors import UserError
from lavt.perception.bird_eye import STAMP_SIDE_PX, GroundGrid, bird_eye
from lavt.perception.calibration import calibrated, ground_to_picture


def seen_at(model: CameraModel, x_m: float, y_m: float) -> tuple[float, float]:
    u, v, depth = ground_to_picture(calibrated(model)) @ np.array([x_m, y_m, 1.0])
    return u / depth, v / depth


def test_a_point_straight_ahead_is_in_the_middle_column() -> None:
    """A point on the vehicle's axis is seen in the middle column, the higher up the farther it is."""
    model = CameraModel()
    near, far = seen_at(model, 5.0, 0.0), seen_at(model, 20.0, 0.0)
    assert near[0] == pytest.approx((model.width_px - 1) / 2)
    assert far[0] == pytest.approx((model.width_px - 1) / 2)
    assert near[1] == pytest.approx((model.height_px - 1) / 2 + 320 * 1.4 / (5.0 - 1.6))
    assert far[1] < near[1]


def test_left_is_left() -> None:
    """A point left of the axis is seen left of the middle, by focal length x offset / depth."""
    model = CameraModel()
    assert seen_at(model, 11.6, 2.0)[0] == pytest.approx((model.width_px - 1) / 2 - 320 * 2.0 / 10.0)


def test_pitch_down_lifts_the_road() -> None:
    """A camera pitched down by the angle of a ground point sees that point in the middle row."""
    pitch_rad = math.atan2(1.4, 10.0)
    assert seen_at(CameraModel(pitch_rad=pitch_rad), 11.6, 0.0)[1] == pytest.approx((480 - 1) / 2)


def test_a_painted_cell_lands_in_its_own_place() -> None:
    """A spot painted into the picture where a ground point is seen comes out in that point's cell."""
    model, grid = CameraModel(), GroundGrid()
    mapping = bird_eye(calibrated(model), grid)
    picture = np.zeros((model.height_px, model.width_px), dtype=np.uint8)
    u, v = seen_at(model, 8.0, -1.5)
    picture[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2] = 255
    rows, columns = np.nonzero(mapping.from_above(mapping.region(picture)))
    assert np.mean(grid.row_x_m()[rows]) == pytest.approx(8.0, abs=0.1)
    assert np.mean(grid.column_y_m()[columns]) == pytest.approx(-1.5, abs=0.03)


@pytest.mark.parametrize(
    "model", [CameraModel(), CameraModel(320, 240), CameraModel(1280, 720), CameraModel(pitch_rad=0.5)]
)
def test_the_stamp_is_never_looked_at(model: CameraModel) -> None:
    """Of a picture that is white where the stamp is and black elsewhere, nothing is seen from above."""
    mapping = bird_eye(calibrated(model), GroundGrid())
    picture = np.zeros((model.height_px, model.width_px), dtype=np.uint8)
    picture[:STAMP_SIDE_PX, :STAMP_SIDE_PX] = 255
    assert not mapping.from_above(mapping.region(picture)).any()


def test_without_a_stamp_its_corner_is_road_too() -> None:
    """A camera pitched down so far that it sees road in the corner looks there when there is no stamp."""
    camera = calibrated(CameraModel(field_of_view_rad=0.7, pitch_rad=0.3))
    white = np.full((480, 640), 255, dtype=np.uint8)
    stamped, plain = (bird_eye(camera, GroundGrid(), stamped=each) for each in (True, False))
    assert np.count_nonzero(stamped.from_above(stamped.region(white))) < np.count_nonzero(
        plain.from_above(plain.region(white))
    )


@pytest.mark.parametrize(
    "model", [CameraModel(pitch_rad=-0.8), CameraModel(pitch_rad=1.4), CameraModel(64, 64), CameraModel(x_m=25.0)]
)
def test_a_camera_that_does_not_see_the_road_is_rejected(model: CameraModel) -> None:
    """A camera that looks elsewhere is the user's mistake, told with what to correct."""
    with pytest.raises(UserError, match="correct its place"):
        bird_eye(calibrated(model), GroundGrid())
