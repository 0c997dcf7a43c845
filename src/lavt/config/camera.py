"""The schema of a camera, on the vehicle's machine and on the client, and of its calibration file."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from lavt.config.section import Section


class CameraConfig(Section):
    """The camera: its picture size and rate, and its pose in the vehicle's frame."""

    width_px: int = Field(640, ge=128, le=3840, multiple_of=2)
    """The width of a picture."""
    height_px: int = Field(480, ge=128, le=2160, multiple_of=2)
    """The height of a picture."""
    rate_hz: float = Field(30.0, ge=1, le=120)
    """The number of pictures per second."""
    field_of_view_deg: float = Field(90.0, gt=10, lt=150)
    """The horizontal field of view."""
    x_m: float = Field(1.6, ge=-10, le=10)
    """The camera's distance in front of the rear axle."""
    y_m: float = Field(0.0, ge=-5, le=5)
    """The camera's distance to the left of the middle of the car."""
    z_m: float = Field(1.4, gt=0, le=10)
    """The camera's height above the ground."""
    yaw_deg: float = Field(0.0, ge=-180, le=180)
    """Positive to the left."""
    pitch_deg: float = Field(0.0, ge=-20, le=45)
    """Positive downwards."""
    roll_deg: float = Field(0.0, ge=-45, le=45)
    """Positive when the camera leans to the right."""
    exposure_ms: float = Field(0.0, ge=0, le=500)
    """For a simulated camera: how long the shutter is open; 0: an instantaneous exposure."""
    sensor_delay_ms: float = Field(0.0, ge=0, le=500)
    """For a simulated camera: from the end of the exposure until the picture is available."""

    @field_validator("exposure_ms")
    @classmethod
    def _check_exposure(cls, exposure_ms: float, info: Any) -> float:
        period_ms = 1000.0 / info.data.get("rate_hz", 1.0)
        if exposure_ms > period_ms:
            raise ValueError(f"must be at most the time between two frames, {period_ms:.3g} ms at camera.rate_hz")
        return exposure_ms


class ServerCameraConfig(CameraConfig):
    """The camera in the config of the vehicle's machine."""

    source: str = "simulated"
    """simulated: the simulator's camera; device: a real camera (`docs/camera.md`); carla: the camera of a vehicle of
    kind `carla`."""
    device: str | int = "/dev/video0"
    """For source `device`: a V4L2 device or its number, or the file or address of a video."""
    format: str = Field("", pattern="^([!-~]{4})?$")
    """For a V4L2 device: the pixel format, such as MJPG; empty: the driver's choice."""


class ClientCameraConfig(CameraConfig):
    """The camera in the client's config."""

    calibration: str = ""
    """A calibration file, which replaces all other keys except `rate_hz`; empty: the other keys apply."""


class CalibrationConfig(Section):
    """A calibrated camera: picture size, lens parameters as in OpenCV, and pose in the vehicle's frame."""

    width_px: int = Field(ge=64, le=8192)
    """The width of a picture."""
    height_px: int = Field(ge=64, le=8192)
    """The height of a picture."""
    field_of_view_deg: float | None = Field(None, gt=10, lt=150)
    """The horizontal field of view of a camera with square pixels and a centred optical axis; it replaces the four keys
    below."""
    fx_px: float | None = Field(None, gt=0)
    """The horizontal focal length."""
    fy_px: float | None = Field(None, gt=0)
    """The vertical focal length."""
    cx_px: float | None = None
    """The horizontal position of the optical axis."""
    cy_px: float | None = None
    """The vertical position of the optical axis."""
    lens: Literal["pinhole", "fisheye"] = "pinhole"
    """The model of the lens."""
    distortion: tuple[float, ...] = ()
    """k1, k2, p1, p2 (and k3, or k3 to k6) of a pinhole lens, k1 to k4 of a fisheye lens; empty: no distortion."""
    x_m: float
    """The camera's distance in front of the rear axle."""
    y_m: float = 0.0
    """The camera's distance to the left of the middle of the car."""
    z_m: float = Field(gt=0)
    """The camera's height above the ground."""
    yaw_deg: float = Field(0.0, ge=-90, le=90)
    """Positive to the left."""
    pitch_deg: float = Field(0.0, ge=-60, le=80)
    """Positive downwards."""
    roll_deg: float = Field(0.0, ge=-60, le=60)
    """Positive when the camera leans to the right."""

    @field_validator("distortion")
    @classmethod
    def _check_length(cls, distortion: tuple[float, ...], info: Any) -> tuple[float, ...]:
        lengths = (4,) if info.data.get("lens") == "fisheye" else (0, 4, 5, 8)
        if len(distortion) not in lengths:
            raise ValueError(f"must have {' or '.join(str(length) for length in lengths)} coefficients for this lens")
        return distortion

    @model_validator(mode="after")
    def _check_focal_length(self) -> CalibrationConfig:
        matrix = (self.fx_px, self.fy_px, self.cx_px, self.cy_px)
        is_complete = None not in matrix
        if is_complete == (self.field_of_view_deg is not None) or (not is_complete and matrix != (None,) * 4):
            raise ValueError("give either field_of_view_deg, or all of fx_px, fy_px, cx_px and cy_px")
        if self.lens == "fisheye" and not (is_complete and self.distortion):
            # Without them the lens would be treated as a pinhole lens.
            raise ValueError(
                "a fisheye needs fx_px, fy_px, cx_px, cy_px and distortion ([0, 0, 0, 0] for no distortion)"
            )
        return self
