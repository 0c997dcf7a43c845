import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.perception.lens import ground_points

from lavt.perception.bird_eye import GroundGrid, bird_eye
from lavt.perception.calibration import CalibratedCamera, axes, picture_points

COMMON_LENS = st.tuples(
    st.floats(-0.35, 0.2), st.floats(-0.05, 0.1), st.floats(-0.002, 0.002), st.floats(-0.002, 0.002), st.just(0.0)
)
FISHEYE_LENS = st.tuples(st.floats(-0.1, 0.1), st.floats(-0.03, 0.03), st.floats(-0.01, 0.01), st.just(0.0))


@st.composite
def cameras(draw: st.DrawFn) -> CalibratedCamera:
    """Draw a camera with a common mounting and lens."""
    fisheye = draw(st.booleans())
    focal_px = draw(st.floats(250, 600))
    return CalibratedCamera(
        width_px=640,
        height_px=480,
        focal_px=(focal_px, focal_px * draw(st.floats(0.97, 1.03))),
        middle_px=(draw(st.floats(300, 340)), draw(st.floats(220, 260))),
        x_m=draw(st.floats(-0.5, 2.0)),
        y_m=draw(st.floats(-0.8, 0.8)),
        z_m=draw(st.floats(1.0, 2.5)),
        yaw_rad=draw(st.floats(-0.15, 0.15)),
        pitch_rad=draw(st.floats(-0.03, 0.3)),
        roll_rad=draw(st.floats(-0.1, 0.1)),
        distortion=draw(FISHEYE_LENS if fisheye else st.one_of(st.just(()), COMMON_LENS)),
        fisheye=fisheye,
    )


GROUND_POINTS = np.array([[x, y] for x in (4.0, 6.0, 9.0, 13.0, 19.0) for y in (-5.0, -1.75, 0.0, 1.75, 5.0)])


def are_inside(camera: CalibratedCamera, pixels: np.ndarray) -> np.ndarray:
    """Return, for each pixel, whether the spot that a test draws around this pixel is inside the picture."""
    with np.errstate(invalid="ignore"):
        inside = (pixels > 17) & (pixels < (camera.width_px - 18, camera.height_px - 18))
    return np.asarray(inside.all(axis=1))


AT_THE_FOLD = CalibratedCamera(
    640, 480, (250.0, 250.0), (300.0, 220.0), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, distortion=(-0.21875, 0.0, 0.0, 0.0, 0.0)
)
"""A lens whose distortion folds back just before one of the ground points."""


@settings(max_examples=60, derandomize=True)
@example(AT_THE_FOLD)
@given(cameras())
def test_projection_and_inverse_projection_agree(camera: CalibratedCamera) -> None:
    """A ground point that is projected through any lens and back moves by less than 1 cm."""
    pixels = picture_points(camera, GROUND_POINTS)
    visible = are_inside(camera, pixels)
    assert np.abs(ground_points(camera, pixels[visible]) - GROUND_POINTS[visible]).max(initial=0.0) < 0.01


@settings(max_examples=20, derandomize=True)
@given(cameras())
def test_a_ground_point_maps_to_its_cell_through_any_lens(camera: CalibratedCamera) -> None:
    """A spot in the distorted picture at a ground point's projection appears in the grid cell of that point."""
    grid = GroundGrid()
    mapping = bird_eye(camera, grid, stamped=False)
    pixels = picture_points(camera, GROUND_POINTS)
    visible = are_inside(camera, pixels)
    for (x_m, y_m), (u, v) in zip(GROUND_POINTS[visible], pixels[visible], strict=True):
        picture = np.zeros((camera.height_px, camera.width_px), dtype=np.uint8)
        half_width_px = round(60 / x_m)  # about 0.2 m: wider than a cell
        picture[round(v) - 1 : round(v) + 2, round(u) - half_width_px : round(u) + half_width_px + 1] = 255
        # The size of the spot on the ground limits the accuracy of its position.
        ends = np.array([[u, v + 2], [u - half_width_px, v]])
        (near_x_m, near_y_m), (left_x_m, left_y_m) = ground_points(camera, ends)
        rows, columns = np.nonzero(mapping.from_above(mapping.region(picture)))
        if len(rows) == 0:
            # The spot's three rows of pixels can lie between two rows of cells.
            assert abs(x_m - near_x_m) < 0.2 or x_m > 12
            continue
        off_x_m, off_y_m = grid.row_x_m()[rows].mean() - x_m, grid.column_y_m()[columns].mean() - y_m
        assert abs(off_x_m) < 0.1 + abs(x_m - near_x_m) + abs(x_m - left_x_m)
        assert abs(off_y_m) < 0.05 + abs(y_m - left_y_m) + abs(y_m - near_y_m)


def test_yaw_pitch_and_roll_have_their_signs() -> None:
    """Positive yaw turns left, positive pitch turns down, and positive roll lowers the right side."""
    level = CalibratedCamera(640, 480, (320.0, 320.0), (319.5, 239.5), 0.0, 0.0, 1.4, 0.0, 0.0, 0.0)

    def turned(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
        return axes(CalibratedCamera(640, 480, (320.0, 320.0), (319.5, 239.5), 0.0, 0.0, 1.4, yaw, pitch, roll))

    right, down, forward = axes(level)
    assert (right.tolist(), down.tolist(), forward.tolist()) == ([0, -1, 0], [0, 0, -1], [1, 0, 0])
    assert turned(yaw=0.1)[2, 1] == pytest.approx(math.sin(0.1))
    assert turned(pitch=0.1)[2, 2] == pytest.approx(-math.sin(0.1))
    assert turned(roll=0.1)[0, 2] == pytest.approx(-math.sin(0.1))
    assert np.linalg.det(turned(0.3, -0.2, 0.4)) == pytest.approx(1.0)


def test_points_beyond_the_lens_models_field_are_invisible() -> None:
    """A point beyond the angle where a barrel lens's polynomial folds back is not in the picture."""
    camera = CalibratedCamera(
        640, 480, (320.0, 320.0), (319.5, 239.5), 1.6, 0.0, 1.4, 0.0, 0.0, 0.0, (-0.3, 0.0, 0.0, 0.0, 0.0)
    )
    middle, aside = picture_points(camera, np.array([[10.0, 0.0], [3.0, 6.0]]))
    assert np.isfinite(middle).all()
    assert np.isnan(aside).all()
