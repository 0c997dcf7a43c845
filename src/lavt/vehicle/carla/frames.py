"""Conversions between LAVT's frames and CARLA's.

LAVT is right-handed: x forward, y left, angles in rad, positive to the left; its vehicle frame has the origin on the
ground under the middle of the rear axle. CARLA is left-handed, as Unreal Engine is: x forward, y right, z up, angles in
degrees; yaw is positive to the right, pitch is positive upwards, roll is positive when leaning to the right. The origin
of an actor is a point of its model, so the rear axle's position relative to it comes from the wheels' positions, which
CARLA reports in cm in the world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from lavt.domain import CameraModel

CM_PER_M = 100.0


class CarlaPose(NamedTuple):
    """A location (m) and a rotation (degrees) in CARLA's frame."""

    x_m: float
    y_m: float
    z_m: float
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    roll_deg: float = 0.0


class FlatPose(NamedTuple):
    """A pose on a flat road in LAVT's world frame."""

    x_m: float
    y_m: float
    heading_rad: float


class Axles(NamedTuple):
    """The axles of an actor."""

    rear_axle_m: float
    """Position of the rear axle ahead of the actor's origin; usually negative."""
    wheelbase_m: float


def rear_axle_pose(actor: CarlaPose, rear_axle_m: float, map_shift_m: tuple[float, float] = (0.0, 0.0)) -> FlatPose:
    """Return the rear axle's pose in LAVT's world frame, for an actor in CARLA's.

    `map_shift_m` is the position of LAVT's origin in the map, in the map's right-handed coordinates.
    """
    heading_rad = -math.radians(actor.yaw_deg)
    return FlatPose(
        actor.x_m + rear_axle_m * math.cos(heading_rad) - map_shift_m[0],
        -actor.y_m + rear_axle_m * math.sin(heading_rad) - map_shift_m[1],
        math.remainder(heading_rad, 2 * math.pi),
    )


def actor_pose(
    rear_axle: FlatPose, rear_axle_m: float, map_shift_m: tuple[float, float] = (0.0, 0.0), z_m: float = 0.0
) -> CarlaPose:
    """Return the pose of the actor whose rear axle has a pose: the inverse of `rear_axle_pose`."""
    x_m = rear_axle.x_m - rear_axle_m * math.cos(rear_axle.heading_rad) + map_shift_m[0]
    y_m = rear_axle.y_m - rear_axle_m * math.sin(rear_axle.heading_rad) + map_shift_m[1]
    return CarlaPose(x_m, -y_m, z_m, yaw_deg=-math.degrees(rear_axle.heading_rad))


def camera_mount(model: CameraModel, rear_axle_m: float) -> CarlaPose:
    """Return the pose of a camera relative to the actor that carries it."""
    return CarlaPose(
        model.x_m + rear_axle_m,
        -model.y_m,
        model.z_m,
        pitch_deg=-math.degrees(model.pitch_rad),
        yaw_deg=-math.degrees(model.yaw_rad),
        roll_deg=math.degrees(model.roll_rad),
    )


def forward_speed_mps(velocity_mps: Sequence[float], yaw_deg: float) -> float:
    """Return the forward component of a velocity (x, y, ...) in CARLA's world frame."""
    yaw_rad = math.radians(yaw_deg)
    return velocity_mps[0] * math.cos(yaw_rad) + velocity_mps[1] * math.sin(yaw_rad)


def find_axles(actor: CarlaPose, wheels_cm: Sequence[Sequence[float]]) -> Axles:
    """Return the axles for the world positions (cm) of the wheels: front left, front right, rear left, rear right."""
    yaw_rad = math.radians(actor.yaw_deg)

    def ahead_m(wheels: Sequence[Sequence[float]]) -> float:
        x_m, y_m = (sum(wheel[axis] for wheel in wheels) / len(wheels) / CM_PER_M for axis in (0, 1))
        return (x_m - actor.x_m) * math.cos(yaw_rad) + (y_m - actor.y_m) * math.sin(yaw_rad)

    rear_m = ahead_m(wheels_cm[2:4])
    return Axles(rear_m, ahead_m(wheels_cm[:2]) - rear_m)


def curve_at(curve: Sequence[tuple[float, float]], at: float) -> float:
    """Return the value of a piecewise linear curve of (x, y) points, sorted by x; 1 for a curve without points."""
    if not curve:
        return 1.0
    for (first_x, first_y), (second_x, second_y) in pairwise(curve):
        if at < second_x:
            share = max(0.0, (at - first_x) / (second_x - first_x)) if second_x > first_x else 1.0
            return first_y + share * (second_y - first_y)
    return curve[-1][1]


def steer_for(steering_rad: float, max_steering_rad: float, curve_factor: float = 1.0) -> float:
    """Return CARLA's steer in [-1, 1] for a road wheel angle; the server multiplies the steer by `curve_factor`."""
    return max(-1.0, min(1.0, -steering_rad / (max_steering_rad * curve_factor)))


def road_wheel_rad(left_deg: float, right_deg: float) -> float:
    """Return the angle of a bicycle's front wheel for CARLA's angles of the two front wheels.

    Its cotangent is the mean of theirs (Ackermann geometry).
    """
    tangents = [math.tan(-math.radians(angle_deg)) for angle_deg in (left_deg, right_deg)]
    if min(map(abs, tangents)) < 1e-9 or tangents[0] * tangents[1] < 0.0:
        return math.atan(sum(tangents) / 2)
    return math.atan(2.0 / sum(1.0 / tangent for tangent in tangents))
