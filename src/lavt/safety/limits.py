"""All safety limits of the vehicle, each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass

from lavt.domain import (
    MAX_REPORTED_MPS,
    MAX_ROAD_WHEEL_RAD,
    NS_PER_MS,
    NS_PER_S,
    PATH_POINTS,
    PATH_STEP_M,
    VehicleState,
)


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits that the vehicle enforces for all commands."""

    degraded_after_ns: int = 300 * NS_PER_MS
    """Without a command from a newer picture for this long: degraded. This is the time of nine frames at 30 Hz; the
    watchdogs of similar systems wait 100 to 500 ms."""
    stop_after_ns: int = 500 * NS_PER_MS
    """Without a command from a newer picture for this long: safe stop. At 30 km/h the car has then gone 4 m without
    guidance."""
    degraded_deceleration_mps2: float = 1.0
    """Deceleration in the state degraded. It is gentle, because most command timeouts end before a safe stop."""
    stop_deceleration_mps2: float = 4.0
    """Deceleration of a safe stop: it stops a car from 30 km/h in 2.1 s and 9 m, and leaves grip for steering."""
    stop_settling_ns: int = 500 * NS_PER_MS
    """Time after the beginning of a safe stop when the planned speed begins to fall: the brake's lag is 0.2 s, and
    reports are up to 0.1 s old."""
    stop_excess_mps: float = 0.5
    """In a safe stop, a vehicle that is faster than planned by this much brakes fully. If it is faster by half as much,
    its brake is halfway between the pedal for `stop_deceleration_mps2` and the full pedal."""
    stopping_distance_limit_m: float = PATH_STEP_M * PATH_POINTS
    """The vehicle must be able to stop in this distance, which is the length of the path in a command
    (`stopping_speed_limit_mps`). For a simulated vehicle the config can set a larger distance, to study higher speeds
    and delays."""
    stopping_brake_settling_s: float = 0.25
    """Time in which the brake removes speed above `stopping_speed_limit_mps`. With a shorter time the speed would
    oscillate, because the brake's lag is 0.2 s. With an excess of 1 m/s or more, the brake is that of a safe stop."""
    governor_deceleration_mps2: float = 2.0
    """The largest deceleration with which the vehicle slows down to a lower limit of the speed governor. It is that of
    an ordinary brake application, because such a limit falls while commands still arrive."""
    picture_age_limit_ns: int = 500 * NS_PER_MS
    """A command from an older picture is rejected. The age is the time between the capture (the stamp, if the camera
    reports no capture time) and the application of the command. For a simulated vehicle the config can set up to
    2 s."""
    stamp_memory_ns: int = 5 * NS_PER_S
    """The server remembers the stamps that it issued for this long."""
    lateral_acceleration_mps2: float = 3.0
    """The limit of openpilot (ISO 11270). For a simulated vehicle the config can set up to 6 m/s2."""
    steering_rate_radps: float = 0.8
    """Rate of the road wheels' angle. The cars we know reach 0.53 rad/s, so only faulty commands exceed this limit."""
    speed_limit_mps: float = 40 / 3.6
    """Above this speed there is no throttle. The controllers drive 30 km/h. For a simulated vehicle the config can set
    up to 80 km/h."""
    arming_hold_ns: int = NS_PER_S
    """All arming conditions must be met for this long."""
    handover_request_timeout_ns: int = 3 * NS_PER_S
    """A handover request is repeated each second; after three missing repetitions it expires."""
    reservation_ns: int = 5 * NS_PER_S
    """After a release, the vehicle is reserved for this long for the client that requested it. This client tries each
    second to acquire control, and replies can be lost."""
    arming_brake: float = 0.3
    """The smallest brake with which the vehicle can be armed."""
    arming_steering_rad: float = 0.1
    """The largest commanded steering angle with which the vehicle can be armed."""
    standstill_mps: float = 0.05
    """The vehicle is stationary if it is slower than this."""
    frozen_frames: int = 5
    """This many equal pictures in a row are a camera fault."""

    @staticmethod
    def is_possible(vehicle: VehicleState) -> bool:
        """Return whether the reported speed and steering angle are finite and not larger than any vehicle's."""
        return abs(vehicle.speed_mps) <= MAX_REPORTED_MPS and abs(vehicle.steering_rad) <= MAX_ROAD_WHEEL_RAD

    def is_stationary(self, vehicle: VehicleState) -> bool:
        """Return whether the vehicle is at standstill; False if its speed is implausible."""
        return vehicle.is_speed_plausible and abs(vehicle.speed_mps) < self.standstill_mps


LIMITS = Limits()
