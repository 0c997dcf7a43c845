"""Textures of the simulated world: seamless patterns of asphalt, grass, gravel and worn paint.

A pattern repeats every `PERIOD_M` and is anchored to the world frame. It is generated once at the finest scale. Texels
of a coarser scale are means of texels of the next finer scale, so the brightness is equal in all bands of the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import FloatArray, Picture
from lavt.streams import stream

PERIOD_M = 32.0
SCALES_M = (0.02, 0.04, 0.08, 0.16, 0.32)
"""Metres per texel, finest first."""

Grey = NDArray[np.uint8]
Field = NDArray[np.float32]

_WORLD_SEED = 0
"""The world is the same in every run. A run's seed changes only the sensor noise of its pictures."""


@dataclass(frozen=True, slots=True)
class Textures:
    """One period of each pattern at one scale."""

    asphalt: Grey
    grass: Picture
    gravel: Picture
    wear: Grey
    """The share of a mark's paint that wear has left, 0 to 255."""


@lru_cache(maxsize=1)
def all_textures() -> tuple[Textures, ...]:
    """Return the patterns at each scale of `SCALES_M`; the first call takes about half a second."""
    finest = _make_finest()
    levels = [finest]
    for scale_m in SCALES_M[1:]:
        size = round(PERIOD_M / scale_m)
        last = levels[-1]
        patterns = (_reduce(pattern, size) for pattern in (last.asphalt, last.grass, last.gravel, last.wear))
        levels.append(Textures(*patterns))
    return tuple(levels)


def _reduce(image: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def seamless_noise(name: str, size: int, cells: int) -> Field:
    """Return a smooth periodic random field (size x size, mean 0, deviation 1) with `cells` x `cells` random values.

    The values between them are interpolated.
    """
    coarse = stream(_WORLD_SEED, name, cells).standard_normal((cells, cells))
    border = 4
    padded = np.pad(coarse, border, mode="wrap").astype(np.float32)
    scale = size / cells
    # As in cv2.resize, texel i is interpolated at (i + 0.5) / scale - 0.5 of the coarse field, here behind the border.
    index = ((np.arange(size) + 0.5) / scale - 0.5 + border).astype(np.float32)
    columns, rows = np.meshgrid(index, index)
    field = np.asarray(cv2.remap(padded, columns, rows, cv2.INTER_CUBIC), dtype=np.float32)
    field -= field.mean()
    field /= field.std()
    return field


def _make_finest() -> Textures:
    size = round(PERIOD_M / SCALES_M[0])
    grain = stream(_WORLD_SEED, "grain").standard_normal((size, size), dtype=np.float32)
    stones = seamless_noise("stones", size, size // 3)
    patches = seamless_noise("patches", size, 40) + 0.8 * seamless_noise("patches", size, 12)
    asphalt = 100 + 9.0 * grain + 4.0 * stones + 1.2 * patches
    blades = seamless_noise("blades", size, size // 2)
    tufts = seamless_noise("tufts", size, 200) + seamless_noise("tufts", size, 64)
    meadow = seamless_noise("meadow", size, 9)
    brightness = 1.0 + 0.10 * blades + 0.07 * tufts + 0.06 * meadow
    dry = 0.5 + 0.22 * seamless_noise("dry", size, 24)
    grass = np.stack([46 + 18 * dry, 96 + 12 * dry, 78 + 44 * dry], axis=-1)
    grass *= brightness[..., None]
    pebbles = 1.0 + 0.07 * stones + 0.10 * grain + 0.04 * tufts
    gravel = np.array([98, 112, 122], dtype=np.float32) * pebbles[..., None]
    chips = 0.9 * stones + 0.6 * grain + 1.3 * seamless_noise("chips", size, 160)
    wear = 204 + 32 * np.clip(-0.9 - 0.75 * chips, -4.4, 0.5) + 11 * patches
    return Textures(_bytes(np.maximum(asphalt, 30)), _bytes(grass), _bytes(gravel), _bytes(wear))


def _bytes(values: Field | FloatArray) -> NDArray[np.uint8]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
