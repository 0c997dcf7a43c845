"""What can be configured of a camera, by its vehicle's machine and by the client."""

from __future__ import annotations

from typing import Any

from pydantic import Field, field_validator

from lavt.config.section import Section


class CameraConfig(Section):
    """The camera: where it sits (vehicle's frame) and what it gives."""

    width_px: int = Field(640, ge=128, le=3840, multiple_of=2)
    height_px: int = Field(480, ge=128, le=2160, multiple_of=2)
    rate_hz: float = Field(30.0, ge=1, le=120)
    field_of_view_deg: float = Field(90.0, gt=10, lt=150)
    x_m: float = Field(1.6, ge=-10, le=10)
    y_m: float = Field(0.0, ge=-5, le=5)
    z_m: float = Field(1.4, gt=0, le=10)
    yaw_deg: float = Field(0.0, ge=-180, le=180)
    """Positive to the left."""
    pitch_deg: float = Field(0.0, ge=-20, le=45)
    """Positive downwards."""
    roll_deg: float = Field(0.0, ge=-45, le=45)
    """Positive leaning to the right."""
    exposure_ms: float = Field(0.0, ge=0, le=500)
    """A simulated camera's: how long the shutter is open; 0 is a moment."""
    sensor_delay_ms: float = Field(0.0, ge=0, le=500)
    """A simulated camera's: from the end of the exposure to the picture being there."""

    @field_validator("exposure_ms")
    @classmethod
    def _fits(cls, exposure_ms: float, info: Any) -> float:
        period_ms = 1000.0 / info.data.get("rate_hz", 1.0)
        if exposure_ms > period_ms:
            raise ValueError(f"must be at most the time between two frames, {period_ms:.3g} ms at camera.rate_hz")
        return exposure_ms


class ServerCameraConfig(CameraConfig):
    """The camera as the vehicle's machine has it."""

    source: str = "simulated"
    """simulated: the vehicle's own; device: one that is plugged in (`docs/camera.md`)."""
    device: str | int = "/dev/video0"
    """With source device: a V4L2 device or its number, or a file or address of a video."""
    format: str = Field("", pattern="^([!-~]{4})?$")
    """With a V4L2 device: its name of a pixel format, such as MJPG; empty: the driver's choice."""


class ClientCameraConfig(CameraConfig):
    """The camera as the client knows it."""

    calibration: str = ""
    """File of a calibration, which then says everything but the rate; empty: the keys above say it."""
