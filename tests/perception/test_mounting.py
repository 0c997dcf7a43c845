"""Tests of the mounting of a camera with known poses: pitch, yaw and height from two parallel lines."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.perception.conftest import LANE, Scene
from tests.perception.test_lens_calibration import FISHEYE, PINHOLE

from lavt.domain import CameraModel, FloatArray
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera, calibrated_pinhole_camera, picture_points
from lavt.perception.mounting import draw_mounting, find_mounting

MODEL = CameraModel(pitch_rad=math.radians(4.0), yaw_rad=math.radians(-2.0), z_m=1.32, y_m=0.2)
"""A pinhole camera that looks down and to the right."""
SIMULATED = calibrated_pinhole_camera(MODEL)
AHEAD_M = (5.0, 8.0, 14.0)


def pixels_of_line(camera: CalibratedCamera, y_m: float) -> FloatArray:
    """Return whole pixels on a line parallel to the car, as a person reads them off."""
    return np.round(picture_points(camera, np.array([(x_m, y_m) for x_m in AHEAD_M])))


def unmounted(camera: CalibratedCamera) -> CalibratedCamera:
    """Return the camera without its pitch, yaw and height."""
    return replace(camera, pitch_rad=0.0, yaw_rad=0.0, z_m=1.0)


@pytest.mark.parametrize("roll_deg", [0.0, 3.0])
@pytest.mark.parametrize("camera", [SIMULATED, PINHOLE, FISHEYE], ids=["simulated", "pinhole", "fisheye"])
def test_the_mounting_is_found_from_two_lines(camera: CalibratedCamera, roll_deg: float) -> None:
    """Pitch and yaw are found within 0.25 degrees and the height within 2 cm, from whole pixels, with a known roll."""
    true = replace(
        camera, pitch_rad=math.radians(3.0), yaw_rad=math.radians(-1.5), z_m=1.35, roll_rad=math.radians(roll_deg)
    )
    left_px, right_px = pixels_of_line(true, 2.0), pixels_of_line(true, -1.5)
    mounting = find_mounting(unmounted(true), left_px, right_px, 3.5)
    found = mounting.camera
    assert math.degrees(found.pitch_rad) == pytest.approx(3.0, abs=0.25)
    assert math.degrees(found.yaw_rad) == pytest.approx(-1.5, abs=0.25)
    assert found.z_m == pytest.approx(1.35, abs=0.02)
    assert mounting.line_y_m == pytest.approx((2.0, -1.5), abs=0.05)
    assert mounting.deviation_m < 0.05
    assert (found.x_m, found.y_m, found.focal_px) == (true.x_m, true.y_m, true.focal_px)


@pytest.mark.parametrize(
    ("left_px", "reason"),
    [
        ([(100.0, 400.0), (100.0, 400.0)], "--left are too close together"),
        ([(100.0, 400.0), (103.0, 395.0)], "--left are too close together"),
    ],
)
def test_points_that_are_close_together_are_refused(left_px: list[tuple[float, float]], reason: str) -> None:
    """A repeated point, or two that are nearly the same, do not give the direction of a line."""
    with pytest.raises(UserError, match=reason):
        find_mounting(unmounted(SIMULATED), np.array(left_px), pixels_of_line(SIMULATED, -1.5), 3.5)


def test_a_line_that_is_seen_over_two_metres_only_is_refused() -> None:
    """Points that are far apart in the picture but not along the road are refused with their distance."""
    near = np.array([(4.0, 2.0), (5.5, 2.0)])
    with pytest.raises(UserError, match=r"--left are 1\.\d m apart along the road, but at least 4 m"):
        find_mounting(unmounted(SIMULATED), picture_points(SIMULATED, near), pixels_of_line(SIMULATED, -1.5), 3.5)


def test_the_mounting_of_the_simulated_camera_is_found_in_its_picture() -> None:
    """From the brightest pixels of the lines in a rendered picture, the pose of the camera is found."""
    picture = Scene(MODEL).render(LANE)
    lines = []
    for line in LANE:
        expected = picture_points(SIMULATED, np.array([(x_m, line.offset_m) for x_m in AHEAD_M]))
        rows = [round(v) for v in expected[:, 1].tolist()]
        found = []
        for (u, _), row in zip(expected.tolist(), rows, strict=True):
            first = max(round(u) - 20, 0)
            brightness = picture[row, first : round(u) + 20, 0].astype(float) - 85
            found.append((first + float(np.average(np.arange(len(brightness)), weights=brightness)), row))
        lines.append(np.array(found))
    mounting = find_mounting(unmounted(SIMULATED), lines[0], lines[1], 3.5)
    assert math.degrees(mounting.camera.pitch_rad) == pytest.approx(4.0, abs=0.1)
    assert math.degrees(mounting.camera.yaw_rad) == pytest.approx(-2.0, abs=0.1)
    assert mounting.camera.z_m == pytest.approx(1.32, abs=0.01)


def test_the_drawn_lines_are_on_those_of_the_road() -> None:
    """The drawn lines cover the marks of the road; from above they are upright and 3.5 m apart."""
    picture = Scene(MODEL).render(LANE)
    mounting = find_mounting(
        unmounted(SIMULATED), pixels_of_line(SIMULATED, 1.75), pixels_of_line(SIMULATED, -1.75), 3.5
    )
    drawn = draw_mounting(picture, mounting)
    own = drawn[:, : picture.shape[1]]
    is_yellow = (own[..., 0] < 140) & (own[..., 2] > 180)
    rows, columns = np.nonzero(is_yellow[300:])
    marks = picture[300:, :, 0] > 150
    is_on_mark = [marks[row, max(column - 3, 0) : column + 4].any() for row, column in zip(rows, columns, strict=True)]
    assert len(rows) > 100
    assert np.mean(is_on_mark) > 0.95
    above = drawn[:200, picture.shape[1] :]
    yellow_columns = np.flatnonzero(((above[..., 0] < 140) & (above[..., 2] > 180)).all(axis=0))
    assert np.ptp(yellow_columns) == pytest.approx(3.5 / 14.0 * above.shape[1], abs=3)


def test_points_off_the_line_are_reported() -> None:
    """A point that is half a metre beside its line shows in the deviation."""
    left_px, right_px = pixels_of_line(SIMULATED, 1.75), pixels_of_line(SIMULATED, -1.75)
    beside = picture_points(SIMULATED, np.array([(8.0, 2.25)]))
    bent = np.concatenate([left_px, beside])
    assert find_mounting(unmounted(SIMULATED), bent, right_px, 3.5).deviation_m > 0.2


@pytest.mark.parametrize(
    ("left", "right", "reason"),
    [
        ([(100, 400), (250, 300)], [(540, 400)], "at least two points"),
        ([(540, 400), (390, 300)], [(100, 400), (250, 300)], "exchange --left and --right"),
        ([(100, 400), (250, 300)], [(100, 400), (250, 300)], "nearly the same line"),
        ([(100, 400), (250, 300), (325, 250), (400, 200)], [(540, 400), (390, 300)], "above the horizon"),
    ],
)
def test_points_that_determine_nothing_are_rejected(
    left: list[tuple[float, float]], right: list[tuple[float, float]], reason: str
) -> None:
    """Too few points, exchanged or equal lines, and points above the horizon are errors with a remedy."""
    with pytest.raises(UserError, match=reason):
        find_mounting(unmounted(SIMULATED), np.array(left, float), np.array(right, float), 3.5)
