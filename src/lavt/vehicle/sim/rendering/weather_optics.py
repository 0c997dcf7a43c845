"""The effects of weather on a picture: reflections in a film of water, headlights, and drops on the windscreen."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import NS_PER_S, CameraModel, FloatArray, Picture
from lavt.streams import stream
from lavt.vehicle.sim.rendering.pinhole import principal_point
from lavt.vehicle.sim.rendering.weather import (
    DROPS_PER_M3_MM,
    PAINT_LUMINANCE_MCD,
    drop_slope_per_mm,
)

WATER_INDEX = 1.333
_GLITTER_PX = (3, 31)
"""The columns and rows over which a film's reflection is blurred, because the water is not quite level."""

LAMPS_AHEAD_M, LAMPS_HEIGHT_M, LAMPS_LEFT_M = 3.8, 0.65, (-0.6, 0.6)
"""The places of the two lamps: ahead of the rear axle, above the ground, and to the left of the car's middle."""
LAMP_DOWN_DEG = (0.57, 0.86, 1.72)
LAMP_CANDELA = (10_100.0, 5_100.0, 2_500.0)
"""The smallest intensities of one lamp that UN Regulation 112 (class B) allows, at angles below the horizontal: test
points 75R and 50V, and zone IV. Between and beyond them, the logarithm is linear in the logarithm of the angle."""
LAMP_FADING_DEG = 10.0
LAMP_EVEN_DEG = 5.15
"""Beside the car's axis the intensity is even up to the edge of zone IV, and then falls by a factor of e with every
10 degrees: from 2,500 cd there to the 1,700 cd of the test points 25L and 25R at 9 degrees."""

REFERENCE_AHEAD_M = 10.0
"""The exposure control gives paint at this distance ahead of the camera its brightness at noon."""
REFERENCE_GREY = 215.0
EXPOSURE_S, F_NUMBER, PIXEL_UM2, ELECTRONS_PER_UM2_LXS = 1 / 30, 2.0, 9.0, 4000.0
"""The camera at night: exposure time, lens, area of a pixel (3 um), and the sensor's response to white light."""

SCREEN_M = 0.1
"""The distance from the camera to the windscreen."""
APERTURE_M = 0.003
"""The diameter of the lens. The lens is focused far away, so a drop is blurred over this size on the windscreen."""
SMALLEST_DROP_MM = 0.5
SPREAD = 2.0
"""A drop on the windscreen is this many times as wide as in the air."""
WIPE_NS = NS_PER_S
"""The period of the wiper, which removes all drops."""
SPEED_TO_SCREEN_MPS = 7.6
"""The speed of drops at right angles to the windscreen: 8.3 m/s of the car at 30 degrees, and 4 m/s of falling."""


def ground_rays(model: CameraModel) -> FloatArray:
    """Return for each pixel of a level camera the ray ahead, left and down in the car's frame, (rows, columns, 3).

    The rays have a depth of 1 along the camera's axis.
    """
    u_px, v_px = principal_point(model)
    columns, rows = np.meshgrid(np.arange(model.width_px) - u_px, np.arange(model.height_px) - v_px)
    cosine, sine = math.cos(model.pitch_rad), math.sin(model.pitch_rad)
    ahead = cosine - rows / model.focal_px * sine
    down = sine + rows / model.focal_px * cosine
    left = -columns / model.focal_px
    yaw_cosine, yaw_sine = math.cos(model.yaw_rad), math.sin(model.yaw_rad)
    return np.stack([ahead * yaw_cosine - left * yaw_sine, ahead * yaw_sine + left * yaw_cosine, down], axis=-1)


def slant_distance_m(model: CameraModel) -> FloatArray:
    """Return for each pixel of a level camera the distance to the ground, (rows, columns); infinite above it."""
    rays = ground_rays(model)
    with np.errstate(divide="ignore"):
        distance_m = model.z_m * np.linalg.norm(rays, axis=-1) / np.maximum(rays[..., 2], 0.0)
    return np.asarray(distance_m)


class WaterFilm:
    """The reflection of the sky in the water on a level road, by Fresnel's equations for light without polarization."""

    def __init__(self, model: CameraModel, film: float) -> None:
        rays = ground_rays(model)
        incidence_cosine = np.clip(rays[..., 2] / np.linalg.norm(rays, axis=-1), 0.0, 1.0)
        self._share = (255.0 * film * fresnel(incidence_cosine) * (rays[..., 2] > 0)).astype(np.float32)
        u_px, v_px = principal_point(model)
        camera = np.array([[model.focal_px, 0.0, u_px], [0.0, model.focal_px, v_px], [0.0, 0.0, 1.0]])
        cosine, sine = math.cos(model.pitch_rad), math.sin(model.pitch_rad)
        level_from_camera = np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]])
        mirror = level_from_camera.T @ np.diag([1.0, -1.0, 1.0]) @ level_from_camera
        self._mirrored_from_picture = camera @ mirror @ np.linalg.inv(camera)

    def reflect(self, canvas: Picture, first_row: int) -> None:
        """Add the reflection to the ground of a canvas (rows, columns, 4) that begins at `first_row`.

        The fourth channel of the ground has the share of asphalt, which alone has a film.
        """
        size = (canvas.shape[1], canvas.shape[0])
        flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
        sky = canvas.copy()
        sky[first_row:] = sky[max(first_row - 1, 0)]
        mirrored = cv2.warpPerspective(
            sky, self._mirrored_from_picture, size, flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        ground = canvas[first_row:]
        reflection = cv2.blur(mirrored, _GLITTER_PX)[first_row:]
        share = cv2.multiply(self._share[first_row:], ground[..., 3].astype(np.float32), scale=1 / 255**2)
        cover = cv2.merge((share, share, share, share))
        mixed = cv2.add(
            cv2.multiply(ground.astype(np.float32), 1.0 - cover), cv2.multiply(reflection.astype(np.float32), cover)
        )
        ground[..., :3] = np.rint(np.asarray(mixed))[..., :3]


def fresnel(incidence_cosine: FloatArray) -> FloatArray:
    """Return the reflectance of water for light without polarization, by the cosine of the angle of incidence."""
    inside_cosine = np.sqrt(1.0 - (1.0 - incidence_cosine**2) / WATER_INDEX**2)
    across = (incidence_cosine - WATER_INDEX * inside_cosine) / (incidence_cosine + WATER_INDEX * inside_cosine)
    along = (inside_cosine - WATER_INDEX * incidence_cosine) / (inside_cosine + WATER_INDEX * incidence_cosine)
    return np.asarray((across**2 + along**2) / 2)


class Headlights:
    """The light of dipped headlights on the ground, and the noise of the long exposure."""

    def __init__(self, model: CameraModel) -> None:
        rays = ground_rays(model)
        down = np.maximum(rays[..., 2:], 1e-6)
        points_m = model.z_m * rays[..., :2] / down + np.array([model.x_m - LAMPS_AHEAD_M, model.y_m])
        lux = np.where(rays[..., 2] > 1e-6, lamp_lux(points_m), 0.0)
        reference_m = model.x_m + REFERENCE_AHEAD_M - LAMPS_AHEAD_M
        self._reference_lux = float(lamp_lux(np.array([reference_m, 0.0])))
        self._factor = np.repeat((lux / self._reference_lux).astype(np.float32)[..., None], 3, axis=2)

    @property
    def grey_per_electron(self) -> float:
        """The grey levels of one electron of a pixel."""
        luminance_cdpm2 = self._reference_lux * PAINT_LUMINANCE_MCD / 1000
        exposure_lxs = math.pi / 4 * luminance_cdpm2 * EXPOSURE_S / F_NUMBER**2
        return REFERENCE_GREY / (exposure_lxs * PIXEL_UM2 * ELECTRONS_PER_UM2_LXS)

    def illuminate(self, picture: Picture) -> Picture:
        """Return a picture of diffuse light in the light of the headlights. Above the horizon, it is dark."""
        return np.asarray(cv2.multiply(picture, self._factor, dtype=cv2.CV_8U), dtype=np.uint8)

    def noise_deviation(self, read_grey: float) -> NDArray[np.float32]:
        """Return the standard deviation of the noise of each grey level, (256,): that of reading, and shot noise.

        It follows the linear camera model of EMVA Standard 1288: the variance grows with the signal.
        """
        return np.asarray(np.sqrt(read_grey**2 + self.grey_per_electron * np.arange(256)), dtype=np.float32)


def lamp_lux(points_m: FloatArray) -> FloatArray:
    """Return the illuminance by both lamps at right angles to their light, at points (..., 2) of the ground.

    The points are those ahead of the lamps and left of the middle between them. Behind the lamps it is 0.
    """
    lamps = [_one_lamp_lux(points_m[..., 0], points_m[..., 1] - left_m) for left_m in LAMPS_LEFT_M]
    return np.asarray(sum(lamps, np.zeros(points_m.shape[:-1])))


def _one_lamp_lux(ahead_m: FloatArray, left_m: FloatArray) -> FloatArray:
    flat_m = np.maximum(np.hypot(ahead_m, left_m), 1e-3)
    down_deg = np.degrees(np.arctan2(LAMPS_HEIGHT_M, flat_m))
    aside_deg = np.degrees(np.abs(np.arctan2(left_m, ahead_m)))
    logs, angles = np.log(LAMP_CANDELA), np.log(LAMP_DOWN_DEG)
    slope = (logs[-1] - logs[-2]) / (angles[-1] - angles[-2])
    below = logs[-1] + slope * (np.log(down_deg) - angles[-1])
    candela = np.exp(np.where(down_deg > LAMP_DOWN_DEG[-1], below, np.interp(np.log(down_deg), angles, logs)))
    candela = np.where(down_deg < LAMP_DOWN_DEG[0], 0.0, candela)  # above the cut-off
    candela = candela * np.exp(-np.maximum(aside_deg - LAMP_EVEN_DEG, 0.0) / LAMP_FADING_DEG)
    return np.asarray(np.where(ahead_m > 0, candela / (flat_m**2 + LAMPS_HEIGHT_M**2), 0.0))


class Windscreen:
    """Drops on the windscreen, from the run's seed: they collect until the wiper removes them."""

    def __init__(self, model: CameraModel, rain_mmph: float, seed: int) -> None:
        self._model, self._seed, self._slope_per_mm = model, seed, drop_slope_per_mm(rain_mmph)
        self._px_per_m = model.focal_px / SCREEN_M
        area_m2 = model.width_px * model.height_px / self._px_per_m**2
        drops_per_m3 = DROPS_PER_M3_MM / self._slope_per_mm * math.exp(-self._slope_per_mm * SMALLEST_DROP_MM)
        self.mean_drops = drops_per_m3 * SPEED_TO_SCREEN_MPS * area_m2 * WIPE_NS / NS_PER_S
        """The mean number of drops that one stroke of the wiper removes."""
        blur_px = max(round(APERTURE_M * self._px_per_m), 1) | 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (blur_px, blur_px)).astype(np.float32)
        self._aperture = disc / disc.sum()

    def add_drops(self, picture: Picture, at_ns: int) -> Picture:
        """Return the picture through the drops that are on the windscreen at a time.

        A drop is a strong lens, which shows a wide part of the scene; out of focus, this is the picture's mean colour.
        """
        covered = self.cover(at_ns)
        cover = cv2.merge((covered, covered, covered))
        mean = np.empty_like(picture)
        mean[:] = np.rint(cv2.mean(picture)[:3])
        kept = cv2.multiply(picture, cv2.bitwise_not(cover), scale=1 / 255)
        return np.asarray(cv2.add(kept, cv2.multiply(mean, cover, scale=1 / 255)), dtype=np.uint8)

    def cover(self, at_ns: int) -> NDArray[np.uint8]:
        """Return for each pixel the share of the lens that drops cover at a time, 0 to 255."""
        stroke, since_ns = divmod(at_ns, WIPE_NS)
        random = stream(self._seed, "drops on the windscreen", stroke)
        count = int(random.poisson(self.mean_drops))
        arrival_ns = random.uniform(0, WIPE_NS, count)
        u_px, v_px = random.uniform(0, self._model.width_px, count), random.uniform(0, self._model.height_px, count)
        width_mm = SPREAD * (SMALLEST_DROP_MM + random.exponential(1 / self._slope_per_mm, count))
        radius_px = width_mm / 2000 * self._px_per_m
        drops = np.zeros((self._model.height_px, self._model.width_px), dtype=np.uint8)
        present = arrival_ns <= since_ns
        bits = 4
        shapes = np.rint(np.column_stack([u_px, v_px, radius_px])[present] * (1 << bits)).astype(int).tolist()
        for u, v, radius in shapes:
            cv2.circle(drops, (u, v), radius, 255, cv2.FILLED, cv2.LINE_AA, bits)
        return np.asarray(cv2.filter2D(drops, -1, self._aperture), dtype=np.uint8)
