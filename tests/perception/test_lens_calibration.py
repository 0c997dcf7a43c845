"""Tests of the calibration of a lens with rendered chessboards."""

from __future__ import annotations

import numpy as np
import pytest
from tests.perception.chessboard import CORNERS, POSES, rays_of_pixels, render_board

from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera
from lavt.perception.lens_calibration import Corners, calibrate_lens, covered_shares, find_corners

SIZE_PX = (640, 480)
PLACE = (1.6, 0.0, 1.4, 0.0, 0.0, 0.0)
PINHOLE = CalibratedCamera(*SIZE_PX, (420.0, 424.0), (325.0, 236.0), *PLACE, (-0.25, 0.08, 0.001, -0.0005, 0.0))
FISHEYE = CalibratedCamera(*SIZE_PX, (330.0, 332.0), (322.0, 241.0), *PLACE, (0.05, -0.01, 0.002, -0.001), True)


def boards_of(camera: CalibratedCamera) -> list[Corners]:
    rays = rays_of_pixels(camera)
    boards = [find_corners(render_board(rays, pose), CORNERS) for pose in POSES]
    return [board for board in boards if board is not None]


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_the_lens_is_found_from_chessboards(camera: CalibratedCamera) -> None:
    """The focal lengths are found within 0.5 %, the middle within 2 px, and the corners within 0.2 px."""
    boards = boards_of(camera)
    assert len(boards) >= 8
    lens = calibrate_lens(boards, CORNERS, SIZE_PX, fisheye=camera.fisheye)
    assert lens.focal_px == pytest.approx(camera.focal_px, rel=0.005)
    assert lens.middle_px == pytest.approx(camera.middle_px, abs=2.0)
    assert lens.distortion[0] == pytest.approx(camera.distortion[0], abs=0.03)
    assert lens.rms_px < 0.2
    assert max(lens.board_rms_px) < 0.4
    assert np.sqrt(np.mean(np.square(lens.board_rms_px))) == pytest.approx(lens.rms_px, rel=0.02)
    assert len(lens.board_rms_px) == len(boards)
    assert lens.fisheye is camera.fisheye


def test_a_hidden_corner_is_no_board() -> None:
    """A board of which a part is outside the picture is not found."""
    rays = rays_of_pixels(PINHOLE)
    assert find_corners(render_board(rays, (7.0, 0.0, 11.0, 0.0, 0.0)), CORNERS) is None


def test_two_boards_are_too_few() -> None:
    """Fewer than three boards are rejected with what is needed."""
    board = np.zeros((54, 1, 2), dtype=np.float32)
    with pytest.raises(UserError, match="2 pictures show the whole board, 1 of them different, but 3"):
        calibrate_lens([board] * 2, CORNERS, SIZE_PX)


def test_copies_of_one_board_are_too_few() -> None:
    """Ten copies of a board, and copies that are shifted by some pixels, are one view."""
    board = boards_of(PINHOLE)[0]
    copies = [board + np.float32(0.4 * number) for number in range(10)]
    with pytest.raises(UserError, match="10 pictures show the whole board, 1 of them different"):
        calibrate_lens(copies, CORNERS, SIZE_PX)


def test_boards_that_all_face_the_camera_determine_no_lens() -> None:
    """Without a tilted board, any focal length explains the pictures, so none is accepted."""
    rays = rays_of_pixels(PINHOLE)
    poses = [
        (across, down, ahead, 0.0, 0.0) for across, down, ahead in ((0, 0, 11), (-2, 1, 14), (2, -1, 14), (1, 1, 18))
    ]
    boards = [board for pose in poses if (board := find_corners(render_board(rays, pose), CORNERS)) is not None]
    assert len(boards) == len(poses)
    with pytest.raises(UserError, match=r"do not determine the lens, because .* tilted by up to 45 degrees"):
        calibrate_lens(boards, CORNERS, SIZE_PX)


def test_a_lens_that_cannot_be_is_refused() -> None:
    """Corners at random, which no lens explains, are refused, and no lens is returned."""
    generator = np.random.default_rng(3)
    boards = [generator.uniform(50, 430, (54, 1, 2)).astype(np.float32) for _ in range(6)]
    with pytest.raises(UserError, match=r"do not determine the lens|cannot calibrate the lens"):
        calibrate_lens(boards, CORNERS, SIZE_PX)


def test_the_covered_shares_are_those_between_the_outermost_corners() -> None:
    """The shares of width and height are measured over the corners of all boards together."""
    boards = [np.array([[[64.0, 48.0]], [[320.0, 96.0]]], dtype=np.float32), np.array([[[576.0, 288.0]]], np.float32)]
    assert covered_shares(boards, SIZE_PX) == pytest.approx((0.8, 0.5))
