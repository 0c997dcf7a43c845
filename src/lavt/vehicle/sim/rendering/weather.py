"""The weather and the state of the road: water, fog, darkness and worn paint.

A weather changes the surfaces (before they are painted), the air, the light, and the camera's windscreen. The values
come from the sources named here; a value without a source is our choice. None was fitted to a result.
`lavt.vehicle.sim.rendering.weather_optics` has the effects that are applied to a picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from lavt.vehicle.sim.rendering.light import LIGHTS, Light, LightName
from lavt.vehicle.sim.rendering.textures import PERIOD_M, SCALES_M, Grey, seamless_noise

WeatherName = Literal["clear", "wet", "rain", "fog", "night", "worn"]

HAZE_M = 240.0
"""In clear weather, 63 % of an object's colour is haze at this distance."""
HAZE_BEGIN_M = 11.0
"""In clear weather, the ground nearer than this has no haze."""

CONTRAST_AT_VISIBILITY = 3.912
"""-ln 0.02: at the visibility, 2 % of the contrast is left (Koschmieder, 1924)."""
FOG_VISIBILITY_M = 50.0
"""Below this visibility, German law limits the speed to 50 km/h (StVO, section 3)."""

RAIN_MMPH = 25.0
"""Heavy rain."""
DROPS_PER_M3_MM = 8000.0
"""Drops in 1 m3 of air, per mm of diameter, extrapolated to a diameter of 0 (Marshall and Palmer, 1948)."""

WET_ASPHALT = 0.5
"""Wet asphalt reflects about half as diffusely as dry asphalt: light that leaves the surface is partly reflected back
by the water's surface (Lekner and Dorf, Applied Optics 27, 1988)."""
FILM = 0.5
"""The share of a wet road that is smooth water; the rest is grain that stands out of the water."""

PAINT_LUMINANCE_MCD, ASPHALT_LUMINANCE_MCD = 100.0, 15.0
"""The retroreflected luminance R_L in mcd/m2/lx: paint of class R2 of EN 1436, and asphalt (our choice)."""
NOON_PAINT_TO_ASPHALT = 2.15
"""The ratio of the colours of paint and asphalt in the noon sun, in `ground.py` and `textures.py`."""

WORN_PAINT_LEFT = 0.5
"""The share of the area of worn marks that still has paint."""


@dataclass(frozen=True, slots=True)
class Weather:
    """The properties of one weather, of which each default is that of a clear day on a dry road."""

    asphalt: float = 1.0
    """The factor for the colours of asphalt."""
    paint_left: float = 1.0
    """The share of the area of marks that has paint."""
    film: float = 0.0
    """The share of the road that is smooth water."""
    extinction_per_m: float = 0.0
    """The extinction of light by fog or rain."""
    rain_mmph: float = 0.0
    """The rain on the windscreen."""
    headlights: bool = False
    """Whether the car's dipped headlights are the only light."""
    overcast: bool = False
    """Whether the light is `overcast`, whichever light is configured: there is no sun."""

    @property
    def haze_m(self) -> float:
        """The distance at which 63 % of an object's colour is that of the air."""
        return 1 / (self.extinction_per_m + 1 / HAZE_M)

    def light(self, name: LightName) -> Light:
        """Return the light in this weather if the configured light is `name`."""
        return LIGHTS["overcast" if self.overcast else name]


def drop_slope_per_mm(rain_mmph: float) -> float:
    """Return the slope of the exponential distribution of the drops' diameters (Marshall and Palmer, 1948)."""
    return float(4.1 * rain_mmph**-0.21)


def rain_extinction_per_m(rain_mmph: float) -> float:
    """Return the extinction by drops: twice their cross section, because they are much larger than a wavelength."""
    cross_section_mm2 = math.pi / 4 * DROPS_PER_M3_MM * 2 / drop_slope_per_mm(rain_mmph) ** 3
    return 2 * cross_section_mm2 * 1e-6


WEATHERS: dict[WeatherName, Weather] = {
    "clear": Weather(),
    "wet": Weather(asphalt=WET_ASPHALT, film=FILM),
    "rain": Weather(
        asphalt=WET_ASPHALT,
        film=FILM,
        extinction_per_m=rain_extinction_per_m(RAIN_MMPH),
        rain_mmph=RAIN_MMPH,
        overcast=True,
    ),
    "fog": Weather(extinction_per_m=CONTRAST_AT_VISIBILITY / FOG_VISIBILITY_M, overcast=True),
    "night": Weather(
        # Beads in the paint send the headlights' light back, so at night paint differs from asphalt more than by day.
        asphalt=NOON_PAINT_TO_ASPHALT * ASPHALT_LUMINANCE_MCD / PAINT_LUMINANCE_MCD,
        headlights=True,
        overcast=True,
    ),
    "worn": Weather(paint_left=WORN_PAINT_LEFT),
}


@lru_cache(maxsize=2)
def worn_paint(paint_left: float) -> tuple[Grey, ...]:
    """Return a seamless pattern of the paint that is left, 0 to 255, at each scale of `SCALES_M`.

    The pattern consists of patches with sizes between 8 cm and half a metre, which are bare or have all their paint.
    """
    size = round(PERIOD_M / SCALES_M[0])
    patches = sum((seamless_noise("worn paint", size, cells) for cells in (64, 160, 400)), np.zeros((size, size)))
    levels = [np.where(patches > np.quantile(patches, 1 - paint_left), 255, 0).astype(np.uint8)]
    for scale_m in SCALES_M[1:]:
        coarser = round(PERIOD_M / scale_m)
        levels.append(np.asarray(cv2.resize(levels[-1], (coarser, coarser), interpolation=cv2.INTER_AREA), np.uint8))
    return tuple(levels)
