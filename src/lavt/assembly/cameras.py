"""Cameras of configs: what is plugged in, and the geometry of any, as the vehicle has it and as the client knows it."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path

from lavt.clock import MachineClock
from lavt.config import (
    CalibrationConfig,
    CameraConfig,
    ClientCameraConfig,
    ClientConfig,
    RunConfig,
    ServerCameraConfig,
    ServerConfig,
)
from lavt.config_file import parse_config, read_yaml
from lavt.domain import CameraModel
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera, calibrated
from lavt.vehicle.camera import Camera
from lavt.vehicle.video_device import VideoDevice

CUSTOM_CAMERAS = "lavt.cameras"
"""Entry points of this group are functions like `build_device`: a user adds a camera without touching LAVT."""
SIMULATED = "simulated"


def build_device(config: ServerConfig) -> VideoDevice:
    """Open the camera that is plugged in; raises `UserError` for one that is not there or gives other pictures."""
    camera = config.camera
    return VideoDevice(
        str(camera.device),
        model=camera_model(camera),
        rate_hz=camera.rate_hz,
        clock=MachineClock(),
        pixel_format=camera.format,
    )


CAMERAS: dict[str, Callable[[ServerConfig], Camera | None]] = {SIMULATED: lambda _: None, "device": build_device}


def build_camera(config: ServerConfig) -> Camera | None:
    """Make the configured camera; None: the vehicle's own. Raises `UserError` naming the known sources."""
    source = config.camera.source
    if source in CAMERAS:
        return CAMERAS[source](config)
    custom = {entry.name: entry for entry in entry_points(group=CUSTOM_CAMERAS)}
    if source not in custom:
        raise UserError(f"there is no camera {source!r}: the known sources are {', '.join([*CAMERAS, *custom])}")
    build: Callable[[ServerConfig], Camera] = custom[source].load()
    return build(config)


def check_own_camera(config: ServerConfig) -> None:
    """Raise `UserError` where a vehicle that draws its own pictures is given another camera."""
    if config.camera.source != SIMULATED:
        raise UserError(
            f"a vehicle of kind {config.vehicle.kind!r} draws its own pictures, no camera sees its road: leave out "
            f"camera.source, or choose the vehicle.kind of a real car instead"
        )


def camera_model(config: CameraConfig) -> CameraModel:
    """Geometry of the configured camera."""
    return CameraModel(
        config.width_px, config.height_px, math.radians(config.field_of_view_deg), config.x_m, config.z_m,
        math.radians(config.pitch_deg), config.y_m, math.radians(config.yaw_deg), math.radians(config.roll_deg),
    )  # fmt: skip


def calibrated_camera(config: CalibrationConfig) -> CalibratedCamera:
    """Give the camera of a calibration."""
    middle_px = ((config.width_px - 1) / 2, (config.height_px - 1) / 2)
    if config.field_of_view_deg is None:
        focal_px = (config.fx_px or 0.0, config.fy_px or 0.0)
        middle_px = (config.cx_px or 0.0, config.cy_px or 0.0)
    else:
        focal_px = (config.width_px / 2 / math.tan(math.radians(config.field_of_view_deg) / 2),) * 2
    return CalibratedCamera(
        config.width_px, config.height_px, focal_px, middle_px, config.x_m, config.y_m, config.z_m,
        math.radians(config.yaw_deg), math.radians(config.pitch_deg), math.radians(config.roll_deg),
        config.distortion, config.lens == "fisheye",
    )  # fmt: skip


def camera_of_file(path: Path) -> CalibratedCamera:
    """Read a camera from a calibration, or take that of any config that has one; raises `UserError`."""
    data = read_yaml(path)
    if not data.keys() & {*RunConfig.model_fields, *ClientConfig.model_fields}:
        return calibrated_camera(parse_config(CalibrationConfig, data, str(path)))
    section = data.get("camera", {})
    if not isinstance(section, dict):
        raise UserError(f"{path}: camera must hold keys and values, not {section!r}")
    vehicles_own = ServerCameraConfig.model_fields.keys() - CameraConfig.model_fields.keys()
    known = {key: each for key, each in section.items() if key not in vehicles_own}
    return client_camera(parse_config(ClientCameraConfig, known, f"{path}: camera"))


def client_camera(config: ClientCameraConfig) -> CalibratedCamera:
    """Give the camera as the client knows it: its calibration where there is one, else what the config says."""
    if not config.calibration:
        return calibrated(camera_model(config))
    path = Path(config.calibration)
    said = config.model_fields_set - {"calibration", "rate_hz", "width_px", "height_px"}
    if said:
        raise UserError(f"camera.calibration says everything: leave out camera.{', camera.'.join(sorted(said))}")
    camera = calibrated_camera(parse_config(CalibrationConfig, read_yaml(path), str(path)))
    sizes = {"width_px": camera.width_px, "height_px": camera.height_px}
    for key in config.model_fields_set & sizes.keys():
        if getattr(config, key) != sizes[key]:
            raise UserError(
                f"camera.{key} is {getattr(config, key)}, but {path} was made for {sizes[key]}: use its size"
            )
    return camera
