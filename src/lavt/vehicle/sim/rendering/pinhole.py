"""The pinhole projections of the world to the picture, and of the picture to the ground.

Pixel coordinates are those of OpenCV: the middle of the top left pixel is (0, 0), so the principal point is
((width - 1) / 2, (height - 1) / 2). The world's ground is the plane z = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from msgspec.structs import replace

from lavt.domain import CameraModel, FloatArray, Pose


@dataclass(frozen=True)
class CameraPlacement:
    """A camera at its place in the world: position (m) and heading (rad), at `model.z_m` above the ground."""

    model: CameraModel
    x_m: float
    y_m: float
    heading_rad: float

    def project(self, points_m: FloatArray) -> FloatArray:
        """Return picture coordinates and depth (u px, v px, m) of world points (..., 3).

        The depth of a point behind the camera is negative.
        """
        turn, (right, down, ahead) = self._camera_from_world
        # A row for each coordinate, because NumPy is several times faster along rows than across short ones.
        u_px, v_px, depth_m = rows = turn @ points_m.reshape(-1, 3).T
        u_px += right
        v_px += down
        depth_m += ahead
        divisor_m = np.where(np.abs(depth_m) < 1e-6, 1e-6, depth_m)
        u_px /= divisor_m
        v_px /= divisor_m
        middle_u_px, middle_v_px = principal_point(self.model)
        u_px += middle_u_px
        v_px += middle_v_px
        return np.asarray(rows.T.reshape(points_m.shape))

    def depth_m(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Return how far ahead of the camera places are, measured along the ground."""
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        return np.asarray(x_m * cosine + y_m * sine - (self.x_m * cosine + self.y_m * sine))

    @cached_property
    def _camera_from_world(self) -> tuple[FloatArray, FloatArray]:
        """The matrix (3, 3) by which world coordinates are multiplied, and the shift (3,) that is then added.

        The results are to the right and down, both rolled and scaled to pixels at a depth of 1 m, and the depth.
        """
        model = self.model
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        pitch_cosine, pitch_sine = math.cos(model.pitch_rad), math.sin(model.pitch_rad)
        camera_from_world = np.array(
            [
                [sine, -cosine, 0.0],
                [-cosine * pitch_sine, -sine * pitch_sine, -pitch_cosine],
                [cosine * pitch_cosine, sine * pitch_cosine, -pitch_sine],
            ]
        )
        camera_from_world[:2] = roll_matrix(model.roll_rad) @ camera_from_world[:2] * model.focal_px
        return camera_from_world, -camera_from_world @ (self.x_m, self.y_m, model.z_m)

    def ground_from_picture(self) -> FloatArray:
        """Return the 3 x 3 homography from the picture (u, v, 1) to the world's ground (x, y, 1).

        It is valid for pixels that show ground: those lower than the horizon.
        """
        model = self.model
        focal_px, pitch_cosine, pitch_sine = model.focal_px, math.cos(model.pitch_rad), math.sin(model.pitch_rad)
        # A pixel's ray: ahead, left and down per metre of depth; the ground is z_m below the camera.
        ahead = np.array([0.0, -pitch_sine / focal_px, pitch_cosine])
        left = np.array([-1.0 / focal_px, 0.0, 0.0])
        down = np.array([0.0, pitch_cosine / focal_px, pitch_sine])
        cosine, sine = math.cos(self.heading_rad), math.sin(self.heading_rad)
        ground_from_level = np.stack(
            [
                model.z_m * (cosine * ahead - sine * left) + self.x_m * down,
                model.z_m * (sine * ahead + cosine * left) + self.y_m * down,
                down,
            ]
        )
        u_px, v_px = principal_point(model)
        level_from_picture = np.eye(3)
        level_from_picture[:2, :2] = roll_matrix(-model.roll_rad)
        level_from_picture[:2, 2] = level_from_picture[:2, :2] @ np.array([-u_px, -v_px])
        return np.asarray(ground_from_level @ level_from_picture)


def place_camera(model: CameraModel, pose: Pose) -> CameraPlacement:
    """Return the placement of the camera of a vehicle at `pose`."""
    cosine, sine = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    x_m = pose.x_m + model.x_m * cosine - model.y_m * sine
    y_m = pose.y_m + model.x_m * sine + model.y_m * cosine
    return CameraPlacement(model, x_m, y_m, pose.heading_rad + model.yaw_rad)


def roll_matrix(roll_rad: float) -> FloatArray:
    """Return the 2 x 2 matrix from a level camera's picture coordinates to those of a camera rolled by `roll_rad`.

    The coordinates are those to the right and down from the principal point.
    """
    cosine, sine = math.cos(roll_rad), math.sin(roll_rad)
    return np.array([[cosine, sine], [-sine, cosine]])


def level_model(model: CameraModel) -> CameraModel:
    """Return a camera without roll, of the same focal length, whose picture shows everything that `model` shows."""
    if model.roll_rad == 0.0:
        return model
    cosine, sine = abs(math.cos(model.roll_rad)), abs(math.sin(model.roll_rad))
    width_px = 2 * math.ceil((model.width_px * cosine + model.height_px * sine) / 2 + 1)
    height_px = 2 * math.ceil((model.width_px * sine + model.height_px * cosine) / 2 + 1)
    field_of_view_rad = 2 * math.atan(width_px / 2 / model.focal_px)
    return replace(model, width_px=width_px, height_px=height_px, field_of_view_rad=field_of_view_rad, roll_rad=0.0)


def principal_point(model: CameraModel) -> tuple[float, float]:
    """Return the point (u, v) in pixels where the camera's axis meets the picture."""
    return (model.width_px - 1) / 2, (model.height_px - 1) / 2


def horizon_row(model: CameraModel) -> float:
    """Return the picture row (v, px) of the horizon, for a camera without roll."""
    return principal_point(model)[1] - model.focal_px * math.tan(model.pitch_rad)


def row_of_depth(model: CameraModel, ahead_m: float) -> int:
    """Return the first picture row whose ground is at most `ahead_m` ahead, for a camera without roll."""
    angle_rad = math.atan2(model.z_m, ahead_m) - model.pitch_rad
    row = math.ceil(principal_point(model)[1] + model.focal_px * math.tan(angle_rad))
    return min(max(row, 0), model.height_px)
