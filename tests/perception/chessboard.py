"""Render pictures of a chessboard as a camera with a known lens sees it, independent of the code under test."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline
from tests.perception.lens import undistort

from lavt.domain import FloatArray, Picture
from lavt.perception.calibration import CalibratedCamera

CORNERS = (9, 6)
"""The inner corners of the board: 10 x 7 fields."""
OVERSAMPLING = 2
COARSE_PX = 20.0
GREY, BLACK, WHITE = 120, 20, 235
POSES = tuple(
    (across, down, 11.0 + 2.0 * abs(tilt), tilt, turn)
    for across, down, tilt, turn in (
        (-2.5, -1.5, 0.5, 0.0), (2.5, -1.5, -0.5, 0.2), (-2.5, 1.5, 0.3, -0.5), (2.5, 1.5, -0.3, 0.5),
        (0.0, 0.0, 0.6, 0.6), (0.0, 2.0, -0.7, 0.0), (-3.5, 0.0, 0.0, 0.6), (3.5, 0.0, 0.0, -0.6),
        (0.0, -2.0, 0.7, 0.3), (0.0, 0.0, 0.0, 0.1),
    )
)  # fmt: skip
"""Middle of the board (right, down and ahead, in fields), and its rotations about the horizontal and vertical axis."""


def rays_of_pixels(camera: CalibratedCamera) -> FloatArray:
    """Return the directions of all samples of a picture, (h, w, 3), `OVERSAMPLING` in each direction of a pixel."""
    u = (np.arange(camera.width_px * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    v = (np.arange(camera.height_px * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    # On a coarse grid, because the inverse of the lens is slow, and interpolated: the lens is smooth.
    coarse_u, coarse_v = (np.append(np.arange(0.0, end, COARSE_PX), end) for end in (camera.width_px, camera.height_px))
    coarse = undistort(camera, np.stack(np.meshgrid(coarse_u, coarse_v), axis=-1).reshape(-1, 2))
    shape = (len(coarse_v), len(coarse_u))
    splines = [RectBivariateSpline(coarse_v, coarse_u, coarse[:, axis].reshape(shape)) for axis in (0, 1)]
    plane = np.column_stack([spline(v, u).ravel() for spline in splines])
    return np.column_stack([plane, np.ones(len(plane))]).reshape(len(v), len(u), 3)


def render_board(rays: FloatArray, pose: tuple[float, float, float, float, float]) -> Picture:
    """Return the picture of the board at a pose of `POSES`."""
    across, down, ahead, tilt, turn = pose
    about_x, _ = cv2.Rodrigues(np.array([tilt, 0.0, 0.0]))
    about_y, _ = cv2.Rodrigues(np.array([0.0, turn, 0.0]))
    rotation = np.asarray(about_y @ about_x, dtype=np.float64)
    middle, normal = np.array([across, down, ahead]), rotation[:, 2]
    distance = (middle @ normal) / (rays @ normal)
    on_board = (rays * distance[..., None] - middle) @ rotation
    columns, rows = CORNERS[0] + 1, CORNERS[1] + 1
    x, y = on_board[..., 0] + columns / 2, on_board[..., 1] + rows / 2
    fields = np.where((np.floor(x) + np.floor(y)) % 2 == 0, BLACK, WHITE)
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    rim = (x >= -1) & (x < columns + 1) & (y >= -1) & (y < rows + 1)
    samples = np.where(inside, fields, np.where(rim, WHITE, GREY)).astype(np.float32)
    size = (rays.shape[1] // OVERSAMPLING, rays.shape[0] // OVERSAMPLING)
    grey = cv2.resize(samples, size, interpolation=cv2.INTER_AREA)
    return np.repeat(np.round(grey).astype(np.uint8)[..., None], 3, axis=2)
