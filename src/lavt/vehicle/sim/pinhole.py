"""Where a point of the world is in the picture, and what ground a row of the picture sees.

Pixel coordinates are those of OpenCV: the middle of the top left pixel is (0, 0), so the principal point is
((width - 1) / 2, (height - 1) / 2). The world's ground is the plane z = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lavt.domain import CameraModel, FloatArray, Pose


@dataclass(frozen=True, slots=True)
class View:
    """A camera at a place: its position (m) and heading (rad) in the world's frame, above the ground by `z_m`."""

    model: CameraModel
    x_m: float
    y_m: float
    heading_rad: float

    def project(self, points_m: FloatArray) -> FloatArray:
        """Picture coordinates and depth (u px, v px, m) of world points (..., 3); the depth may be negative."""
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        pitch_cosine, pitch_sine = math.cos(self.model.pitch_rad), math.sin(self.model.pitch_rad)
        dx, dy = points_m[..., 0] - self.x_m, points_m[..., 1] - self.y_m
        ahead, left, up = dx * cosine + dy * sine, dy * cosine - dx * sine, points_m[..., 2] - self.model.z_m
        depth = ahead * pitch_cosine - up * pitch_sine
        down = -ahead * pitch_sine - up * pitch_cosine
        u_px, v_px = principal_point(self.model)
        scale = self.model.focal_px / np.where(np.abs(depth) < 1e-6, 1e-6, depth)
        return np.stack([u_px - left * scale, v_px + down * scale, depth], axis=-1)

    def ground_from_picture(self) -> FloatArray:
        """3 x 3 homography from picture (u, v, 1) to the world's ground (x, y, 1), for rows below the horizon."""
        model = self.model
        focal_px, pitch_cosine, pitch_sine = model.focal_px, math.cos(model.pitch_rad), math.sin(model.pitch_rad)
        u_px, v_px = principal_point(model)
        # Along the ray of a pixel: ahead, left and down for each metre of depth; the ground is z_m below the camera.
        ahead = np.array([0.0, -pitch_sine / focal_px, pitch_cosine + v_px * pitch_sine / focal_px])
        left = np.array([-1.0 / focal_px, 0.0, u_px / focal_px])
        down = np.array([0.0, pitch_cosine / focal_px, pitch_sine - v_px * pitch_cosine / focal_px])
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return np.stack(
            [
                model.z_m * (cosine * ahead - sine * left) + self.x_m * down,
                model.z_m * (sine * ahead + cosine * left) + self.y_m * down,
                down,
            ]
        )


def view_from(model: CameraModel, pose: Pose) -> View:
    """Place the camera of a vehicle at `pose`."""
    cosine, sine = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    return View(model, pose.x_m + model.x_m * cosine, pose.y_m + model.x_m * sine, pose.heading_rad)


def principal_point(model: CameraModel) -> tuple[float, float]:
    """Tell where the camera's axis meets the picture (u, v), in pixels."""
    return (model.width_px - 1) / 2, (model.height_px - 1) / 2


def horizon_row(model: CameraModel) -> float:
    """Picture row (v, px) of the horizon."""
    return principal_point(model)[1] - model.focal_px * math.tan(model.pitch_rad)


def row_of_depth(model: CameraModel, ahead_m: float) -> int:
    """First picture row whose ground is no more than `ahead_m` ahead of the camera, kept within the picture."""
    angle_rad = math.atan2(model.z_m, ahead_m) - model.pitch_rad
    row = math.ceil(principal_point(model)[1] + model.focal_px * math.tan(angle_rad))
    return min(max(row, 0), model.height_px)
