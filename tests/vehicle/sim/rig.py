"""Simulated cameras on roads, and digests of their pictures."""

from __future__ import annotations

import hashlib
from typing import Any

from lavt.domain import CameraModel, Picture, Pose
from lavt.vehicle.sim.rendering.camera import SimCamera
from lavt.vehicle.sim.road.road import Road

MODEL = CameraModel()
PHASE_NS = 5
"""When the first exposure begins, after the camera's start."""


def camera_on(road: Road, *, seed: int = 1, model: CameraModel = MODEL, **keys: Any) -> SimCamera:
    """Create a camera of 30 Hz."""
    return SimCamera(model=model, rate_hz=30.0, phase_ns=PHASE_NS, road=road, seed=seed, **keys)


def pose_at(road: Road, s_m: float, lateral_m: float = 0.0, turned_rad: float = 0.0, *, mono_ns: int = 0) -> Pose:
    """Return the pose at a station, with an offset from the lane's centre and a turn from the lane's heading."""
    x_m, y_m = road.point_at(s_m, lateral_m).tolist()
    return Pose(mono_ns, x_m, y_m, float(road.centre_at(s_m).heading_rad) + turned_rad)


def picture_of(camera: SimCamera, pose: Pose, number: int = 0) -> Picture:
    """Return one picture without motion blur."""
    frame = camera.capture(number, 7, pose)
    assert frame is not None
    picture: Picture = frame.picture
    return picture


def digest(picture: Picture) -> str:
    """Return the SHA-256 digest of a picture."""
    return hashlib.sha256(picture.tobytes()).hexdigest()
