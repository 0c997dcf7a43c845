"""The inverse projection through a lens, from a pixel to the ground, independent of the code under test."""

from __future__ import annotations

import numpy as np

from lavt.domain import FloatArray
from lavt.perception.calibration import RAY_STEPS, CalibratedCamera, _distort, ground_to_camera


def ground_points(camera: CalibratedCamera, pixels: FloatArray) -> FloatArray:
    """Return the ground points (n, 2) in metres of pixels (n, 2) of the distorted picture; NaN above the horizon."""
    rays = np.column_stack([undistort(camera, pixels), np.ones(len(pixels))])
    ground = rays @ np.linalg.inv(ground_to_camera(camera)).T
    # The third component of the inverse is 1 / depth: positive where the ray meets the ground ahead of the camera.
    return np.where(ground[:, 2:] > 1e-9, ground[:, :2] / np.where(ground[:, 2:] > 1e-9, ground[:, 2:], 1.0), np.nan)


def undistort(camera: CalibratedCamera, pixels: FloatArray) -> FloatArray:
    """Invert `_distort` by Newton's method: pixels (n, 2) to points (n, 2) of the plane at depth 1."""
    straight = (pixels - camera.middle_px) / camera.focal_px
    if not camera.distortion:
        return straight
    rays, step = np.zeros_like(straight), 1e-6
    for fraction in np.linspace(1 / RAY_STEPS, 1.0, RAY_STEPS):  # outwards from the axis, to find the inner root
        target = camera.middle_px + fraction * (pixels - camera.middle_px)
        for _ in range(4):
            distorted = _distort(camera, rays)
            (a, c), (b, d) = (((_distort(camera, rays + offset) - distorted) / step).T for offset in np.eye(2) * step)
            u, v = (distorted - target).T
            rays = rays - np.column_stack([d * u - b * v, a * v - c * u]) / (a * d - b * c)[:, None]
    return rays
