"""The schema of the config section `controller`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pydantic import Field, model_validator

from lavt.config.section import Section
from lavt.config.vehicle import MAX_SIMULATED_MPS
from lavt.control.compensation import VARIANTS, CompensationSettings, average_lag_s
from lavt.control.preset import Preset, find_preset
from lavt.control.two_point import TWO_POINT, TwoPointSettings

HUMAN = "human"
"""The kind of controller with which a person drives."""
AGENT = "agent"
"""The kind of controller with which an agent drives in a Gymnasium environment."""


_MODEL = TwoPointSettings()
_COMPENSATION = CompensationSettings()


class TwoPointConfig(Section):
    """The model of a human driver, for `controller.kind` two_point. Gains are for the angle of the steering wheel."""

    far_gain: float = Field(_MODEL.far_gain, ge=0, le=100)
    """Change of the steering wheel's angle for each change of the far point's visual angle."""
    near_gain: float = Field(_MODEL.near_gain, ge=0, le=100)
    """The same for the near point."""
    near_integral_gain_per_s: float = Field(_MODEL.near_integral_gain_per_s, ge=0, le=100)
    """Rate of the steering wheel's angle for each angle of the near point."""
    near_angle_limit_rad: float = Field(_MODEL.near_angle_limit_rad, gt=0, le=1.5)
    """The largest near angle for which this rate grows."""
    near_point_m: float = Field(_MODEL.near_point_m, gt=4, le=20)
    """Distance of the near point from the rear axle."""
    far_point_s: float = Field(_MODEL.far_point_s, gt=0, le=10)
    """Distance of the far point in seconds of driving. It is never beyond the lane that is seen."""
    far_point_min_m: float = Field(_MODEL.far_point_min_m, gt=4, le=100)
    """The smallest distance of the far point, if the lane is seen as far as this."""
    eye_ahead_m: float = Field(_MODEL.eye_ahead_m, ge=0, le=3.5)
    """Position of the driver's eye ahead of the rear axle; by default that of the built-in camera."""
    steering_ratio: float = Field(_MODEL.steering_ratio, ge=1, le=40)
    """Angle of the steering wheel for each angle of the road wheels; by default the built-in car's."""
    reaction_delay_s: float = Field(_MODEL.reaction_delay_s, ge=0, le=2)
    """Time from seeing a picture to the beginning of the movement that it causes."""
    neuromuscular_lag_s: float = Field(_MODEL.neuromuscular_lag_s, ge=0, le=2)
    """Time constant with which the arms follow."""
    noise_rad: float = Field(_MODEL.noise_rad, ge=0, le=0.1)
    """Standard deviation of the noise of both visual angles. The noise depends on the seed of the run."""

    @model_validator(mode="after")
    def _check_points(self) -> TwoPointConfig:
        if self.far_point_min_m < self.near_point_m:
            raise ValueError("far_point_min_m must be at least near_point_m: the far point is not before the near one")
        return self

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that differ from the defaults."""
        return {name: value for name, value in self.model_dump().items() if value != getattr(_MODEL, name)}


class PredictionConfig(Section):
    """The predictive display, for `controller.kind` human (`docs/drive.md`), and what it knows of the vehicle."""

    shown: bool = False
    """Whether the page draws the predicted path, the car at its end, and the stopping line."""
    front_m: float = Field(3.89, gt=0, lt=20)
    """Distance from the rear axle to the front of the vehicle; by default the built-in car's."""
    rear_m: float = Field(1.043, ge=0, lt=20)
    """Distance from the rear axle to the rear of the vehicle; by default the built-in car's."""
    width_m: float = Field(1.86, gt=0, lt=5)
    """Width of the vehicle; by default the built-in car's."""
    steering_lag_s: float = Field(0.12, ge=0, le=2)
    """Time constant with which the wheels follow a command; by default the built-in car's."""


class CompensationConfig(Section):
    """The controllers that know the delay of their loop (`docs/compensation.md`), and what they know of the vehicle."""

    steering_lag_s: float = Field(_COMPENSATION.steering_lag_s, ge=0, le=2)
    """Time constant with which the wheels follow a command; by default the built-in car's."""
    steering_dead_time_s: float = Field(_COMPENSATION.steering_dead_time_s, ge=0, le=2)
    """Time until the wheels begin to follow a command."""
    steering_rate_radps: float = Field(_COMPENSATION.steering_rate_radps, gt=0, le=10)
    """The largest rate of the wheels' angle; by default the built-in car's."""
    camera_delay_s: float = Field(_COMPENSATION.camera_delay_s, ge=0, le=1)
    """Time from the exposure of a picture to its stamp; by default the built-in camera's."""
    average_lag_s: float | None = Field(None, ge=0, le=1)
    """By how much the lane detector's moving average makes the lane older; null: two thirds of the time between
    pictures, to 1 ms."""
    delay_error_s: float = Field(_COMPENSATION.delay_error_s, ge=-1, le=1)
    """Added to the measured delay, to show what a wrong estimate costs."""
    constant_delay_s: float = Field(_COMPENSATION.constant_delay_s, ge=0, le=3)
    """The total delay that the kind `constant_delay` assumes, from the exposure until a command takes effect."""

    @property
    def changes(self) -> dict[str, Any]:
        """Settings that differ from the defaults."""
        known = {name: value for name, value in self.model_dump().items() if value is not None}
        return {name: value for name, value in known.items() if value != getattr(_COMPENSATION, name)}

    def settings_at(self, rate_hz: float) -> CompensationSettings:
        """Return what the controller knows of a car and of a camera with this frame rate."""
        known = {name: value for name, value in self.model_dump().items() if value is not None}
        return CompensationSettings(**{"average_lag_s": average_lag_s(rate_hz), **known})


class ControllerConfig(Section):
    """The controller that drives."""

    kind: str = "lane_keeper"
    """lane_keeper: the built-in controller; predictive, smith, constant_delay, scheduled_lookahead and slow_down: lane
    keepers that know the delay (`docs/compensation.md`); two_point: a model of a human driver; human: a person drives
    from a web page (`docs/drive.md`); agent: an agent drives in a Gymnasium environment, which sets this value
    (`docs/gym.md`); or the name of your own (`docs/controllers.md`)."""
    preset: str = "designed"
    """The set of gains: designed (found by theory) or paper_calibrated (fitted to the paper, `docs/controllers.md`)."""
    lookahead_s: float | None = Field(None, ge=0.2, le=5)
    """How far ahead the car aims, in seconds of driving. This key and the four below replace the preset's values."""
    steering_limit_rad: float | None = Field(None, gt=0, le=0.5)
    """The limit of the angle of the road wheels."""
    lateral_limit_mps2: float | None = Field(None, gt=0, le=20)
    """The limit of the lateral acceleration that the controller's steering causes."""
    speed_mps: float | None = Field(None, ge=1, le=MAX_SIMULATED_MPS)
    """The target speed. The vehicle allows no throttle above `safety.speed_limit_mps`, which is at most 40 km/h for a
    vehicle that is not simulated."""
    lane_confidence: float | None = Field(None, ge=0.05, le=0.95)
    """The lowest confidence of a lane that is followed, a share of 1; 0.2 in both presets (`docs/perception.md`). A
    picture with less counts as a picture without a lane."""
    two_point: TwoPointConfig = TwoPointConfig()
    compensation: CompensationConfig = CompensationConfig()
    prediction: PredictionConfig = PredictionConfig()
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
        settings = ("lookahead_s", "steering_limit_rad", "lateral_limit_mps2", "speed_mps", "lane_confidence")
        return {name: value for name in settings if (value := getattr(self, name)) is not None}

    def effective_preset(self) -> Preset:
        """Return the preset with the changes; raise `UserError` for an unknown preset."""
        return replace(find_preset(self.preset), **self.changes)

    @property
    def settings(self) -> str:
        """The preset's name and the changed settings, as results show them."""
        changes = dict(self.changes)
        if self.kind == TWO_POINT:
            changes |= {f"two_point.{name}": value for name, value in self.two_point.changes.items()}
        if self.kind in VARIANTS:
            changes |= {f"compensation.{name}": value for name, value in self.compensation.changes.items()}
        shown = ["prediction.shown"] if self.kind == HUMAN and self.prediction.shown else []
        return ", ".join([self.preset, *shown, *(f"{name} {_format(value)}" for name, value in changes.items())])


def _format(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"
