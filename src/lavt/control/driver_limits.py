"""The limits of the remote driver, each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from lavt.domain import NS_PER_MS


@dataclass(frozen=True, slots=True)
class ClientLimits:
    """What the remote side holds itself to."""

    no_picture_brake_ns: int = 300 * NS_PER_MS
    """Without a new picture: brake. It is the vehicle's own limit, so both sides brake together."""
    no_picture_stop_ns: int = 2500 * NS_PER_MS
    """Without a new picture: ask for a safe stop."""
    no_state_brake_ns: int = 300 * NS_PER_MS
    """Without a newer state of the vehicle: brake. The speed it was driven by is as old; 15 states are missing."""
    no_state_stop_ns: int = 2500 * NS_PER_MS
    """Without a newer state of the vehicle: ask for a safe stop."""
    no_lane_brake_ns: int = 500 * NS_PER_MS
    """Without a lane: brake. At 30 km/h 4 m have gone by, of the 16 m that were seen; a gap of broken marks is over."""
    no_lane_stop_ns: int = 2500 * NS_PER_MS
    """Without a lane: ask for a safe stop. 2 s of braking took 6 m/s off 30 km/h; the last path is nearly used up."""
    command_period_ns: int = 20 * NS_PER_MS
    """No longer than this between commands."""
    brake: float = 0.67
    """Pedal when braking for want of a picture: 4 m/s2 on a car that brakes with 6 at full pedal."""


CLIENT_LIMITS = ClientLimits()
