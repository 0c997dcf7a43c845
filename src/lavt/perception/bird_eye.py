"""The bird's-eye view of the ground: inverse perspective mapping by the camera's calibration, assuming flat ground.

Coordinates are those of `calibration.py`. In a bird's-eye picture the far end is at the top and left is on the left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera, picture_points

STAMP_SIDE_PX = 64
"""Side of the top left square with the time stamp, which is masked if the pictures are stamped."""
STAMP_MARGIN_PX = 12
"""Width of the masked margin beside the stamp at a focal length of up to 320 px: the codec smears the stamp's edges."""
PictureMaps = tuple[NDArray[np.int16], NDArray[np.uint16]]
"""OpenCV's fixed-point maps, whole parts and fractions: for each cell its coordinates in the cropped rows."""
ROW_MARGIN_PX = 3
"""Additional rows of pixels above and below the grid, and below the stamp, for interpolation and the codec's smear."""
CENTRAL_HALF_WIDTH_M = 3.5
"""Half the width of the central strip of ground, which a camera must see."""
MIN_VISIBLE_SHARE = 0.4
"""The share of the central strip that a camera must see to be usable."""


@dataclass(frozen=True, slots=True)
class GroundGrid:
    """The ground searched for lanes, divided into cells.

    Nearer than `near_m` the default camera sees less than a lane's width. At `far_m` a row of pixels covers 0.9 m of
    ground.
    """

    near_m: float = 3.6
    far_m: float = 20.0
    half_width_m: float = 7.0
    step_x_m: float = 0.10
    step_y_m: float = 0.05

    @property
    def rows(self) -> int:
        """The number of cells along x."""
        return round((self.far_m - self.near_m) / self.step_x_m)

    @property
    def columns(self) -> int:
        """The number of cells along y."""
        return round(2 * self.half_width_m / self.step_y_m)

    def row_x_m(self) -> FloatArray:
        """Return x of the middle of each row, farthest first, (rows,)."""
        return self.far_m - (np.arange(self.rows, dtype=np.float64) + 0.5) * self.step_x_m

    def column_y_m(self) -> FloatArray:
        """Return y of the middle of each column, leftmost first, (columns,)."""
        return self.half_width_m - (np.arange(self.columns, dtype=np.float64) + 0.5) * self.step_y_m

    def cell_to_ground(self) -> FloatArray:
        """Return the 3 x 3 matrix from (column, row, 1) to (x, y, 1)."""
        return np.array(
            [
                [0.0, -self.step_x_m, self.far_m - self.step_x_m / 2],
                [-self.step_y_m, 0.0, self.half_width_m - self.step_y_m / 2],
                [0.0, 0.0, 1.0],
            ]
        )


@dataclass(frozen=True, slots=True)
class BirdEye:
    """The mapping from a camera's pictures to bird's-eye pictures: the rows to crop, and the map from the grid."""

    grid: GroundGrid
    top_px: int
    bottom_px: int
    region_from_grid: PictureMaps
    unstamped_mask: NDArray[np.uint8] | None
    """255 for cells that the time stamp does not cover, 0 for cells that it covers; None if it covers no cell."""

    def region(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the rows of `picture` that contain the grid, without a copy."""
        return picture[self.top_px : self.bottom_px]

    def view_from_above(self, region: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Map cropped rows, with any number of channels, to the grid's cells; cells outside the picture are black."""
        visible = cv2.remap(region, *self.region_from_grid, cv2.INTER_LINEAR)
        if self.unstamped_mask is not None:
            visible = cv2.bitwise_and(visible, visible, mask=self.unstamped_mask)
        return np.asarray(visible, dtype=np.uint8)


def make_bird_eye(camera: CalibratedCamera, grid: GroundGrid, *, stamped: bool = True) -> BirdEye:
    """Create the mapping for a camera; `stamped` is whether its pictures contain the time stamp.

    Raises `UserError` if the camera sees too little of the road that the grid covers.
    """
    pixels = _cell_pixels(camera, grid)
    u_px, v_px = pixels[..., 0], pixels[..., 1]
    with np.errstate(invalid="ignore"):
        inside = (u_px >= 0) & (u_px <= camera.width_px - 1) & (v_px >= 0) & (v_px <= camera.height_px - 1)
        margin_px = STAMP_MARGIN_PX * max(camera.scale, 1.0)
        stamp = inside & (u_px < STAMP_SIDE_PX + margin_px) & (v_px < STAMP_SIDE_PX + ROW_MARGIN_PX) & stamped
    central = np.abs(grid.column_y_m()) < CENTRAL_HALF_WIDTH_M
    visible = inside & ~stamp
    if visible[:, central].mean() < MIN_VISIBLE_SHARE or not visible[: grid.rows // 2, central].any():
        raise UserError(
            f"the camera does not see the road {grid.near_m} to {grid.far_m} m ahead of the rear axle; "
            "correct its position, yaw, pitch, roll, lens or picture size"
        )
    top_px = max(math.floor(v_px[inside].min()) - ROW_MARGIN_PX, 0)
    bottom_px = min(math.ceil(v_px[inside].max()) + ROW_MARGIN_PX, camera.height_px)
    unstamped_mask = np.where(stamp, 0, 255).astype(np.uint8) if stamp.any() else None
    maps = np.where(inside[..., None], pixels - (0, top_px), -9.0).astype(np.float32)  # -9: outside the picture
    whole, fractions = cv2.convertMaps(maps[..., 0], maps[..., 1], cv2.CV_16SC2)
    return BirdEye(grid, top_px, bottom_px, (np.asarray(whole), np.asarray(fractions)), unstamped_mask)


def _cell_pixels(camera: CalibratedCamera, grid: GroundGrid) -> FloatArray:
    """Return the picture coordinates of the middle of each cell, (rows, columns, 2); NaN for an invisible middle."""
    columns, rows = np.meshgrid(np.arange(grid.columns), np.arange(grid.rows))
    cells = np.stack([columns, rows, np.ones_like(columns)], axis=-1).reshape(-1, 3)
    ground = cells @ grid.cell_to_ground()[:2].T
    return picture_points(camera, ground).reshape(grid.rows, grid.columns, 2)
