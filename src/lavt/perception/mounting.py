"""The mounting of a camera from two parallel lines on level ground: its pitch, yaw and height.

The car stands or drives parallel to the lines. In the picture, the lines meet in the vanishing point, which is the
direction of the car: it gives yaw and pitch. The distance between the lines gives the height. Roll must be known: a
turned camera and a camera beside the middle of the lines give the same picture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from lavt.domain import FloatArray, Picture
from lavt.errors import UserError
from lavt.perception.bird_eye import GroundGrid, make_bird_eye
from lavt.perception.calibration import CalibratedCamera, axes, picture_points

MIN_SEPARATION_RAD = math.radians(3)
"""The planes through the camera and each line must differ by at least this angle."""
MIN_LENGTH_M = 4.0
"""The given points of a line are at least this far apart along the road: from closer ones, the direction is a guess."""
MIN_LENGTH_SHARE = 0.05
"""The same in the picture, as a share of its height."""
DRAWN_TO_M = 60.0
"""How far the lines are drawn."""
BAR_STEP_M = 5.0
"""The distance between the drawn bars across the lines."""
LINE_BGR, BAR_BGR = (60, 220, 255), (80, 200, 80)


@dataclass(frozen=True, slots=True)
class Mounting:
    """The camera with its pose, and the lines as it sees them."""

    camera: CalibratedCamera
    line_y_m: tuple[float, float]
    """The offset of the left and of the right line to the left of the car's middle."""
    deviation_m: float
    """The largest sideways distance of a given point from its line."""


def rays_of(camera: CalibratedCamera, pixels: FloatArray) -> FloatArray:
    """Return the directions, (n, 3): right, down, forward, in which a camera sees pixels (n, 2)."""
    points = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
    if not camera.distortion:
        plane = ((points - camera.middle_px) / camera.focal_px).reshape(-1, 2)
    else:
        undistort = cv2.fisheye.undistortPoints if camera.fisheye else cv2.undistortPoints
        found = undistort(points, camera.camera_matrix, np.array(camera.distortion))
        plane = np.asarray(found, dtype=np.float64).reshape(-1, 2)
    return np.column_stack([plane, np.ones(len(plane))])


def find_mounting(camera: CalibratedCamera, left_px: FloatArray, right_px: FloatArray, distance_m: float) -> Mounting:
    """Return the pitch, yaw and height of a camera that sees two lines, `distance_m` apart, at these pixels.

    `left_px` and `right_px` are points of each line, (n, 2). The camera's lens, roll, and position along and across
    the car are kept. Raises `UserError` if the points do not determine the mounting.
    """
    if min(len(left_px), len(right_px)) < 2:
        raise UserError("each line needs at least two points: one near, and one as far as you see it")
    for name, pixels in (("--left", left_px), ("--right", right_px)):
        if np.linalg.norm(np.ptp(pixels, axis=0)) < MIN_LENGTH_SHARE * camera.height_px:
            raise UserError(f"the points of {name} are too close together: give one near, and one as far as you see it")
    rays = [rays_of(camera, pixels) for pixels in (left_px, right_px)]
    normals = [np.linalg.svd(line / np.linalg.norm(line, axis=1)[:, None])[2][2] for line in rays]
    ahead = np.cross(normals[0], normals[1])
    if np.linalg.norm(ahead) < math.sin(MIN_SEPARATION_RAD):
        raise UserError("the two lines are nearly the same line in the picture: correct --left and --right")
    right, down, forward = ahead / np.linalg.norm(ahead) * (1 if ahead[2] > 0 else -1)
    cosine, sine = math.cos(camera.roll_rad), math.sin(camera.roll_rad)
    right, down = cosine * right - sine * down, sine * right + cosine * down
    turned = replace(camera, yaw_rad=math.asin(right), pitch_rad=math.atan2(-down, forward))
    sides = []
    for line in rays:
        directions = line @ axes(turned)
        if (directions[:, 2] >= 0).any():
            raise UserError("a point is above the horizon, where the two lines meet: correct --left and --right")
        sides.append(directions[:, 1] / -directions[:, 2])  # sideways for each metre of height
    left_side, right_side = (float(np.mean(side)) for side in sides)
    if left_side <= right_side:
        raise UserError("the left line is to the right of the right line: exchange --left and --right")
    height_m = distance_m / (left_side - right_side)
    deviation_m = height_m * max(float(np.abs(side - np.mean(side)).max()) for side in sides)
    for name, line in zip(("--left", "--right"), rays, strict=True):
        directions = line @ axes(turned)
        length_m = height_m * float(np.ptp(directions[:, 0] / -directions[:, 2]))
        if length_m < MIN_LENGTH_M:
            raise UserError(
                f"the points of {name} are {length_m:.1f} m apart along the road, but at least {MIN_LENGTH_M:g} m are "
                "needed: give one near, and one as far as you see it"
            )
    mounted = replace(turned, z_m=height_m)
    y_m = (mounted.y_m + height_m * left_side, mounted.y_m + height_m * right_side)
    return Mounting(mounted, y_m, deviation_m)


def draw_mounting(picture: Picture, mounting: Mounting) -> Picture:
    """Return the picture with the lines and bars across them, every 5 m, beside the view from above.

    If the mounting is right, the drawn lines are on the road's lines as far as these are straight, and in the view from
    above the road's lines are upright.
    """
    camera, drawn = mounting.camera, picture.copy()
    left_m, right_m = mounting.line_y_m
    ahead_m = np.linspace(camera.x_m + 1.0, DRAWN_TO_M, 200)
    thickness = max(camera.width_px // 640, 1)
    for y_m in mounting.line_y_m:
        _draw(
            drawn, picture_points(camera, np.column_stack([ahead_m, np.full_like(ahead_m, y_m)])), LINE_BGR, thickness
        )
    for x_m in np.arange(BAR_STEP_M, 30 + BAR_STEP_M, BAR_STEP_M):
        across = np.column_stack([np.full(20, x_m), np.linspace(left_m, right_m, 20)])
        pixels = picture_points(camera, across)
        _draw(drawn, pixels, BAR_BGR, thickness)
        if np.isfinite(pixels[-1]).all() and (np.abs(pixels[-1]) < 4 * camera.width_px).all():
            u, v = (round(value) for value in pixels[-1].tolist())
            scale = camera.width_px / 1280
            cv2.putText(
                drawn, f"{x_m:.0f} m", (u + 8, v), cv2.FONT_HERSHEY_SIMPLEX, scale, BAR_BGR, thickness, cv2.LINE_AA
            )
    grid = GroundGrid()
    bird_eye = make_bird_eye(camera, grid, stamped=False)
    above = bird_eye.view_from_above(bird_eye.region(picture))
    height_px = drawn.shape[0]
    scale = height_px / grid.rows
    size = (round(grid.columns * scale), height_px)
    scaled = np.asarray(cv2.resize(above, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
    for y_m in mounting.line_y_m:
        column = round((grid.half_width_m - y_m) / grid.step_y_m * scale)
        cv2.line(scaled, (column, 0), (column, height_px - 1), LINE_BGR, thickness, cv2.LINE_AA)
    return np.asarray(np.hstack([drawn, scaled]), dtype=np.uint8)


def _draw(picture: Picture, pixels: FloatArray, colour: tuple[int, int, int], thickness: int) -> None:
    limit = 4 * max(picture.shape)
    near = np.isfinite(pixels).all(axis=1) & (np.abs(np.nan_to_num(pixels)) < limit).all(axis=1)
    cv2.polylines(picture, [np.round(pixels[near]).astype(np.int32)], False, colour, thickness, cv2.LINE_AA)
