"""Tests of `lavt camera calibrate` with rendered chessboards and a rendered road."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.perception.chessboard import CORNERS, POSES, rays_of_pixels, render_board
from tests.perception.conftest import LANE, Scene
from tests.perception.test_lens_calibration import PINHOLE

from lavt.assembly.cameras import camera_of_file
from lavt.cli.main import build_app
from lavt.domain import CameraModel, Picture
from lavt.errors import UserError
from lavt.perception.calibration import calibrated_pinhole_camera, picture_points

MODEL = CameraModel(pitch_rad=math.radians(3.0), yaw_rad=math.radians(1.0), z_m=1.3)
PLACE = ("--x-m", "1.6", "--z-m", "1.4")
LENS = "width_px: 640\nheight_px: 480\nfield_of_view_deg: 90.0\nx_m: 1.6\nz_m: 1.0\n"
Calibrate = Callable[..., None]


@cache
def board_pictures() -> tuple[Picture, ...]:
    rays = rays_of_pixels(PINHOLE)
    return tuple(render_board(rays, pose) for pose in POSES[:5])


@pytest.fixture
def calibrate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Calibrate:
    """Return a function that runs the command in a directory with boards, a lens and a road."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPENCV_FFMPEG_LOGLEVEL", "-8")  # the command sets it for its process
    Path("boards").mkdir()
    for number, picture in enumerate(board_pictures()):
        cv2.imwrite(f"boards/{number}.png", picture)
    Path("lens.yaml").write_text(LENS)
    cv2.imwrite("road.png", Scene(MODEL).render(LANE))

    def run(*arguments: str) -> None:
        build_app()(["camera", "calibrate", *arguments], standalone_mode=False)

    return run


def points_of(y_m: float) -> str:
    """Return an option's text: two points of a line of the road in the picture."""
    camera = calibrated_pinhole_camera(MODEL)
    pixels = picture_points(camera, np.array([(5.0, y_m), (12.0, y_m)]))
    return " ".join(f"{u:.1f},{v:.1f}" for u, v in pixels.tolist())


def test_a_lens_is_calibrated_from_a_directory(calibrate: Calibrate, capsys: pytest.CaptureFixture[str]) -> None:
    """The boards of a directory give a calibration file; the RMS is printed, and unusable pictures are named."""
    cv2.imwrite("boards/empty.png", np.full((480, 640, 3), 120, dtype=np.uint8))
    cv2.imwrite("boards/small.png", np.full((240, 320, 3), 120, dtype=np.uint8))
    calibrate("boards", "--corners", f"{CORNERS[0]}x{CORNERS[1]}", *PLACE)
    printed = capsys.readouterr()
    assert "5 of 7 pictures show the whole board" in printed.out
    assert "RMS 0." in printed.out
    assert "empty.png is left out: not all corners are seen" in printed.err
    assert "small.png is left out: it is not 640 x 480" in printed.err
    camera = camera_of_file(Path("camera.yaml"))
    assert camera.focal_px == pytest.approx(PINHOLE.focal_px, rel=0.01)
    assert len(camera.distortion) == 5
    assert (camera.x_m, camera.z_m, camera.pitch_rad) == (1.6, 1.4, 0.0)


def test_the_mounting_is_found_and_drawn(calibrate: Calibrate, capsys: pytest.CaptureFixture[str]) -> None:
    """With a known lens and two lines, the pose is found and written, and the check picture is drawn."""
    lines = ("--left", points_of(1.75), "--right", points_of(-1.75), "--distance-m", "3.5")
    calibrate("--lens", "lens.yaml", "--road", "road.png", *lines, "--out", "mounted.yaml", "--json")
    result = json.loads(capsys.readouterr().out)
    camera = camera_of_file(Path("mounted.yaml"))
    assert math.degrees(camera.pitch_rad) == pytest.approx(3.0, abs=0.05)
    assert math.degrees(camera.yaw_rad) == pytest.approx(1.0, abs=0.05)
    assert camera.z_m == pytest.approx(1.3, abs=0.01)
    assert (result["pitch_deg"], result["z_m"]) == pytest.approx((math.degrees(camera.pitch_rad), camera.z_m))
    assert result["deviation_m"] < 0.01
    check = cv2.imread("mounted-check.png")
    assert check is not None
    assert check.shape[0] == 480


def test_a_calibrated_camera_can_be_mounted_again(calibrate: Calibrate) -> None:
    """A place that is given replaces that of the lens's file, and the rest stays."""
    calibrate("--lens", "lens.yaml", "--x-m", "1.9", "--y-m", "-0.3", "--roll-deg", "2.0", "--z-m", "1.2")
    expected = camera_of_file(Path("lens.yaml"))
    expected = replace(expected, x_m=1.9, y_m=-0.3, z_m=1.2, roll_rad=math.radians(2.0))
    camera = camera_of_file(Path("camera.yaml"))
    assert camera.focal_px == pytest.approx(expected.focal_px)
    assert (camera.x_m, camera.y_m, camera.z_m, camera.roll_rad) == (1.9, -0.3, 1.2, expected.roll_rad)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ((), "name either pictures of a chessboard, or a calibration with --lens"),
        (("boards", "--lens", "lens.yaml"), "name either pictures of a chessboard, or a calibration with --lens"),
        (("boards", "--corners", "nine", *PLACE), "'nine': write COLUMNSxROWS"),
        (("boards", "--corners", "7x7", *PLACE), "0 pictures show the whole board, 0 of them different, but 3"),
        (("boards",), "give --x-m, and either --z-m or --road"),
        (("nowhere", *PLACE), "nowhere does not exist: name pictures of a chessboard, or directories of them"),
        (("empty", *PLACE), "the directory empty has no picture of a chessboard (.png, .jpg, .jpeg): name another"),
        (("--lens", "lens.yaml", "--out", "nowhere/camera.yaml"), "nowhere is not a directory"),
        (
            (
                *("--lens", "lens.yaml", "--road", "road.png", "--left", "1,2", "--right", "3,4", "--distance-m", "3"),
                *("--check", "nowhere/check.png"),
            ),
            "nowhere is not a directory: create it, or name another with --check",
        ),
        (("--lens", "lens.yaml", "--road", "road.png"), "give --left, --right and --distance-m"),
        (
            ("--lens", "lens.yaml", "--road", "road.png", "--left", "1;2", "--right", "3,4 5,6", "--distance-m", "3.5"),
            "--left is '1;2': write pixels as",
        ),
        (
            (
                "--lens",
                "lens.yaml",
                "--road",
                "boards/none.png",
                "--left",
                "1,2",
                "--right",
                "3,4",
                "--distance-m",
                "3",
            ),
            "none.png does not exist",
        ),
    ],
)
def test_bad_input(calibrate: Calibrate, arguments: tuple[str, ...], reason: str) -> None:
    """Each kind of bad input is rejected with a sentence, and no calibration is written."""
    Path("empty").mkdir()
    with pytest.raises(UserError) as raised:
        calibrate(*arguments)
    assert reason in str(raised.value)
    assert not Path("camera.yaml").exists()
