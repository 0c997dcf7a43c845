"""The schema of the config section `safety.governor`."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Final

from pydantic import Field, model_validator

from lavt.config.section import Section

MAX_GOVERNED_MPS: Final = 22.3
"""The largest speed in a table of delay margins, a little above 80 km/h."""

_Speed = Annotated[float, Field(gt=0, le=MAX_GOVERNED_MPS)]
_Delay = Annotated[float, Field(ge=0, le=5000)]


class GovernorConfig(Section):
    """The speed governor: the vehicle's highest speed by the measured picture age, see `docs/governor.md`."""

    enabled: bool = False
    """Whether the vehicle has a speed governor."""
    latency_limit_ms: float = Field(200.0, gt=0, le=2000)
    """Above this picture age, the speed is at most nominal speed x this limit / picture age."""
    nominal_mps: float | None = Field(None, gt=0, le=MAX_GOVERNED_MPS)
    """The speed at which `latency_limit_ms` is acceptable; null: `safety.speed_limit_mps`."""
    sight_m: float = Field(20.0, gt=0, le=1000)
    """The distance ahead of the car in which the driver recognizes an obstacle; shorter in fog or at night."""
    braking_mps2: float = Field(4.0, gt=0, le=10)
    """The deceleration with which the car stops in front of an obstacle."""
    brake_delay_ms: float = Field(200.0, ge=0, le=5000)
    """The vehicle's own delay between a command to brake and the deceleration."""
    reaction_ms: float = Field(0.0, ge=0, le=5000)
    """The reaction time of the person who drives, which the picture age does not contain; 0 for a controller."""
    delay_margin: tuple[tuple[_Speed, _Delay], ...] = ()
    """Pairs of a speed in m/s and the longest delay in ms that the driver or controller tolerates at this speed, as in
    `[[5, 400], [8, 300]]`; empty: no such limit. The quantile `tail` is compared with them. No speed above the last
    one is allowed, and with an age above the first delay none at all."""
    window_s: float = Field(5.0, ge=0.5, le=60)
    """The picture ages of this time count."""
    tail: float = Field(0.95, ge=0.5, le=1)
    """The quantile of these ages that counts; 1: their maximum. The present picture age always counts."""
    rise_mps2: float = Field(0.5, gt=0, le=5)
    """How fast the limit rises."""
    hysteresis_mps: float = Field(0.5, ge=0, le=5)
    """The limit begins to rise when a limit that is higher by this is allowed."""

    @model_validator(mode="after")
    def _check_delay_margin(self) -> GovernorConfig:
        for (slow_mps, slow_ms), (fast_mps, fast_ms) in pairwise(self.delay_margin):
            if fast_mps <= slow_mps or fast_ms > slow_ms:
                raise ValueError(
                    "delay_margin must have growing speeds with delays that do not grow, such as [[5, 400], [8, 300]]: "
                    "correct it"
                )
        return self
