"""What LAVT needs of a vehicle. Only the actuator node calls it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from lavt.domain import Actuation, GroundTruth, VehicleEvent, VehicleState


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a vehicle is and can do."""

    simulated: bool
    virtual_time: bool
    """It can be driven in virtual time."""
    ground_truth: bool
    reset: bool
    wheelbase_m: float
    max_steering_rad: float
    max_steering_rate_radps: float
    max_acceleration_mps2: float
    """Acceleration at throttle 1."""
    max_braking_mps2: float
    """Deceleration at brake 1, positive."""


class Vehicle(Protocol):
    """A car that can be driven by command."""

    @property
    def capabilities(self) -> Capabilities:
        """What this vehicle is and can do."""
        ...

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Live on to `to_ns` (server's monotonic clock) and return what happened on the way, in order."""
        ...

    def apply(self, actuation: Actuation, now_ns: int) -> None:
        """Obey `actuation` from `now_ns` on, until the next one."""
        ...

    def state(self) -> VehicleState:
        """Tell the newest state the vehicle reports of itself."""
        ...

    def ground_truth(self) -> GroundTruth | None:
        """Tell the truth, where there is one (`capabilities.ground_truth`)."""
        ...

    def next_wake_ns(self) -> int:
        """Tell when the vehicle wants `advance` called next."""
        ...
