"""The last thing before the vehicle: limits of steering and speed that hold whatever is asked."""

from __future__ import annotations

import math

from lavt.control.driver_limits import CLIENT_LIMITS
from lavt.domain import NS_PER_S, Actuation, VehicleState
from lavt.safety.limits import Limits

COMMAND_PERIOD_S = CLIENT_LIMITS.command_period_ns / NS_PER_S
"""A change of steering that the wheel may reach within this is not called changed by the limit of its rate."""


class Limiter:
    """Keeps what is asked within the limits, and tells which of them changed it.

    `wheelbase_m`, `max_steering_rad` and `max_braking_mps2` are the vehicle's own.
    """

    def __init__(self, limits: Limits, *, wheelbase_m: float, max_steering_rad: float, max_braking_mps2: float) -> None:
        self.limits = limits
        self.max_braking_mps2 = max_braking_mps2
        self.changed: tuple[str, ...] = ()
        """Names of the limits that changed what was last asked."""
        self.wheelbase_m = wheelbase_m
        self._max_steering_rad = max_steering_rad
        self._steering_rad: float | None = None
        self._at_ns = 0

    def start(self, steering_rad: float, now_ns: int) -> None:
        """Begin from where the wheel is."""
        self._steering_rad, self._at_ns = steering_rad, now_ns

    def target_rad(self, vehicle: VehicleState) -> float:
        """Last steering target; before the first one, where the wheel is."""
        return vehicle.steering_rad if self._steering_rad is None else self._steering_rad

    def limit(
        self, requested: Actuation, vehicle: VehicleState, now_ns: int, picture_age_ns: int | None = None
    ) -> Actuation:
        """Bring `requested` within the limits at the vehicle's speed; the wheel turns no faster than the rate allows.

        `picture_age_ns` is the age of the picture that `requested` was made from; None: of no picture.
        """
        before_rad = self.target_rad(vehicle)
        step_rad = self.limits.steering_rate_radps * max(0, now_ns - self._at_ns) / NS_PER_S
        if self._steering_rad is None:
            step_rad = 0.0
        changed = []
        steering_rad = requested.steering_rad
        bound_rad = self._max_steering_rad
        if not -bound_rad <= steering_rad <= bound_rad:
            changed.append("steering angle")
            steering_rad = min(max(steering_rad, -bound_rad), bound_rad)
        bound_rad = self._lateral_limit_rad(vehicle.speed_mps)
        if not -bound_rad <= steering_rad <= bound_rad:
            changed.append("lateral acceleration")
            steering_rad = min(max(steering_rad, -bound_rad), bound_rad)
        reached_rad = steering_rad
        if not before_rad - step_rad <= steering_rad <= before_rad + step_rad:
            reached_rad = min(max(steering_rad, before_rad - step_rad), before_rad + step_rad)
            if abs(steering_rad - before_rad) > self.limits.steering_rate_radps * COMMAND_PERIOD_S:
                changed.append("steering rate")
        throttle = requested.throttle
        known = math.isfinite(vehicle.speed_mps)
        if throttle > 0 and not (known and vehicle.speed_mps <= self.limits.speed_limit_mps):
            throttle = 0.0
            changed.append("speed")
        brake = requested.brake
        if picture_age_ns is not None and known:
            excess_mps = vehicle.speed_mps - stopping_speed_limit_mps(picture_age_ns / NS_PER_S, self.limits)
            least = self._stopping_distance_brake(excess_mps)
            if excess_mps > 0 and (throttle > 0 or brake < least):
                throttle, brake = 0.0, max(brake, least)
                changed.append("sight")
        self._steering_rad, self._at_ns = reached_rad, max(now_ns, self._at_ns)
        self.changed = tuple(changed)
        return Actuation(reached_rad, throttle, brake)

    def _stopping_distance_brake(self, excess_mps: float) -> float:
        """Pedal that takes the excess away in the settling time, at most that of a safe stop."""
        deceleration_mps2 = min(excess_mps / self.limits.stopping_brake_settling_s, self.limits.stop_deceleration_mps2)
        return min(1.0, deceleration_mps2 / self.max_braking_mps2)

    def _lateral_limit_rad(self, speed_mps: float) -> float:
        """Road wheel angle at which the kinematic car has the lateral acceleration limit: v^2 tan(angle) / L.

        A speed that is no number counts as the highest.
        """
        if not math.isfinite(speed_mps):
            speed_mps = self.limits.speed_limit_mps
        if abs(speed_mps) < 0.1:
            return math.pi / 2
        return math.atan(self.wheelbase_m * self.limits.lateral_acceleration_mps2 / speed_mps**2)


def stopping_speed_limit_mps(picture_age_s: float, limits: Limits) -> float:
    """Speed from which the car comes to stand on the path that it was shown, should no other command come.

    It has gone on for the picture's age, goes on until the safe stop begins, and brakes: the speed v solves
    v (age + `stop_after`) + v^2 / (2 `stop_deceleration`) = `sight`. The older the picture, the less.
    """
    blind_s = picture_age_s + limits.stop_after_ns / NS_PER_S
    braking_mps2 = limits.stop_deceleration_mps2
    return braking_mps2 * (math.sqrt(blind_s * blind_s + 2 * limits.stopping_distance_limit_m / braking_mps2) - blind_s)
