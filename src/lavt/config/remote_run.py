"""The server's part of a run that another machine requests; it arrives over the network."""

from __future__ import annotations

import json

from pydantic import Field, field_validator

from lavt.config import CameraConfig, DbwConfig, RecordConfig, RunConfig, SafetyConfig, VehicleConfig, VideoConfig
from lavt.config.section import Section


class RemoteRunConfig(Section):
    """The sections of a run's config that the server needs. None of their values names a file of the server."""

    vehicle: VehicleConfig = VehicleConfig()
    camera: CameraConfig = CameraConfig()
    video: VideoConfig = VideoConfig()
    safety: SafetyConfig = SafetyConfig()
    record: RecordConfig = RecordConfig()
    seed: int = Field(1, ge=0, lt=2**63)

    @field_validator("vehicle")
    @classmethod
    def _check_vehicle(cls, vehicle: VehicleConfig) -> VehicleConfig:
        if vehicle.kind != "simulator" or vehicle.dbw != DbwConfig():
            raise ValueError("only a vehicle of kind simulator, without dbw, can be driven by request")
        if not vehicle.route.replace("_", "").isalnum() or not vehicle.route.isascii():
            raise ValueError("only a road that comes with LAVT, or a random one, can be driven by request")
        return vehicle


def remote_part(run: RunConfig, seed: int) -> str:
    """Return the server's part of a run's config as JSON, without default values."""
    names = set(RemoteRunConfig.model_fields) - {"seed"}
    part = run.model_dump(mode="json", include=names, exclude_defaults=True)
    return json.dumps({**part, "seed": seed}, separators=(",", ":"))
