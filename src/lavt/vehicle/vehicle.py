"""The interface between LAVT and a vehicle. Only the actuator node calls it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from msgspec import Struct

from lavt.domain import Actuation, GroundTruth, VehicleEvent, VehicleState


class ReachedCommand(Struct, frozen=True):
    """A command that the vehicle reported as reached: it steers with the command."""

    applied_ns: int
    """Time when the command was applied."""
    reached_ns: int
    """Time of the report."""


@dataclass(frozen=True, slots=True)
class Capabilities:
    """The properties of a vehicle that LAVT depends on."""

    simulated: bool
    virtual_time: bool
    """Whether the vehicle can be driven in virtual time."""
    ground_truth: bool
    """Whether the vehicle knows its true position, as a simulated one does."""
    reset: bool
    """Whether the vehicle can return to its start; not used yet."""
    wheelbase_m: float
    max_steering_rad: float
    max_steering_rate_radps: float
    max_acceleration_mps2: float
    """Acceleration at throttle 1."""
    max_braking_mps2: float
    """Deceleration at brake 1, positive."""


class Vehicle(Protocol):
    """A car that is driven by commands."""

    @property
    def capabilities(self) -> Capabilities:
        """The properties of this vehicle."""
        ...

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Advance to `to_ns` (server's monotonic clock) and return the events since the last call, in order."""
        ...

    def apply(self, actuation: Actuation, now_ns: int) -> None:
        """Apply `actuation` from `now_ns` on, until the next call of this method."""
        ...

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Engage the vehicle if `wanted`, otherwise disengage it. A repeated call with the same `wanted` has no effect.

        A vehicle that needs time to engage reports in its state when it is engaged. A disengaged vehicle accepts no
        command but the brake, and stays in place once it is stationary.
        """
        ...

    def take_reached(self) -> list[ReachedCommand]:
        """Return the commands reported as reached since the last call; empty if the vehicle cannot report them."""
        ...

    def state(self) -> VehicleState:
        """Return the newest state that the vehicle reported."""
        ...

    def ground_truth(self) -> GroundTruth | None:
        """Return the ground truth, or None if the vehicle has none (`capabilities.ground_truth`)."""
        ...

    def next_wake_ns(self) -> int:
        """Return the time by which `advance` should be called next."""
        ...


@runtime_checkable
class CountingVehicle(Vehicle, Protocol):
    """A vehicle that counts errors."""

    @property
    def counts(self) -> Mapping[str, int]:
        """The counters so far, for the record."""
        ...
