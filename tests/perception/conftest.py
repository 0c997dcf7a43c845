"""Render pictures of roads for the tests: flat grey ground with painted lines, seen by a pinhole camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from lavt.domain import CameraModel, FloatArray, Picture
from lavt.perception.calibration import calibrated_pinhole_camera, ground_to_picture

ROAD_GREY, SKY_GREY = 85, 190
MARK_WIDTH_M = 0.125
RAYS_PER_PIXEL_SIDE = 2


@dataclass(frozen=True)
class Line:
    """A painted line at an offset from the lane's centre."""

    offset_m: float
    colour_bgr: tuple[int, int, int] = (225, 225, 225)
    dash_m: float = 9.0
    """The painted length in each period of 9 m."""
    phase_m: float = 0.0


LANE = (Line(1.75), Line(-1.75))
BROKEN_LANE = (Line(1.75, dash_m=3.0), Line(-1.75, dash_m=3.0, phase_m=4.0))
FOUR_LANES = (Line(8.75), Line(5.25, dash_m=3.0), *BROKEN_LANE, Line(-5.25))


@dataclass(frozen=True)
class Scene:
    """A renderer of a straight or circular road, seen from a car beside the road's centre."""

    model: CameraModel

    def render(
        self,
        lines: Sequence[Line] = LANE,
        curvature_per_m: float = 0.0,
        offset_m: float = 0.0,
        heading_rad: float = 0.0,
    ) -> Picture:
        """Return the picture from a car `offset_m` left of the centre and turned left by `heading_rad`."""
        ray_indices, x_m, y_m = rays_on_near_ground(self.model)
        along, across = on_road(x_m, y_m, curvature_per_m, offset_m, heading_rad)
        colours = bare_ground(self.model).copy()  # one colour per ray; a pixel is the average of several rays
        ray_colours = colours.reshape(-1, 3)
        for line in lines:
            painted = np.flatnonzero(np.abs(across - line.offset_m) < MARK_WIDTH_M / 2)
            painted = painted[np.mod(along[painted] - line.phase_m, 9.0) < line.dash_m]
            ray_colours[ray_indices[painted]] = line.colour_bgr
        picture = cv2.resize(colours, (self.model.width_px, self.model.height_px), interpolation=cv2.INTER_AREA)
        return np.asarray(picture.round(), dtype=np.uint8)


@cache
def ground_of_rays(model: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Return x and y of the ground point that each ray hits; infinite above the horizon."""
    u = (np.arange(model.width_px * RAYS_PER_PIXEL_SIDE) + 0.5) / RAYS_PER_PIXEL_SIDE - 0.5
    v = (np.arange(model.height_px * RAYS_PER_PIXEL_SIDE) + 0.5) / RAYS_PER_PIXEL_SIDE - 0.5
    inverse = np.linalg.inv(ground_to_picture(calibrated_pinhole_camera(model)))
    rays = np.stack([*np.meshgrid(u, v), np.ones((len(v), len(u)))], axis=-1) @ inverse.T
    below = rays[..., 2] > 1e-9  # the inverse's third component is 1 / depth: positive below the horizon
    scale = np.where(below, rays[..., 2], 1.0)
    return np.where(below, rays[..., 0] / scale, np.inf), np.where(below, rays[..., 1] / scale, np.inf)


@cache
def rays_on_near_ground(model: CameraModel) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Return the indices of rays that hit the ground within 120 m, and x and y of their ground points."""
    x_m, y_m = (coordinates.ravel() for coordinates in ground_of_rays(model))
    ray_indices = np.flatnonzero(x_m < 120)
    return ray_indices, x_m[ray_indices], y_m[ray_indices]


@cache
def bare_ground(model: CameraModel) -> NDArray[np.float32]:
    """Return the picture of a road without lines, with one pixel per ray."""
    x_m, _ = ground_of_rays(model)
    colours = np.full((*x_m.shape, 3), SKY_GREY, dtype=np.float32)
    colours[np.isfinite(x_m)] = ROAD_GREY
    return colours


def on_road(
    x_m: FloatArray, y_m: FloatArray, curvature_per_m: float, offset_m: float, heading_rad: float
) -> tuple[FloatArray, FloatArray]:
    """Convert points of the vehicle frame to (distance along the road, distance left of its centre).

    The car is `offset_m` left of the road's centre and turned left by `heading_rad`.
    """
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    x, y = x_m * cosine - y_m * sine, offset_m + x_m * sine + y_m * cosine
    if curvature_per_m == 0:
        return x, y
    radius = 1 / curvature_per_m
    ahead, sideways = x * np.sign(radius), (radius - y) * np.sign(radius)
    return np.arctan2(ahead, sideways) * radius, radius - np.sign(radius) * np.hypot(x, radius - y)


def centre_y_m(x_m: float, curvature_per_m: float) -> float:
    """Return y of the centre of a road that starts along x at the rear axle."""
    if curvature_per_m == 0:
        return 0.0
    radius = 1 / curvature_per_m
    return float(radius - np.sign(radius) * np.sqrt(radius**2 - x_m**2))


@pytest.fixture
def scene() -> Scene:
    return Scene(CameraModel())
