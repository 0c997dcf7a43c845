"""A camera as its calibration knows it: where a point of the ground is in its picture, through any lens OpenCV knows.

Ground coordinates are the vehicle's frame: x ahead of the rear axle, y left, in metres. Pixel coordinates are those of
OpenCV: the middle of the top left pixel is (0, 0). The lens models are OpenCV's, with its order of coefficients:
k1, k2, p1, p2, k3 (`cv2.calibrateCamera`), or k1 to k4 of the fisheye model (`cv2.fisheye.calibrate`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import CameraModel, FloatArray

REFERENCE_FOCAL_PX = 320.0
"""Of the camera for which sizes in pixels are given here: 640 columns over 90 degrees."""

RAY_STEPS = 8
"""Steps from the lens's axis to a ray in which the picture must go outwards all the way.

A polynomial of distortion turns back at some angle and puts what lies beyond, which the lens does not see, into the
picture once more.
"""


@dataclass(frozen=True, slots=True)
class CalibratedCamera:
    """A camera with its lens and its place on the vehicle.

    `yaw_rad` is left positive, `pitch_rad` down positive, `roll_rad` positive with the right side down; the
    vehicle's axes are turned by yaw, then pitch, then roll. `distortion` is empty for a lens without any.
    """

    width_px: int
    height_px: int
    focal_px: tuple[float, float]
    """Along the columns' direction (fx) and along the rows' (fy)."""
    middle_px: tuple[float, float]
    """Where the lens's axis meets the picture (cx, cy)."""
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    @property
    def camera_matrix(self) -> FloatArray:
        """The 3 x 3 camera matrix."""
        (fx, fy), (cx, cy) = self.focal_px, self.middle_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def scale(self) -> float:
        """How much larger things are in this camera's picture than in that of the reference."""
        return self.focal_px[0] / REFERENCE_FOCAL_PX


def calibrated(model: CameraModel) -> CalibratedCamera:
    """Give the pinhole camera of a config as a calibrated one: square pixels, axis in the middle, no distortion."""
    return CalibratedCamera(
        width_px=model.width_px,
        height_px=model.height_px,
        focal_px=(model.focal_px, model.focal_px),
        middle_px=((model.width_px - 1) / 2, (model.height_px - 1) / 2),
        x_m=model.x_m,
        y_m=model.y_m,
        z_m=model.z_m,
        yaw_rad=model.yaw_rad,
        pitch_rad=model.pitch_rad,
        roll_rad=model.roll_rad,
    )


def axes(camera: CalibratedCamera) -> FloatArray:
    """Give the camera's axes in the vehicle's frame, (3, 3): rows to the right, down, and deep."""
    yaw, pitch, roll = camera.yaw_rad, camera.pitch_rad, camera.roll_rad
    ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    forward, down = (
        math.cos(pitch) * ahead + math.sin(pitch) * down,
        math.cos(pitch) * down - math.sin(pitch) * ahead,
    )
    right, down = math.cos(roll) * right + math.sin(roll) * down, math.cos(roll) * down - math.sin(roll) * right
    return np.stack([right, down, forward])


def ground_to_camera(camera: CalibratedCamera) -> FloatArray:
    """Give the 3 x 3 map from ground (x, y, 1) to the camera's frame (right, down, deep), in metres."""
    turn = axes(camera)
    return np.column_stack([turn[:, 0], turn[:, 1], -turn @ np.array([camera.x_m, camera.y_m, camera.z_m])])


def ground_to_picture(camera: CalibratedCamera) -> FloatArray:
    """Give the 3 x 3 homography from ground (x, y, 1) to the picture (u, v, 1) without distortion, up to scale.

    The third component is the depth along the camera's axis; a point with none is not in the picture.
    """
    return np.asarray(camera.camera_matrix @ ground_to_camera(camera), dtype=np.float64)


def picture_points(camera: CalibratedCamera, ground_m: FloatArray) -> FloatArray:
    """Tell where in the distorted picture the ground points (n, 2) are seen: (n, 2) in pixels.

    NaN for what is behind the camera or so far aside that the lens model does not speak of it; other points may lie
    outside the picture.
    """
    seen = np.column_stack([ground_m, np.ones(len(ground_m))]) @ ground_to_camera(camera).T
    ahead = seen[:, 2] > 1e-6
    rays = seen[:, :2] / np.where(ahead, seen[:, 2], 1.0)[:, None]
    pixels = _distort(camera, rays)
    pixels[~(ahead & _in_lens_field(camera, rays))] = np.nan
    return pixels


def _distort(camera: CalibratedCamera, rays: FloatArray) -> FloatArray:
    """Send rays, as points of the plane one deep (n, 2), through the lens: pixels (n, 2)."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.middle_px
    if not camera.distortion:
        return rays * (fx, fy) + (cx, cy)
    factors = np.array(camera.distortion)
    if camera.fisheye:
        return np.asarray(cv2.fisheye.distortPoints(rays[:, None], camera.camera_matrix, factors), dtype=np.float64)[
            :, 0
        ]
    forward = np.column_stack([rays, np.ones(len(rays))])
    pixels = cv2.projectPoints(forward[:, None], np.zeros(3), np.zeros(3), camera.camera_matrix, factors)[0]
    return np.asarray(pixels, dtype=np.float64)[:, 0]


def _in_lens_field(camera: CalibratedCamera, rays: FloatArray) -> NDArray[np.bool_]:
    """Tell which rays lie within the field in which the lens model holds, (n,)."""
    if not camera.distortion:
        return np.ones(len(rays), dtype=np.bool_)
    radii = [
        np.hypot(*((_distort(camera, rays * step / RAY_STEPS) - camera.middle_px) / camera.focal_px).T)
        for step in range(RAY_STEPS + 1)
    ]
    return np.asarray(np.all(np.diff(radii, axis=0) > 0, axis=0))
