"""The limits that the client enforces on itself, each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from lavt.domain import NS_PER_MS


@dataclass(frozen=True, slots=True)
class ClientLimits:
    """The limits that the client enforces on itself."""

    no_picture_brake_ns: int = 300 * NS_PER_MS
    """Without a new picture for this long: brake. The vehicle has the same limit, so both begin to brake together."""
    no_picture_stop_ns: int = 2500 * NS_PER_MS
    """Without a new picture for this long: request a safe stop."""
    no_state_brake_ns: int = 300 * NS_PER_MS
    """Without a newer state of the vehicle for this long: brake. By then 15 states are missing, and the speed that the
    controller uses is 300 ms old. A state is newer if its own time, on the vehicle's clock, is later."""
    no_state_stop_ns: int = 2500 * NS_PER_MS
    """Without a newer state of the vehicle for this long: request a safe stop."""
    no_lane_brake_ns: int = 500 * NS_PER_MS
    """Without a lane for this long: brake. At 30 km/h the car has driven 4 m by then, of the 16 m of lane that it saw
    last."""
    no_lane_stop_ns: int = 2500 * NS_PER_MS
    """Without a lane for this long: request a safe stop. By then, 2 s of braking have slowed the simulator's car from
    30 km/h to 0.9 m/s, 14 m beyond the place where it saw the last lane. The last path has 20 m."""
    command_period_ns: int = 20 * NS_PER_MS
    """Longest interval between commands."""
    brake: float = 0.67
    """Brake pedal while pictures, states or lanes are missing: 4 m/s2 on a car with 6 m/s2 at full pedal."""


CLIENT_LIMITS = ClientLimits()
