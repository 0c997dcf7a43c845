"""The panorama beyond the drawn ground: one picture of the whole horizon with sky, sun, clouds, hills and a wood."""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import CameraModel, FloatArray, Picture
from lavt.streams import stream
from lavt.vehicle.sim.rendering.light import Colour, Light
from lavt.vehicle.sim.rendering.pinhole import horizon_row, principal_point
from lavt.vehicle.sim.rendering.textures import seamless_noise

_COLUMNS = 4096
_WORLD_SEED = 0
_SUN_RAD = 0.011
"""Radius of the white disc in the sky: the sun and its overexposed surroundings."""

_RIDGES = (
    (0.062, ((0.022, 3, 0.0), (0.015, 7, 1.0)), (186.0, 172.0, 150.0), 0.62),
    (0.036, ((0.012, 5, 2.0), (0.008, 13, 0.0)), (152.0, 152.0, 128.0), 0.42),
)
"""Rows of hills: mean height, waves (height, number around the horizon, phase), colour at noon, share of haze. Heights
are shares of the focal length."""
_WOOD_COLOUR = (112.0, 122.0, 104.0)


class Panorama:
    """The panorama for one camera model; a picture's background consists of columns of the panorama."""

    def __init__(self, model: CameraModel, rows: int, light: Light, *, plain: bool) -> None:
        self._columns = np.empty((model.width_px, rows), dtype=np.int32)
        self._texels = _paint(rows, horizon_row(model), model.focal_px, light, plain=plain)
        across_px = np.arange(model.width_px) - principal_point(model)[0]
        self._azimuth_rad = np.arctan2(across_px, model.focal_px)

    def crop(self, heading_rad: float, out: Picture) -> None:
        """Write the background for a camera heading into `out` (rows, columns, 4), the first rows of the picture."""
        if not len(out):  # a camera that looks down
            return
        turn = (self._azimuth_rad - heading_rad) / (2 * math.pi)
        columns = np.rint((turn - np.floor(turn)) * _COLUMNS).astype(np.intp) % _COLUMNS
        # Taking columns from a transposed panorama and transposing them takes half the time of taking them from rows.
        np.take(self._texels, columns, axis=0, out=self._columns, mode="clip")
        cv2.transpose(self._columns, out.view(np.int32)[..., 0])


@lru_cache(maxsize=6)
def _paint(rows: int, horizon: float, focal_px: float, light: Light, *, plain: bool) -> NDArray[np.int32]:
    """Return the transposed panorama (columns, rows); a texel is a word of blue, green, red and an unused byte."""
    # The height of each row above the horizon, as a share of the focal length.
    height = np.asarray((horizon - np.arange(rows)) / focal_px, dtype=np.float64)[:, None]
    # A column shows the azimuth -turn: azimuths increase to the left, and columns to the right.
    turn = np.arange(_COLUMNS) / _COLUMNS * 2 * math.pi
    rise = np.clip(height / 0.75, 0.0, 1.0) ** 0.6
    sky = np.array(light.haze) * (1 - rise[..., None]) + np.array(light.zenith) * rise[..., None]
    picture = np.broadcast_to(sky, (rows, _COLUMNS, 3)).copy()
    away_rad = _angle_to_sun_rad(light, np.arctan(height), -turn)
    picture += np.exp(-away_rad / 0.35)[..., None] * np.array(light.glow)
    if not plain:
        _add_clouds(picture, height, light)
        if light.shadows:
            _add_sun(picture, away_rad)
        for mean, waves, colour, haze in _RIDGES:
            ridge = mean + sum((wave * np.sin(count * turn + phase) for wave, count, phase in waves), np.zeros(1))
            _add_ridge(picture, height, ridge, _hazed_colour(colour, light, haze))
    _add_ridge(picture, height, 0.020 + 0.0035 * _wood_outline(), _hazed_colour(_WOOD_COLOUR, light, 0.2))
    words = np.zeros((rows, _COLUMNS, 4), dtype=np.uint8)
    words[..., :3] = np.clip(np.rint(picture), 0, 255)
    return np.ascontiguousarray(words.view(np.int32)[..., 0].T)


def _angle_to_sun_rad(light: Light, elevation_rad: FloatArray, azimuth_rad: FloatArray) -> FloatArray:
    """Return the angle between the sun and each direction, given by elevation and azimuth."""
    cosine = np.sin(elevation_rad) * math.sin(light.elevation_rad)
    cosine = cosine + np.cos(elevation_rad) * math.cos(light.elevation_rad) * np.cos(azimuth_rad - light.azimuth_rad)
    angle_rad: FloatArray = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle_rad


def _hazed_colour(colour: Colour, light: Light, haze: float) -> FloatArray:
    """Return the colour in this light of a distant object; `colour` is that at noon, and `haze` the share of haze."""
    near, far = np.array(colour) * np.array(light.lit), np.array(light.haze) * 0.85
    return np.asarray(near * (1 - haze) + far * haze)


def _add_sun(picture: FloatArray, away_rad: FloatArray) -> None:
    cover = np.clip(1.5 - away_rad / _SUN_RAD / 2, 0.0, 1.0)[..., None] + 0.55 * np.exp(-away_rad / 0.05)[..., None]
    cover = np.minimum(cover, 1.0)
    picture *= 1 - cover
    picture += cover * np.array([246.0, 252.0, 255.0])


def _add_ridge(picture: FloatArray, height: FloatArray, ridge: FloatArray, colour: FloatArray) -> None:
    cover = np.clip((ridge[None, :] - height) / 0.004, 0.0, 1.0)[..., None]
    picture *= 1 - cover
    picture += cover * colour


def _add_clouds(picture: FloatArray, height: FloatArray, light: Light) -> None:
    octaves = ((14, 1.0), (30, 0.6), (70, 0.4), (160, 0.22), (330, 0.12))
    noise = sum((share * seamless_noise("clouds", 1024, cells) for cells, share in octaves), np.zeros((1024, 1024)))
    # Clouds are a flat layer: a point of the sky shows the place where the line of sight intersects the layer.
    distance = np.minimum(1.0 / np.maximum(height, 0.02), 14.0) * 62.0
    turn = np.arange(_COLUMNS)[None, :] / _COLUMNS * 2 * math.pi
    rows = np.rint(512 + distance * np.sin(turn)).astype(np.intp) % 1024
    columns = np.rint(512 + distance * np.cos(turn)).astype(np.intp) % 1024
    threshold = 1.9 * (0.5 - light.cloud_cover)
    thickness = np.clip((noise[rows, columns] - threshold) * 0.45, 0.0, 2.0)
    fading = np.clip((height - 0.04) / 0.12, 0.0, 1.0)
    cover = (0.92 * (1.0 - np.exp(-2.2 * thickness)) * fading)[..., None]
    picture *= 1 - cover
    # The thick parts of a cloud are uneven, and darker than its edges.
    lumps = 0.05 * noise[(rows + 37) % 1024, (columns + 91) % 1024]
    picture += cover * np.array(light.cloud) * np.clip(1.0 - 0.13 * thickness + lumps, 0.7, 1.06)[..., None]


def _wood_outline() -> FloatArray:
    """Return the outline of a distant wood: a value for each column."""
    steps = stream(_WORLD_SEED, "wood").standard_normal(_COLUMNS)
    kernel = np.hanning(9)
    smooth = np.convolve(np.concatenate([steps[-8:], steps, steps[:8]]), kernel / kernel.sum(), mode="same")
    return np.asarray(2.0 * smooth[8:-8], dtype=np.float64)
