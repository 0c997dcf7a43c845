"""The bands of picture rows that each scale of the ground covers, finer scales nearer (a clipmap)."""

from __future__ import annotations

import math

import numpy as np

from lavt.domain import CameraModel, FloatArray
from lavt.vehicle.sim.rendering.ground import TILE_M
from lavt.vehicle.sim.rendering.pinhole import CameraPlacement, row_of_depth
from lavt.vehicle.sim.rendering.textures import SCALES_M

BAND_FAR_M = (5.0, 11.0, 26.0, 60.0, 160.0)
"""The distance ahead of the camera that each scale of the ground reaches."""

_MAX_LINES = 6
_TEXELS_A_LINE = 2.5


class Band:
    """The rows of a level camera's picture that one scale covers, and the square of tiles visible in them.

    A distant row covers a long piece of ground. It is drawn as the mean of `lines` finer rows, so that dashes do not
    flicker.
    """

    def __init__(self, model: CameraModel, level: int) -> None:
        far_m = BAND_FAR_M[level]
        near_m = BAND_FAR_M[level - 1] if level else 0.0
        self.level = level
        self.first_row = row_of_depth(model, far_m)
        self.end_row = row_of_depth(model, near_m) if level else model.height_px
        self._tile_m = TILE_M[level]
        # The square is centred on a point ahead of the camera and contains everything visible in the rows.
        self._ahead_m = (near_m + far_m) / 2
        half_width_m = far_m * model.width_px / 2 / model.focal_px * math.hypot(1.0, math.tan(model.pitch_rad))
        reach_m = math.hypot(far_m - self._ahead_m, half_width_m)
        self._tiles_around = math.ceil(reach_m / self._tile_m)
        middle_m = math.sqrt(max(near_m, 2.0) * far_m)
        row_m = middle_m**2 / (model.focal_px * model.z_m)
        self.lines = min(max(round(row_m / (SCALES_M[level] * _TEXELS_A_LINE)), 1), _MAX_LINES)

    @property
    def tiles(self) -> int:
        """The number of tiles along an edge of the square."""
        return 2 * self._tiles_around + 1

    @property
    def picture_from_lines(self) -> FloatArray:
        """The 3 x 3 matrix from (column, line, 1) of the band to picture coordinates."""
        first = self.first_row + 0.5 / self.lines - 0.5
        return np.array([[1.0, 0.0, 0.0], [0.0, 1.0 / self.lines, first], [0.0, 0.0, 1.0]])

    def first_tile(self, placement: CameraPlacement) -> tuple[int, int]:
        """Return the index (x, y) of the square's first tile."""
        x_m = placement.x_m + self._ahead_m * math.cos(placement.heading_rad)
        y_m = placement.y_m + self._ahead_m * math.sin(placement.heading_rad)
        return math.floor(x_m / self._tile_m) - self._tiles_around, math.floor(y_m / self._tile_m) - self._tiles_around

    def texel_from_ground(self, low: tuple[int, int]) -> FloatArray:
        """Return the 3 x 3 matrix from the world's ground to texels of the square whose first tile is `low`."""
        scale_m = SCALES_M[self.level]
        return np.array(
            [
                [1 / scale_m, 0.0, -low[0] * self._tile_m / scale_m - 0.5],
                [0.0, 1 / scale_m, -low[1] * self._tile_m / scale_m - 0.5],
                [0.0, 0.0, 1.0],
            ]
        )


def bands_of(model: CameraModel) -> tuple[Band, ...]:
    """Return all bands of a level camera, nearest first."""
    return tuple(Band(model, level) for level in range(len(SCALES_M)))
