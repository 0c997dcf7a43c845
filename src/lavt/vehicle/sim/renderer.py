"""Pictures of a road for a camera on a car, made on the CPU.

The ground is warped from tiles seen from above, in three bands of rows, finer ones nearer (a clipmap); sky and hills
are cut from a panorama; what stands upright is drawn from far to near; the sensor adds its noise. A frame depends on
the pose, the frame's number and the seed alone: equal to the byte for equal versions and processor features.
"""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np

from lavt.domain import CameraModel, FloatArray, Picture, Pose
from lavt.streams import stream
from lavt.vehicle.sim.ground import TILE_M, Ground
from lavt.vehicle.sim.panorama import HAZE, Panorama
from lavt.vehicle.sim.pinhole import View, row_of_depth, view_from
from lavt.vehicle.sim.road import Road
from lavt.vehicle.sim.scenery import Scenery
from lavt.vehicle.sim.textures import SCALES_M

SceneryKind = Literal["full", "light", "none"]
"""full: everything; light: no trees, lamp posts, buildings and clouds; none: no rails either."""

BAND_FAR_M = (12.0, 30.0, 160.0)
"""How far ahead of the camera each scale of the ground serves."""

_NOISE_DEVIATION = 2.2
_NOISE_MARGIN_PX = 64
_HAZE_M = 240.0


class Renderer:
    """Draws one road for one camera model."""

    def __init__(self, road: Road, model: CameraModel, *, seed: int, scenery: SceneryKind) -> None:
        cv2.setNumThreads(1)  # with more the split of the work, and with it the last bit, may change
        self._road, self._model, self._seed = road, model, seed
        self._ground = Ground(road)
        self._bands = _bands(model)
        sky_rows = self._bands[-1].first_row
        self._panorama = Panorama(model, sky_rows, plain=scenery != "full")
        self._scenery = None if scenery == "none" else Scenery(road, trees=scenery == "full")
        self._windows: list[tuple[tuple[int, int], Picture] | None] = [None] * len(self._bands)
        self._noise = _noise(model)

    def prepare(self) -> None:
        """Look along the route beforehand, so that no frame has to wait for the ground to be painted."""
        for s_m in np.arange(0.0, self._road.length_m + 10.0, 4.0):
            x_m, y_m, heading_rad, _ = (float(value) for value in self._road.point(s_m))
            self.render(Pose(0, x_m, y_m, heading_rad), 0)

    def render(self, pose: Pose, number: int) -> Picture:
        """Draw frame `number` as seen by a vehicle at `pose`; a new array each time."""
        model = self._model
        picture = np.empty((model.height_px, model.width_px, 3), dtype=np.uint8)
        view = view_from(model, pose)
        self._panorama.cut(view.heading_rad, picture[: self._bands[-1].first_row])
        homography = view.ground_from_picture()
        for level, band in enumerate(self._bands):
            self._warp(level, band, view, homography, picture)
        self._add_haze(picture)
        if self._scenery is not None:
            self._scenery.draw(view, picture)
        self._add_noise(picture, number)
        return picture

    def _warp(self, level: int, band: Band, view: View, homography: FloatArray, picture: Picture) -> None:
        rows = picture[band.first_row : band.end_row]
        if not len(rows):
            return
        low = band.low_tile(view)
        scale_m, tile_m = SCALES_M[level], TILE_M[level]
        texel_from_ground = np.array(
            [
                [1 / scale_m, 0, -low[0] * tile_m / scale_m - 0.5],
                [0, 1 / scale_m, -low[1] * tile_m / scale_m - 0.5],
                [0, 0, 1],
            ]
        )
        picture_from_band = np.array([[1.0, 0, 0], [0, 1, band.first_row], [0, 0, 1]])
        matrix = texel_from_ground @ homography @ picture_from_band
        flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
        window = self._window(level, low)
        cv2.warpPerspective(window, matrix, (rows.shape[1], rows.shape[0]), rows, flags, cv2.BORDER_REPLICATE)

    def _window(self, level: int, low: tuple[int, int]) -> Picture:
        held = self._windows[level]
        if held is None or held[0] != low:
            held = (low, self._ground.window(level, low, self._bands[level].tiles))
            self._windows[level] = held
        return held[1]

    def _add_haze(self, picture: Picture) -> None:
        band = self._bands[-1]
        rows = picture[band.first_row : band.end_row]
        depth_m = self._model.z_m / np.maximum(np.tan(_row_angles(self._model)[band.first_row : band.end_row]), 1e-6)
        share = (1.0 - np.exp(-depth_m / _HAZE_M))[:, None, None]
        rows[:] = (rows * (1 - share) + np.array(HAZE) * share + 0.5).astype(np.uint8)

    def _add_noise(self, picture: Picture, number: int) -> None:
        down, right = stream(self._seed, "sensor noise", number).integers(0, _NOISE_MARGIN_PX, 2).tolist()
        part = np.s_[down : down + self._model.height_px, right : right + self._model.width_px]
        cv2.add(picture, self._noise[0][part], picture)
        cv2.subtract(picture, self._noise[1][part], picture)


class Band:
    """The rows of the picture that one scale of the ground serves, and the square of tiles that they see."""

    def __init__(self, model: CameraModel, level: int) -> None:
        far_m = BAND_FAR_M[level]
        near_m = BAND_FAR_M[level - 1] if level else 0.0
        self.first_row = row_of_depth(model, far_m)
        self.end_row = row_of_depth(model, near_m) if level else model.height_px
        self._tile_m = TILE_M[level]
        # The square is laid around a point ahead of the camera, from which everything in the rows is within reach.
        self._ahead_m = (near_m + far_m) / 2
        beside_m = far_m * model.width_px / 2 / model.focal_px * math.hypot(1.0, math.tan(model.pitch_rad))
        reach_m = math.hypot(far_m - self._ahead_m, beside_m)
        self._around = math.ceil(reach_m / self._tile_m)

    @property
    def tiles(self) -> int:
        """How many tiles an edge of the square has."""
        return 2 * self._around + 1

    def low_tile(self, view: View) -> tuple[int, int]:
        """Index (x, y) of the square's first tile."""
        x_m = view.x_m + self._ahead_m * math.cos(view.heading_rad)
        y_m = view.y_m + self._ahead_m * math.sin(view.heading_rad)
        return math.floor(x_m / self._tile_m) - self._around, math.floor(y_m / self._tile_m) - self._around


def _bands(model: CameraModel) -> tuple[Band, ...]:
    return tuple(Band(model, level) for level in range(len(SCALES_M)))


def _row_angles(model: CameraModel) -> FloatArray:
    """Angle below the horizon at which each row of the picture looks, in its middle."""
    rows = np.arange(model.height_px) - (model.height_px - 1) / 2
    return np.asarray(np.arctan(rows / model.focal_px) + model.pitch_rad)


def _noise(model: CameraModel) -> tuple[Picture, Picture]:
    """Make what the sensor adds and what it takes away, larger than a picture; a frame gets a part of it."""
    size = (model.height_px + _NOISE_MARGIN_PX, model.width_px + _NOISE_MARGIN_PX, 3)
    noise = np.rint(stream(0, "sensor noise bank").standard_normal(size) * _NOISE_DEVIATION)
    return np.clip(noise, 0, 255).astype(np.uint8), np.clip(-noise, 0, 255).astype(np.uint8)
