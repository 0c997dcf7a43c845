"""The file of a camera that was calibrated."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from lavt.config.section import Section


class CalibrationConfig(Section):
    """A camera that was calibrated: its size, its lens in OpenCV's terms, and where it sits (vehicle's frame)."""

    width_px: int = Field(ge=64, le=8192)
    height_px: int = Field(ge=64, le=8192)
    field_of_view_deg: float | None = Field(None, gt=10, lt=150)
    """Over the width, with square pixels and the axis in the middle; or the four below."""
    fx_px: float | None = Field(None, gt=0)
    fy_px: float | None = Field(None, gt=0)
    cx_px: float | None = None
    cy_px: float | None = None
    lens: Literal["pinhole", "fisheye"] = "pinhole"
    distortion: tuple[float, ...] = ()
    """k1, k2, p1, p2 (and k3, or k3 to k6) of a pinhole, k1 to k4 of a fisheye; empty: none."""
    x_m: float
    y_m: float = 0.0
    z_m: float = Field(gt=0)
    yaw_deg: float = Field(0.0, ge=-90, le=90)
    pitch_deg: float = Field(0.0, ge=-60, le=80)
    roll_deg: float = Field(0.0, ge=-60, le=60)

    @field_validator("distortion")
    @classmethod
    def _whole(cls, distortion: tuple[float, ...], info: Any) -> tuple[float, ...]:
        lengths = (4,) if info.data.get("lens") == "fisheye" else (0, 4, 5, 8)
        if len(distortion) not in lengths:
            raise ValueError(f"must have {' or '.join(str(each) for each in lengths)} coefficients for this lens")
        return distortion

    @model_validator(mode="after")
    def _one_focal_length(self) -> CalibrationConfig:
        matrix = (self.fx_px, self.fy_px, self.cx_px, self.cy_px)
        whole = None not in matrix
        if whole == (self.field_of_view_deg is not None) or (not whole and matrix != (None,) * 4):
            raise ValueError("give either field_of_view_deg, or all of fx_px, fy_px, cx_px and cy_px")
        if self.lens == "fisheye" and not (whole and self.distortion):
            # Without them it would be taken for a pinhole, which no fisheye is.
            raise ValueError("a fisheye needs fx_px, fy_px, cx_px, cy_px and its distortion; [0, 0, 0, 0] is none")
        return self
