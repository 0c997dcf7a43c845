"""The lighting of a road: the sun's position, and the colours of sunlight, shade, sky and haze.

Surfaces are defined by their colours in the noon sun. A light multiplies these colours by one factor in the sun and by
another factor in the shade. The factors contain the effect of a camera's exposure control, so an overcast day is not
much darker than a sunny day. All values are our choice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lavt.domain import FloatArray

LightName = Literal["noon", "low_sun", "overcast"]

Colour = tuple[float, float, float]
"""Blue, green, red: values between 0 and 255 for a visible colour, factors for light."""


@dataclass(frozen=True, slots=True)
class Light:
    """The light of one weather and time of day."""

    azimuth_rad: float
    """The sun's azimuth in the world frame, from the x axis towards the y axis."""
    elevation_rad: float
    """The sun's elevation."""
    lit: Colour
    """The factor for level ground in the sun."""
    shade: Colour
    """The factor for level ground in the shade."""
    zenith: Colour
    """The colour of the sky at the zenith."""
    haze: Colour
    """The colour of the sky at the horizon and of everything far away."""
    glow: Colour
    """The colour added to the sky around the sun."""
    cloud: Colour
    cloud_cover: float
    """The approximate share of the sky that clouds cover."""
    shadows: bool
    """Whether the sun casts shadows."""
    clouds_shade: bool
    """Whether clouds cast shadows on the ground around the road."""

    @property
    def towards_sun(self) -> FloatArray:
        """The unit vector (3,) towards the sun."""
        flat = math.cos(self.elevation_rad)
        return np.array(
            [flat * math.cos(self.azimuth_rad), flat * math.sin(self.azimuth_rad), math.sin(self.elevation_rad)]
        )

    @property
    def shadow_per_height(self) -> FloatArray:
        """The vector (2,) from the foot of a pole to the shadow of its top, divided by the height of the pole."""
        towards = self.towards_sun
        return np.asarray(-towards[:2] / towards[2])

    def upright_factors(self, normals: FloatArray) -> FloatArray:
        """Return factors (n, 3) for upright faces with horizontal unit normals (n, 2).

        Faces turned away from the sun are in the shade.
        """
        lit, shade = np.array(self.lit), np.array(self.shade)
        if not self.shadows:
            return np.broadcast_to(lit, (len(normals), 3))
        # Sunlight on a face is proportional to the cosine of the angle between its normal and the sun, and sunlight on
        # the ground to the sine of the sun's elevation. `facing` is the ratio of the two. It is limited, because a
        # camera's response curve makes bright surfaces less different.
        facing = np.clip(normals @ self.towards_sun[:2], 0.0, None) / max(math.sin(self.elevation_rad), 0.5)
        return np.asarray(shade + (lit - shade) * np.minimum(facing + 0.15, 1.5)[:, None])


LIGHTS: dict[LightName, Light] = {
    "noon": Light(
        azimuth_rad=math.radians(40.0),
        elevation_rad=math.radians(56.0),
        lit=(1.0, 1.0, 1.0),
        shade=(0.55, 0.47, 0.42),
        zenith=(208.0, 142.0, 78.0),
        haze=(226.0, 214.0, 200.0),
        glow=(20.0, 26.0, 30.0),
        cloud=(250.0, 247.0, 245.0),
        cloud_cover=0.36,
        shadows=True,
        clouds_shade=True,
    ),
    "low_sun": Light(
        azimuth_rad=math.radians(112.0),
        elevation_rad=math.radians(10.0),
        lit=(0.68, 0.84, 1.0),
        shade=(0.43, 0.40, 0.38),
        zenith=(176.0, 128.0, 92.0),
        haze=(158.0, 180.0, 214.0),
        glow=(30.0, 70.0, 92.0),
        cloud=(168.0, 186.0, 226.0),
        cloud_cover=0.30,
        shadows=True,
        clouds_shade=False,
    ),
    "overcast": Light(
        azimuth_rad=0.0,
        elevation_rad=math.radians(60.0),
        lit=(0.94, 0.91, 0.88),
        shade=(0.94, 0.91, 0.88),
        zenith=(204.0, 199.0, 194.0),
        haze=(214.0, 210.0, 205.0),
        glow=(0.0, 0.0, 0.0),
        cloud=(186.0, 181.0, 176.0),
        cloud_cover=0.75,
        shadows=False,
        clouds_shade=False,
    ),
}
