"""What LAVT needs of a vehicle. Only the actuator node calls it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from lavt.domain import Actuation, GroundTruth, VehicleEvent, VehicleState
from lavt.value import value


@value
class ReachedCommand:
    """At `reached_ns` the vehicle said that it steers by what was applied at `applied_ns`."""

    applied_ns: int
    reached_ns: int


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

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Be ready to obey, or need not be any more; may be called again and again.

        A vehicle that takes time for it says in its state when it is engaged. One that is not wanted any more obeys
        nothing but a brake, and holds itself once it stands.
        """
        ...

    def take_reached(self) -> list[ReachedCommand]:
        """Take what of the applied was seen to reach the wheels since the last call; empty where it cannot be seen."""
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


@runtime_checkable
class CountingVehicle(Vehicle, Protocol):
    """A vehicle that counts what goes wrong on the way to it; the others need not."""

    @property
    def counts(self) -> Mapping[str, int]:
        """What was counted so far; for the record."""
        ...
