"""The limits of the remote driver, each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from lavt.domain import NS_PER_MS


@dataclass(frozen=True, slots=True)
class ClientLimits:
    """The limits that the client enforces on itself."""

    no_picture_brake_ns: int = 300 * NS_PER_MS
    """Without a new picture for this long: brake. The vehicle has the same limit, so both sides brake together."""
    no_picture_stop_ns: int = 2500 * NS_PER_MS
    """Without a new picture for this long: request a safe stop."""
    no_state_brake_ns: int = 300 * NS_PER_MS
    """Without a newer state of the vehicle for this long: brake. The controller then uses a speed of this age, and 15
    states are missing. A state is newer if the time in it, on the vehicle's clock, is later."""
    no_state_stop_ns: int = 2500 * NS_PER_MS
    """Without a newer state of the vehicle for this long: request a safe stop."""
    no_lane_brake_ns: int = 500 * NS_PER_MS
    """Without a lane for this long: brake. At 30 km/h the car has driven 4 m of the 16 m that the last picture shows,
    and a gap between broken marks is over."""
    no_lane_stop_ns: int = 2500 * NS_PER_MS
    """Without a lane for this long: request a safe stop. 2 s of braking have reduced 30 km/h by 6 m/s, and the last
    path is nearly used up."""
    command_period_ns: int = 20 * NS_PER_MS
    """Longest interval between commands."""
    brake: float = 0.67
    """The brake pedal when pictures, states or lanes are missing: 4 m/s2 in a car with 6 m/s2 at full pedal."""


CLIENT_LIMITS = ClientLimits()
