"""What lies beyond the ground that is drawn: sky, clouds, hills and a wood, as one picture of the whole horizon."""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np

from lavt.domain import CameraModel, FloatArray, Picture
from lavt.streams import stream
from lavt.vehicle.sim.pinhole import horizon_row, principal_point
from lavt.vehicle.sim.textures import seamless_noise

HAZE = (222.0, 212.0, 200.0)
_ZENITH = (214.0, 158.0, 96.0)
_COLUMNS = 4096
_WORLD_SEED = 0


class Panorama:
    """The horizon for one camera model; a picture of it is a choice of columns."""

    def __init__(self, model: CameraModel, rows: int, *, plain: bool) -> None:
        painted = _painted(rows, horizon_row(model), model.focal_px, plain=plain)
        # Turned on its side, so that a column of the picture lies in one piece of memory.
        self._columns = np.ascontiguousarray(painted.transpose(1, 0, 2))
        across_px = np.arange(model.width_px) - principal_point(model)[0]
        self._azimuth_rad = np.arctan2(across_px, model.focal_px)

    def cut(self, heading_rad: float, out: Picture) -> None:
        """Write what a camera with this heading sees into `out`, the first rows of its picture."""
        turn = (self._azimuth_rad - heading_rad) / (2 * math.pi)
        columns = np.rint((turn - np.floor(turn)) * _COLUMNS).astype(np.intp) % _COLUMNS
        cv2.transpose(self._columns[columns], out)


@lru_cache(maxsize=4)
def _painted(rows: int, horizon: float, focal_px: float, *, plain: bool) -> Picture:
    # Height above the horizon as a share of the focal length, for each row.
    height = np.asarray((horizon - np.arange(rows)) / focal_px, dtype=np.float64)[:, None]
    rise = np.clip(height / 0.75, 0.0, 1.0) ** 0.6
    sky = np.array(HAZE) * (1 - rise[..., None]) + np.array(_ZENITH) * rise[..., None]
    picture = np.broadcast_to(sky, (rows, _COLUMNS, 3)).copy()
    if not plain:
        _add_clouds(picture, height)
        turn = np.arange(_COLUMNS) / _COLUMNS * 2 * math.pi
        _add_ridge(picture, height, 0.062 + 0.022 * np.sin(3 * turn) + 0.015 * np.sin(7 * turn + 1), (186, 172, 150))
        _add_ridge(picture, height, 0.036 + 0.012 * np.sin(5 * turn + 2) + 0.008 * np.sin(13 * turn), (152, 152, 128))
    _add_ridge(picture, height, 0.020 + 0.0035 * _crowns(), (112, 122, 104))
    return np.asarray(np.clip(picture, 0, 255), dtype=np.uint8)


def _add_ridge(picture: FloatArray, height: FloatArray, ridge: FloatArray, colour: tuple[int, int, int]) -> None:
    cover = np.clip((ridge[None, :] - height) / 0.004, 0.0, 1.0)[..., None]
    picture *= 1 - cover
    picture += cover * np.array(colour)


def _add_clouds(picture: FloatArray, height: FloatArray) -> None:
    octaves = ((14, 1.0), (30, 0.6), (70, 0.4), (160, 0.22))
    noise = sum((share * seamless_noise("clouds", 1024, cells) for cells, share in octaves), np.zeros((1024, 1024)))
    # Clouds lie in layers: seen flatter and smaller towards the horizon.
    layer = 60.0 / np.maximum(height, 0.06)
    rows = np.rint(layer).astype(np.intp) % 1024
    columns = np.arange(_COLUMNS)[None, :] * 1024 // _COLUMNS
    cover = np.clip((noise[rows, columns] - 0.35) * 0.55, 0.0, 0.8) * np.clip((height - 0.05) / 0.15, 0.0, 1.0)
    picture *= 1 - cover[..., None]
    picture += cover[..., None] * np.array([246.0, 244.0, 242.0])


def _crowns() -> FloatArray:
    """Outline of a distant wood, one value for each column."""
    steps = stream(_WORLD_SEED, "wood").standard_normal(_COLUMNS)
    kernel = np.hanning(9)
    smooth = np.convolve(np.concatenate([steps[-8:], steps, steps[:8]]), kernel / kernel.sum(), mode="same")
    return np.asarray(2.0 * smooth[8:-8], dtype=np.float64)
