"""The calibration of a lens from pictures of a chessboard, by OpenCV.

The method is that of Z. Zhang, A Flexible New Technique for Camera Calibration, IEEE Transactions on Pattern Analysis
and Machine Intelligence 22, 2000, pp. 1330-1334.
"""

from __future__ import annotations

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
"""Fewer pictures of the board do not determine a lens."""
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
    if len(boards) < MIN_BOARDS:
        raise UserError(
            f"{len(boards)} pictures show the whole board, but {MIN_BOARDS} are needed and 10 to 20 are good: take "
            "more, from different directions and in all corners of the picture, or correct --corners"
        )
    columns, rows = size
    board = np.zeros((columns * rows, 1, 3), dtype=np.float32)
    board[:, 0, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    points = [board] * len(boards)
    try:
        if fisheye:
            found = cv2.fisheye.calibrate(
                [each.astype(np.float64).reshape(1, -1, 3) for each in points],
                [each.astype(np.float64).reshape(1, -1, 2) for each in boards],
                picture_px,
                np.eye(3),
                np.zeros((4, 1)),
                flags=sum(getattr(cv2.fisheye, name, None) or getattr(cv2, name) for name in FISHEYE_FLAGS),
            )
        else:
            found = cv2.calibrateCamera(points, list(boards), picture_px, None, None)
    except cv2.error as error:
        raise UserError(
            f"OpenCV cannot calibrate the lens with these boards ({error.err}): take more, from different directions"
        ) from error
    rms_px, matrix, distortion, turned, moved = found
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


def covered_shares(boards: Sequence[Corners], picture_px: tuple[int, int]) -> tuple[float, float]:
    """Return the shares of the picture's width and height between the outermost corners of all boards."""
    corners = np.concatenate([board.reshape(-1, 2) for board in boards])
    spans = np.ptp(corners, axis=0) / np.array(picture_px)
    return float(spans[0]), float(spans[1])
