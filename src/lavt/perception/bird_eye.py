"""The ground as seen from above: inverse perspective mapping by the camera's calibration, assuming flat ground.

Coordinates are those of `calibration.py`. A bird's-eye picture has "far" at the top and "left" at the left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera, ground_to_picture, picture_points

STAMP_SIDE_PX = 64
"""The top left square of this side carries the time stamp, and is never looked at where there is one."""
STAMP_MARGIN_PX = 12
"""Beside the stamp, at a focal length of 320 px or less: its edges speak for that much (half of `MARK_PX`)."""
DistortionMaps = tuple[NDArray[np.int16], NDArray[np.uint16]]
"""OpenCV's maps in fixed point: where in the picture each cell is seen."""
MARGIN_PX = 3
"""Rows beyond the ground looked at, for interpolation and the 5 rows of smoothing."""
CENTRAL_HALF_WIDTH_M = 3.5
"""To either side: the ground ahead that matters most."""
MIN_VISIBLE_SHARE = 0.4
"""Share of the ground ahead that a camera must see to be of use."""


@dataclass(frozen=True, slots=True)
class GroundGrid:
    """The piece of ground that is looked at, cut into cells.

    Nearer than `near_m` the default camera sees less than a lane's width; at `far_m` a row of its picture is 0.9 m.
    """

    near_m: float = 3.6
    far_m: float = 20.0
    half_width_m: float = 7.0
    step_x_m: float = 0.10
    step_y_m: float = 0.05

    @property
    def rows(self) -> int:
        """Cells along x."""
        return round((self.far_m - self.near_m) / self.step_x_m)

    @property
    def columns(self) -> int:
        """Cells along y."""
        return round(2 * self.half_width_m / self.step_y_m)

    def row_x_m(self) -> FloatArray:
        """Give x of the middle of each row, farthest first, (rows,)."""
        return self.far_m - (np.arange(self.rows, dtype=np.float64) + 0.5) * self.step_x_m

    def column_y_m(self) -> FloatArray:
        """Give y of the middle of each column, leftmost first, (columns,)."""
        return self.half_width_m - (np.arange(self.columns, dtype=np.float64) + 0.5) * self.step_y_m

    def to_ground(self) -> FloatArray:
        """Give the 3 x 3 map from (column, row, 1) to (x, y, 1)."""
        return np.array(
            [
                [0.0, -self.step_x_m, self.far_m - self.step_x_m / 2],
                [-self.step_y_m, 0.0, self.half_width_m - self.step_y_m / 2],
                [0.0, 0.0, 1.0],
            ]
        )


@dataclass(frozen=True, slots=True)
class BirdEye:
    """How one camera's pictures become bird's-eye pictures: which rows to cut out, and the map from grid to them."""

    grid: GroundGrid
    top_px: int
    bottom_px: int
    region_from_grid: FloatArray | DistortionMaps
    """From the grid to the rows cut out: a homography, or maps for a lens that bends lines."""
    hidden: NDArray[np.uint8] | None
    """0 for the cells that the time stamp covers, else 255; None when it covers none."""

    def region(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Cut out the rows in which the grid is seen, a view of `picture`."""
        return picture[self.top_px : self.bottom_px]

    def from_above(self, region: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Map a cut-out, grey or in colour, to the grid: (grid.rows, grid.columns), black where nothing is seen."""
        size = (self.grid.columns, self.grid.rows)
        if isinstance(self.region_from_grid, tuple):
            visible = cv2.remap(region, *self.region_from_grid, cv2.INTER_LINEAR)
        else:
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            visible = cv2.warpPerspective(region, self.region_from_grid, size, flags=flags)
        if self.hidden is not None:
            visible = cv2.bitwise_and(visible, visible, mask=self.hidden)
        return np.asarray(visible, dtype=np.uint8)


def bird_eye(camera: CalibratedCamera, grid: GroundGrid, *, stamped: bool = True) -> BirdEye:
    """Prepare the mapping for a camera; `stamped` tells whether its pictures carry the time stamp.

    Raises UserError when the camera does not see the road that the grid covers.
    """
    pixels = _cell_pixels(camera, grid)
    u_px, v_px = pixels[..., 0], pixels[..., 1]
    with np.errstate(invalid="ignore"):
        inside = (u_px >= 0) & (u_px <= camera.width_px - 1) & (v_px >= 0) & (v_px <= camera.height_px - 1)
        margin_px = STAMP_MARGIN_PX * max(camera.scale, 1.0)
        stamp = inside & (u_px < STAMP_SIDE_PX + margin_px) & (v_px < STAMP_SIDE_PX + MARGIN_PX) & stamped
    ahead = np.abs(grid.column_y_m()) < CENTRAL_HALF_WIDTH_M
    visible = inside & ~stamp
    if visible[:, ahead].mean() < MIN_VISIBLE_SHARE or not visible[: grid.rows // 2, ahead].any():
        raise UserError(
            f"the camera does not see the road {grid.near_m} to {grid.far_m} m ahead of the rear axle; "
            "correct its place, yaw, pitch, roll, lens or picture size"
        )
    top_px = max(math.floor(v_px[inside].min()) - MARGIN_PX, 0)
    bottom_px = min(math.ceil(v_px[inside].max()) + MARGIN_PX, camera.height_px)
    hidden = np.where(stamp, 0, 255).astype(np.uint8) if stamp.any() else None
    if not camera.distortion:
        shift = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -top_px], [0.0, 0.0, 1.0]])
        homography = shift @ ground_to_picture(camera) @ grid.to_ground()
        return BirdEye(grid, top_px, bottom_px, homography, hidden)
    maps = np.where(inside[..., None], pixels - (0, top_px), -9.0).astype(np.float32)
    whole, fractions = cv2.convertMaps(maps[..., 0], maps[..., 1], cv2.CV_16SC2)
    return BirdEye(grid, top_px, bottom_px, (np.asarray(whole), np.asarray(fractions)), hidden)


def _cell_pixels(camera: CalibratedCamera, grid: GroundGrid) -> FloatArray:
    """Tell where in the picture the middle of each cell is seen: (rows, columns, 2), NaN where it is not."""
    columns, rows = np.meshgrid(np.arange(grid.columns), np.arange(grid.rows))
    cells = np.stack([columns, rows, np.ones_like(columns)], axis=-1).reshape(-1, 3)
    ground = cells @ grid.to_ground()[:2].T
    return picture_points(camera, ground).reshape(grid.rows, grid.columns, 2)
