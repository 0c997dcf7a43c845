"""The calibration of a lens from pictures of a chessboard, by OpenCV.

The method is that of Z. Zhang, A Flexible New Technique for Camera Calibration, IEEE Transactions on Pattern Analysis
and Machine Intelligence 22, 2000, pp. 1330-1334.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import Picture
from lavt.errors import UserError

Corners = NDArray[np.float32]
"""The inner corners of a chessboard in a picture, row by row, (n, 1, 2) in pixels."""

MIN_BOARDS = 3
"""Fewer different pictures of the board do not determine a lens."""
SAME_BOARD_SHARE = 0.01
"""Two boards whose corners are closer together than this share of the picture's width, on average, are the same."""
MAX_RMS_SHARE = 0.005
"""A calibration that misses the corners by more than this share of the picture's width is none."""
MIDDLE_SHARES = (0.2, 0.8)
"""Where the middle of a real lens can be, as a share of the picture."""
MAX_FOCAL_RATIO = 1.25
MIN_FIELD_RAD = math.radians(5)
MAX_FOCAL_DEVIATION = 0.05
"""The largest relative standard deviation of the focal length."""
MORE_BOARDS = "take more, tilted by up to 45 degrees to each side, near and far, and in all corners of the picture"
REFINE_WINDOW_PX = 11
"""Half the largest side of the window in which a corner is refined; a window must not reach the next corner."""
FISHEYE_FLAGS = ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW")
"""The flags of the calibration of a fisheye; OpenCV 4 has them in `cv2.fisheye`, OpenCV 5 in `cv2`."""
REFINE_UNTIL = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 0.001)


@dataclass(frozen=True, slots=True)
class LensCalibration:
    """A calibrated lens."""

    focal_px: tuple[float, float]
    middle_px: tuple[float, float]
    distortion: tuple[float, ...]
    """k1, k2, p1, p2 and k3, or k1 to k4 of a fisheye lens."""
    fisheye: bool
    rms_px: float
    """The root mean square distance of the corners from where the calibration puts them."""
    board_rms_px: tuple[float, ...]
    """The same for each board."""

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Return OpenCV's camera matrix, (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_px, self.middle_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def find_corners(picture: Picture, size: tuple[int, int]) -> Corners | None:
    """Return the inner corners of a chessboard with `size` (columns, rows) of them; None unless all are seen."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    is_found, corners = cv2.findChessboardCorners(grey, size)
    if not is_found:
        return None
    grid = np.asarray(corners, dtype=np.float64).reshape(size[1], size[0], 2)
    steps_px = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    half = int(np.clip(min(steps_px) / 2 - 1, 1, REFINE_WINDOW_PX))
    refined = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), REFINE_UNTIL)
    return np.asarray(refined, dtype=np.float32).reshape(-1, 1, 2)


def calibrate_lens(
    boards: Sequence[Corners], size: tuple[int, int], picture_px: tuple[int, int], *, fisheye: bool = False
) -> LensCalibration:
    """Return the lens that explains the corners of several boards best; `picture_px` is (width, height).

    Raises `UserError` if there are too few boards, or if they do not determine the lens.
    """
    different = different_boards(boards, picture_px[0])
    if different < MIN_BOARDS:
        raise UserError(
            f"{len(boards)} pictures show the whole board, {different} of them different, but {MIN_BOARDS} different "
            f"ones are needed and 10 to 20 are good: {MORE_BOARDS}, or correct --corners"
        )
    columns, rows = size
    board = np.zeros((columns * rows, 1, 3), dtype=np.float32)
    board[:, 0, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    points = [board] * len(boards)
    try:
        if fisheye:
            focal_deviation = 0.0  # OpenCV does not give it
            found = cv2.fisheye.calibrate(
                [each.astype(np.float64).reshape(1, -1, 3) for each in points],
                [each.astype(np.float64).reshape(1, -1, 2) for each in boards],
                picture_px,
                np.eye(3),
                np.zeros((4, 1)),
                flags=sum(getattr(cv2.fisheye, name, None) or getattr(cv2, name) for name in FISHEYE_FLAGS),
            )
        else:
            start = np.eye(3), np.zeros((5, 1))
            rms, lens, bend, turns, moves, deviations, _, _ = cv2.calibrateCameraExtended(
                points, list(boards), picture_px, *start
            )
            found = rms, lens, bend, turns, moves
            focal_deviation = float(np.ravel(np.asarray(deviations))[0])
    except cv2.error as error:
        raise UserError(f"OpenCV cannot calibrate the lens with these boards ({error.err}): {MORE_BOARDS}") from error
    rms_px, matrix, distortion, turned, moved = found
    _check_lens(float(rms_px), np.asarray(matrix, dtype=np.float64), focal_deviation, picture_px)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    board_rms_px = []
    for corners, turn, move in zip(boards, turned, moved, strict=True):
        seen = np.asarray(project(board.astype(np.float64), turn, move, matrix, distortion)[0]).reshape(-1, 2)
        board_rms_px.append(float(np.sqrt(np.mean(np.sum((seen - corners.reshape(-1, 2)) ** 2, axis=1)))))
    return LensCalibration(
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]), float(matrix[1, 2])),
        tuple(float(value) for value in np.ravel(distortion)[: 4 if fisheye else 5]),
        fisheye,
        float(rms_px),
        tuple(board_rms_px),
    )


def different_boards(boards: Sequence[Corners], width_px: int) -> int:
    """Return how many boards are not the same as another one."""
    kept: list[Corners] = []
    for board in boards:
        if all(np.linalg.norm(board - other, axis=-1).mean() > SAME_BOARD_SHARE * width_px for other in kept):
            kept.append(board)
    return len(kept)


def _check_lens(
    rms_px: float, matrix: NDArray[np.float64], focal_deviation_px: float, picture_px: tuple[int, int]
) -> None:
    """Raise `UserError` for a lens that cannot be, or that the boards do not determine."""
    width_px, height_px = picture_px
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    reason = ""
    if not (np.isfinite(matrix).all() and min(fx, fy) > 0 and rms_px <= MAX_RMS_SHARE * width_px):
        reason = f"it misses the corners by {rms_px:.3g} px (RMS)"
    elif focal_deviation_px > MAX_FOCAL_DEVIATION * fx:
        reason = f"the focal length of {fx:.0f} px is uncertain by {focal_deviation_px:.0f} px"
    elif not all(MIDDLE_SHARES[0] <= share <= MIDDLE_SHARES[1] for share in (cx / width_px, cy / height_px)):
        reason = f"the middle of the lens would be at {cx:.0f}, {cy:.0f} px"
    elif not 1 / MAX_FOCAL_RATIO <= fx / fy <= MAX_FOCAL_RATIO or 2 * math.atan(width_px / 2 / fx) < MIN_FIELD_RAD:
        reason = f"the focal lengths would be {fx:.3g} and {fy:.3g} px"
    if reason:
        raise UserError(f"these boards do not determine the lens, because {reason}: {MORE_BOARDS}")


def covered_shares(boards: Sequence[Corners], picture_px: tuple[int, int]) -> tuple[float, float]:
    """Return the shares of the picture's width and height between the outermost corners of all boards."""
    corners = np.concatenate([board.reshape(-1, 2) for board in boards])
    spans = np.ptp(corners, axis=0) / np.array(picture_px)
    return float(spans[0]), float(spans[1])
