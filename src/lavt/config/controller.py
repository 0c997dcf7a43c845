"""The schema of the config section `controller`."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from lavt.config.section import Section
from lavt.config.vehicle import MAX_SIMULATED_MPS

HUMAN = "human"
"""The kind of controller with which a person drives."""


class ControllerConfig(Section):
    """The controller that drives."""

    kind: str = "lane_keeper"
    """lane_keeper: the built-in controller; human: a person drives from a web page (`docs/drive.md`); or the name of
    your own (`docs/controllers.md`)."""
    preset: str = "designed"
    """The set of gains: designed (found by theory) or paper_calibrated (fitted to the paper, `docs/controllers.md`)."""
    lookahead_s: float | None = Field(None, ge=0.2, le=5)
    """How far ahead the car aims, in seconds of driving. This key and the three below replace the preset's values."""
    steering_limit_rad: float | None = Field(None, gt=0, le=0.5)
    """The limit of the angle of the road wheels."""
    lateral_limit_mps2: float | None = Field(None, gt=0, le=20)
    """The limit of the lateral acceleration that the controller's steering causes."""
    speed_mps: float | None = Field(None, ge=1, le=MAX_SIMULATED_MPS)
    """The target speed. The vehicle allows no throttle above `safety.speed_limit_mps`, which is at most 40 km/h for a
    vehicle that is not simulated."""
    wheelbase_m: float = Field(2.8448, gt=0.5, lt=10)
    """The wheelbase of the driven vehicle; by default the built-in car's."""
    rearm: bool = False
    """Arm automatically after a safe stop, and after a restart of the server, but not after an emergency stop
    (`docs/session.md`)."""
    clear_emergency_stop: bool = False
    """Clear the emergency stop that exists when the client starts, and no later one; set this only after its cause has
    been removed."""

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that replace the preset's values."""
        settings = ("lookahead_s", "steering_limit_rad", "lateral_limit_mps2", "speed_mps")
        return {name: value for name in settings if (value := getattr(self, name)) is not None}

    @property
    def settings(self) -> str:
        """The preset's name and the changed settings, as results show them."""
        return ", ".join([self.preset, *(f"{name} {value:g}" for name, value in self.changes.items())])
