"""The construction of cameras, and of their geometry from the server's config, the client's config or a calibration."""

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
from lavt.perception.calibration import CalibratedCamera, calibrated_pinhole_camera
from lavt.vehicle.camera import Camera
from lavt.vehicle.video_device import VideoDevice

CUSTOM_CAMERAS = "lavt.cameras"
"""The group of entry points with which users add cameras: functions like `build_device`."""
SIMULATED = "simulated"
CARLA = "carla"
"""The source of pictures of a vehicle in a CARLA server, which builds its camera itself."""


def build_device(config: ServerConfig) -> VideoDevice:
    """Open a camera device; raise `UserError` if it does not exist or delivers pictures of another size or rate."""
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
    """Build the configured camera, or return None for the simulator's; raise `UserError` for an unknown source."""
    source = config.camera.source
    if source in CAMERAS:
        return CAMERAS[source](config)
    custom = {entry.name: entry for entry in entry_points(group=CUSTOM_CAMERAS)}
    if source not in custom:
        raise UserError(f"unknown camera source {source!r}: choose one of {', '.join([*CAMERAS, *custom])}")
    build: Callable[[ServerConfig], Camera] = custom[source].load()
    return build(config)


def check_simulated_camera(config: ServerConfig) -> None:
    """Raise `UserError` if a vehicle that renders its own pictures is configured with another camera."""
    if config.camera.source != SIMULATED:
        raise UserError(
            f"a vehicle of kind {config.vehicle.kind!r} renders its own pictures, which no other camera can take: "
            "leave out camera.source, or choose the vehicle.kind of a real car"
        )


def camera_model(config: CameraConfig) -> CameraModel:
    """Return the geometry of the configured camera."""
    return CameraModel(
        config.width_px,
        config.height_px,
        math.radians(config.field_of_view_deg),
        config.x_m,
        config.z_m,
        math.radians(config.pitch_deg),
        config.y_m,
        math.radians(config.yaw_deg),
        math.radians(config.roll_deg),
    )


def calibrated_camera(config: CalibrationConfig) -> CalibratedCamera:
    """Return the camera of a calibration."""
    centre_px = ((config.width_px - 1) / 2, (config.height_px - 1) / 2)
    if config.field_of_view_deg is None:  # the schema ensures that fx_px, fy_px, cx_px and cy_px are then set
        focal_px = (config.fx_px or 0.0, config.fy_px or 0.0)
        centre_px = (config.cx_px or 0.0, config.cy_px or 0.0)
    else:
        focal_px = (config.width_px / 2 / math.tan(math.radians(config.field_of_view_deg) / 2),) * 2
    return CalibratedCamera(
        config.width_px,
        config.height_px,
        focal_px,
        centre_px,
        config.x_m,
        config.y_m,
        config.z_m,
        math.radians(config.yaw_deg),
        math.radians(config.pitch_deg),
        math.radians(config.roll_deg),
        config.distortion,
        config.lens == "fisheye",
    )


def camera_of_file(path: Path) -> CalibratedCamera:
    """Read a camera from a calibration or from a config with a camera section; raise `UserError` for other files."""
    data = read_yaml(path)
    if not data.keys() & {*RunConfig.model_fields, *ClientConfig.model_fields}:
        return calibrated_camera(parse_config(CalibrationConfig, data, str(path)))
    section = data.get("camera", {})
    if not isinstance(section, dict):
        raise UserError(f"{path}: camera must contain keys and values, not {section!r}")
    server_only = ServerCameraConfig.model_fields.keys() - CameraConfig.model_fields.keys()
    geometry = {key: value for key, value in section.items() if key not in server_only}
    return client_camera(parse_config(ClientCameraConfig, geometry, f"{path}: camera"))


def client_camera(config: ClientCameraConfig) -> CalibratedCamera:
    """Return the camera of a client's config: from the calibration file, if the config names one, or from its keys."""
    if not config.calibration:
        return calibrated_pinhole_camera(camera_model(config))
    path = Path(config.calibration)
    redundant = config.model_fields_set - {"calibration", "rate_hz", "width_px", "height_px"}
    if redundant:
        keys = ", camera.".join(sorted(redundant))
        raise UserError(f"camera.calibration replaces the other keys: leave out camera.{keys}")
    camera = calibrated_camera(parse_config(CalibrationConfig, read_yaml(path), str(path)))
    sizes = {"width_px": camera.width_px, "height_px": camera.height_px}
    for key in config.model_fields_set & sizes.keys():
        if getattr(config, key) != sizes[key]:
            raise UserError(f"camera.{key} is {getattr(config, key)}, but {path} is for {sizes[key]}: use that size")
    return camera
