"""All limits of safety in one place, each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from lavt.domain import NS_PER_MS, NS_PER_S, PATH_POINTS, PATH_STEP_M


@dataclass(frozen=True, slots=True)
class Limits:
    """What the vehicle side holds, whatever is asked."""

    degraded_after_ns: int = 300 * NS_PER_MS
    """Without a command from a newer picture: degraded. Nine frames at 30 Hz; peers' watchdogs are 100 to 500 ms."""
    stop_after_ns: int = 500 * NS_PER_MS
    """Without a command from a newer picture: safe stop. At 30 km/h the car has gone 4 m blind."""
    degraded_deceleration_mps2: float = 1.0
    """Gentle: most silences end by themselves."""
    stop_deceleration_mps2: float = 4.0
    """From 30 km/h to standstill in 2.1 s and 9 m, and leaves grip for steering."""
    stopping_distance_limit_m: float = PATH_STEP_M * PATH_POINTS
    """The stopping distance must lie on the path in the command (`stopping_speed_limit_mps`). Only a simulated vehicle
    may be configured beyond it, to study higher speeds and delays."""
    stopping_brake_settling_s: float = 0.25
    """Speed beyond that is braked away so fast. The brake's lag is 0.2 s: quicker would swing, and 1 m/s too much
    already brakes like a safe stop, which is the most."""
    picture_age_limit_ns: int = 500 * NS_PER_MS
    """A command from an older picture is refused. Only a simulated vehicle may be configured up to 2 s."""
    stamp_memory_ns: int = 5 * NS_PER_S
    """For how long the server knows the stamps that it wrote."""
    lateral_acceleration_mps2: float = 3.0
    """As in openpilot (ISO 11270); a simulated vehicle may be configured up to 6."""
    steering_rate_radps: float = 0.8
    """Road wheel; above what the cars we know can do (0.53), so that it stops only what is wrong."""
    speed_limit_mps: float = 40 / 3.6
    """No throttle above it; the controllers drive 30 km/h."""
    arming_hold_ns: int = NS_PER_S
    """For how long all conditions of arming must hold."""
    handover_request_timeout_ns: int = 3 * NS_PER_S
    """Who asks for the vehicle asks again each second; after three that did not come it counts as gone."""
    kept_ns: int = 5 * NS_PER_S
    """So long a released vehicle is kept for who asked: it tries each second, and one reply may be lost."""
    arming_brake: float = 0.3
    """The brake counts as on from here."""
    arming_steering_rad: float = 0.1
    """Up to here the steering input counts as neutral."""
    standstill_mps: float = 0.05
    """Below it the vehicle stands."""
    frozen_frames: int = 5
    """Equal pictures in a row that make a camera fault."""


LIMITS = Limits()
