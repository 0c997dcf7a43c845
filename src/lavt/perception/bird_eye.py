"""The ground as seen from above: inverse perspective mapping by the camera's geometry, assuming flat ground.

Ground coordinates are the vehicle's frame: x ahead of the rear axle, y left, in metres. Pixel coordinates are those of
OpenCV: the middle of the top left pixel is (0, 0). A bird's-eye picture has "far" at the top and "left" at the left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import CameraModel, FloatArray
from lavt.errors import UserError

STAMP_SIDE_PX = 64
"""The top left square of this side carries the time stamp; the rows it covers are never looked at."""


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


def ground_to_picture(model: CameraModel) -> FloatArray:
    """Give the 3 x 3 homography from ground (x, y, 1) to picture (u, v, 1), up to scale.

    The third component is the depth along the camera's axis; a point with none is not in the picture.
    """
    cosine, sine, focal_px = math.cos(model.pitch_rad), math.sin(model.pitch_rad), model.focal_px
    # Rows: to the right, down, and deep, of a ground point (x, y, 1) as the camera sees it.
    camera = np.array(
        [
            [0.0, -1.0, 0.0],
            [-sine, 0.0, model.x_m * sine + model.z_m * cosine],
            [cosine, 0.0, -model.x_m * cosine + model.z_m * sine],
        ]
    )
    u_px, v_px = (model.width_px - 1) / 2, (model.height_px - 1) / 2
    lens: FloatArray = np.array([[focal_px, 0.0, u_px], [0.0, focal_px, v_px], [0.0, 0.0, 1.0]])
    return np.asarray(lens @ camera, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class BirdEye:
    """How one camera's pictures become bird's-eye pictures: which rows to cut out, and the map from grid to them."""

    grid: GroundGrid
    top_px: int
    bottom_px: int
    region_from_grid: FloatArray

    def region(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Cut out the rows in which the grid is seen, a view of `picture`."""
        return picture[self.top_px : self.bottom_px]

    def from_above(self, region: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Map a cut-out, grey or in colour, to the grid: (grid.rows, grid.columns), black where nothing is seen."""
        seen = cv2.warpPerspective(
            region,
            self.region_from_grid,
            (self.grid.columns, self.grid.rows),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        return np.asarray(seen, dtype=np.uint8)


def bird_eye(model: CameraModel, grid: GroundGrid) -> BirdEye:
    """Prepare the mapping for a camera.

    Raises UserError when the camera does not see the far and the near end of the grid below the stamp.
    """
    picture_from_ground = ground_to_picture(model)
    far, near = (picture_from_ground @ np.array([x_m, 0.0, 1.0]) for x_m in (grid.far_m, grid.near_m))
    # A margin of two rows, for interpolation and the 5 rows of smoothing.
    top_px = max(math.floor(far[1] / far[2]) - 2, STAMP_SIDE_PX) if far[2] > 0 else 0
    bottom_px = min(math.ceil(near[1] / near[2]) + 3, model.height_px) if near[2] > 0 else 0
    if bottom_px - top_px < 16:
        raise UserError(
            f"the camera does not see the road {grid.near_m} to {grid.far_m} m ahead of the rear axle; "
            "correct its height, pitch, field of view or picture size"
        )
    shift = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -top_px], [0.0, 0.0, 1.0]])
    return BirdEye(grid, top_px, bottom_px, shift @ picture_from_ground @ grid.to_ground())
