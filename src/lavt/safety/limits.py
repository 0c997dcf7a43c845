"""All safety limits of the vehicle, each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from lavt.domain import NS_PER_MS, NS_PER_S, PATH_POINTS, PATH_STEP_M, VehicleState


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits that the vehicle enforces, whatever is commanded."""

    degraded_after_ns: int = 300 * NS_PER_MS
    """Without a command from a newer picture for this long: degraded. These are nine frames at 30 Hz; the watchdogs of
    similar systems wait 100 to 500 ms."""
    stop_after_ns: int = 500 * NS_PER_MS
    """Without a command from a newer picture for this long: safe stop. At 30 km/h the car has then gone 4 m without
    guidance."""
    degraded_deceleration_mps2: float = 1.0
    """Deceleration while degraded. It is gentle, because most command timeouts end by themselves."""
    stop_deceleration_mps2: float = 4.0
    """Deceleration of a safe stop: from 30 km/h to standstill in 2.1 s and 9 m. It leaves grip for steering."""
    stop_settling_ns: int = 500 * NS_PER_MS
    """Time from the beginning of a safe stop until the speed must fall: the brake's lag is 0.2 s, and reports are up to
    0.1 s old."""
    stop_excess_mps: float = 0.5
    """If the vehicle in a safe stop is faster than planned by this much, it brakes fully. If it is faster by half as
    much, its brake is halfway between that of `stop_deceleration_mps2` and full."""
    stopping_distance_limit_m: float = PATH_STEP_M * PATH_POINTS
    """The vehicle must be able to stop within this distance, which is the length of the path in a command
    (`stopping_speed_limit_mps`). Only a simulated vehicle may be configured beyond it, to study higher speeds and
    delays."""
    stopping_brake_settling_s: float = 0.25
    """Time within which the brake removes speed above `stopping_speed_limit_mps`. With a shorter time the speed would
    oscillate, because the brake's lag is 0.2 s. An excess of 1 m/s is braked like a safe stop, which is the maximum."""
    picture_age_limit_ns: int = 500 * NS_PER_MS
    """A command from an older picture is rejected. The age counts from the capture, or from the stamp if the camera
    reports no capture time, until the command is applied. Only a simulated vehicle may be configured up to 2 s."""
    stamp_memory_ns: int = 5 * NS_PER_S
    """The server remembers the stamps that it issued for this long."""
    lateral_acceleration_mps2: float = 3.0
    """The limit is that of openpilot (ISO 11270). A simulated vehicle may be configured up to 6 m/s2."""
    steering_rate_radps: float = 0.8
    """Rate of the road wheels' angle. It is above the 0.53 rad/s of the cars we know, so that it limits only faulty
    commands."""
    speed_limit_mps: float = 40 / 3.6
    """Above this speed there is no throttle. The controllers drive 30 km/h."""
    arming_hold_ns: int = NS_PER_S
    """All arming conditions must be met for this long."""
    handover_request_timeout_ns: int = 3 * NS_PER_S
    """A handover request is repeated each second; after three missing repetitions it expires."""
    reservation_ns: int = 5 * NS_PER_S
    """A released vehicle is reserved for the client that requested it for this long. That client tries each second to
    acquire control, and replies may be lost."""
    arming_brake: float = 0.3
    """From this pedal position on, the brake counts as applied for arming."""
    arming_steering_rad: float = 0.1
    """Up to this angle, the steering input counts as neutral for arming."""
    standstill_mps: float = 0.05
    """Below this speed the vehicle is stationary."""
    frozen_frames: int = 5
    """This many equal pictures in a row are a camera fault."""

    def is_stationary(self, vehicle: VehicleState) -> bool:
        """Return whether the vehicle is at standstill; False if its speed is implausible."""
        return vehicle.is_speed_plausible and abs(vehicle.speed_mps) < self.standstill_mps


LIMITS = Limits()
