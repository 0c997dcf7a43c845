"""Calibrated cameras: the projection of ground points into the picture, through any lens model of OpenCV.

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
"""The focal length of the reference camera for sizes in pixels: 640 columns over 90 degrees."""

RAY_STEPS = 8
"""Number of steps from the lens's axis to a ray. The distance from the picture's middle must increase with each step,
and also one step beyond the ray.

Beyond some angle a distortion polynomial folds back: points that the lens cannot see get positions inside the picture.
"""


@dataclass(frozen=True, slots=True)
class CalibratedCamera:
    """A camera with its lens and its pose on the vehicle.

    `yaw_rad` is positive to the left, `pitch_rad` downwards, `roll_rad` with the right side down. Turned by yaw, then
    pitch, then roll, the vehicle's axes become the camera's. `distortion` is empty for a lens without distortion.
    """

    width_px: int
    height_px: int
    focal_px: tuple[float, float]
    """The focal lengths (fx, fy), horizontal and vertical."""
    middle_px: tuple[float, float]
    """The principal point (cx, cy)."""
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
        """The size of objects in this camera's picture relative to the reference camera's."""
        return self.focal_px[0] / REFERENCE_FOCAL_PX


def calibrated_pinhole_camera(model: CameraModel) -> CalibratedCamera:
    """Return the pinhole camera of a config as a calibrated camera: square pixels, central axis, no distortion."""
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
    """Return the camera's axes in the vehicle's frame, (3, 3): the rows are right, down and forward."""
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
    """Return the 3 x 3 matrix from ground (x, y, 1) to the camera's frame (right, down, forward), in metres."""
    rotation = axes(camera)
    return np.column_stack([rotation[:, 0], rotation[:, 1], -rotation @ np.array([camera.x_m, camera.y_m, camera.z_m])])


def ground_to_picture(camera: CalibratedCamera) -> FloatArray:
    """Return the 3 x 3 homography from ground (x, y, 1) to the undistorted picture (u, v, 1), up to scale.

    The third component is the depth along the camera's axis; only points with a positive depth are in the picture.
    """
    return np.asarray(camera.camera_matrix @ ground_to_camera(camera), dtype=np.float64)


def picture_points(camera: CalibratedCamera, ground_m: FloatArray) -> FloatArray:
    """Project ground points (n, 2) into the distorted picture: (n, 2) in pixels.

    Points behind the camera or outside the lens model's valid field are NaN. The result can lie outside the picture.
    """
    camera_points = np.column_stack([ground_m, np.ones(len(ground_m))]) @ ground_to_camera(camera).T
    ahead = camera_points[:, 2] > 1e-6
    rays = camera_points[:, :2] / np.where(ahead, camera_points[:, 2], 1.0)[:, None]
    pixels = _distort(camera, rays)
    pixels[~(ahead & _in_lens_field(camera, rays))] = np.nan
    return pixels


def _distort(camera: CalibratedCamera, rays: FloatArray) -> FloatArray:
    """Project rays, given as points (n, 2) of the plane at depth 1, through the lens to pixels (n, 2)."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.middle_px
    if not camera.distortion:
        return rays * (fx, fy) + (cx, cy)
    coefficients = np.array(camera.distortion)
    if camera.fisheye:
        pixels = cv2.fisheye.distortPoints(rays[:, None], camera.camera_matrix, coefficients)
    else:
        forward = np.column_stack([rays, np.ones(len(rays))])
        pixels = cv2.projectPoints(forward[:, None], np.zeros(3), np.zeros(3), camera.camera_matrix, coefficients)[0]
    return np.asarray(pixels, dtype=np.float64)[:, 0]


def _in_lens_field(camera: CalibratedCamera, rays: FloatArray) -> NDArray[np.bool_]:
    """Return which rays lie within the lens model's valid field, (n,)."""
    if not camera.distortion:
        return np.ones(len(rays), dtype=np.bool_)
    radii = [
        np.hypot(*((_distort(camera, rays * step / RAY_STEPS) - camera.middle_px) / camera.focal_px).T)
        for step in range(RAY_STEPS + 2)
    ]
    return np.asarray(np.all(np.diff(radii, axis=0) > 0, axis=0))
