"""Cameras of configs: their geometry, as the vehicle has it and as the client knows it."""

from __future__ import annotations

import math
from pathlib import Path

from lavt.config import CalibrationConfig, CameraConfig, ClientCameraConfig, ClientConfig, RunConfig
from lavt.config_file import parse_config, read_yaml
from lavt.domain import CameraModel
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera, calibrated


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
    """Read a camera from a calibration, or take that of a run's or a client's config; raises `UserError`."""
    data = read_yaml(path)
    if not data.keys() & {*RunConfig.model_fields, *ClientConfig.model_fields}:
        return calibrated_camera(parse_config(CalibrationConfig, data, str(path)))
    section = data.get("camera", {})
    if not isinstance(section, dict):
        raise UserError(f"{path}: camera must hold keys and values, not {section!r}")
    return client_camera(parse_config(ClientCameraConfig, section, f"{path}: camera"))


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
