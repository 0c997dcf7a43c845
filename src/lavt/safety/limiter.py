"""The last stage before the vehicle: limits of steering, throttle and brake for every command."""

from __future__ import annotations

import math

from lavt.control.client_limits import CLIENT_LIMITS
from lavt.domain import MAX_REPORTED_MPS, NS_PER_S, Actuation, VehicleState
from lavt.errors import UserError
from lavt.safety.limits import Limits
from lavt.safety.speed_limit import SpeedLimit

COMMAND_PERIOD_S = CLIENT_LIMITS.command_period_ns / NS_PER_S
"""A steering change that the rate limit allows in this time is not reported as limited."""


class Limiter:
    """A limiter that keeps each requested actuation within the limits, and names the limits that changed the request.

    All numbers are properties of the vehicle, the accelerations those at full pedals. Raises `UserError` unless they
    are positive and finite.
    """

    def __init__(
        self,
        limits: Limits,
        *,
        wheelbase_m: float,
        max_steering_rad: float,
        max_acceleration_mps2: float,
        max_braking_mps2: float,
    ) -> None:
        properties = (wheelbase_m, max_steering_rad, max_acceleration_mps2, max_braking_mps2)
        if not all(0 < number < math.inf for number in properties):
            raise UserError(
                "wheelbase, largest steering angle and accelerations of a vehicle must be positive numbers: correct "
                "them in the vehicle's capabilities"
            )
        self.limits = limits
        self.max_braking_mps2 = max_braking_mps2
        self.applied_limits: tuple[str, ...] = ()
        """Names of the limits that changed the last request."""
        self.wheelbase_m = wheelbase_m
        self._max_acceleration_mps2 = max_acceleration_mps2
        self._max_steering_rad = max_steering_rad
        self._steering_rad: float | None = None
        self._at_ns = 0

    def reset(self, steering_rad: float, now_ns: int) -> None:
        """Take the present angle of the wheels as the last steering target; ignore an angle that is not finite."""
        if math.isfinite(steering_rad):
            self._steering_rad, self._at_ns = steering_rad, now_ns

    def target_rad(self, vehicle: VehicleState) -> float:
        """Return the last steering target; before the first target, the wheels' angle, or 0 if that is not finite."""
        if self._steering_rad is not None:
            return self._steering_rad
        return vehicle.steering_rad if math.isfinite(vehicle.steering_rad) else 0.0

    def limit(
        self,
        requested: Actuation,
        vehicle: VehicleState,
        now_ns: int,
        picture_age_ns: int | None = None,
        governed: SpeedLimit | None = None,
    ) -> Actuation:
        """Return `requested` within the limits at the vehicle's present speed; all values are finite.

        `picture_age_ns` is the age of the picture from which `requested` was made; None without a picture. `governed`
        is the limit of the speed governor, if the vehicle has one.
        """
        before_rad = self.target_rad(vehicle)
        step_rad = self.limits.steering_rate_radps * max(0, now_ns - self._at_ns) / NS_PER_S
        if self._steering_rad is None:
            step_rad = 0.0
        changed = []
        if not all(map(math.isfinite, (requested.steering_rad, requested.throttle, requested.brake))):
            changed.append("not finite")
            requested = Actuation(before_rad, 0.0, 1.0)
        steering_rad = requested.steering_rad
        bound_rad = self._max_steering_rad
        if not -bound_rad <= steering_rad <= bound_rad:
            changed.append("steering angle")
            steering_rad = min(max(steering_rad, -bound_rad), bound_rad)
        is_speed_known = vehicle.is_speed_plausible and abs(vehicle.speed_mps) <= MAX_REPORTED_MPS
        bound_rad = self._lateral_limit_rad(vehicle.speed_mps, is_speed_known)
        if not -bound_rad <= steering_rad <= bound_rad:
            changed.append("lateral acceleration")
            steering_rad = min(max(steering_rad, -bound_rad), bound_rad)
        rate_limited_rad = steering_rad
        if not before_rad - step_rad <= steering_rad <= before_rad + step_rad:
            rate_limited_rad = min(max(steering_rad, before_rad - step_rad), before_rad + step_rad)
            if abs(steering_rad - before_rad) > self.limits.steering_rate_radps * COMMAND_PERIOD_S:
                changed.append("steering rate")
        throttle = requested.throttle
        if throttle > 0 and not (is_speed_known and abs(vehicle.speed_mps) <= self.limits.speed_limit_mps):
            throttle = 0.0
            changed.append("speed")
        brake = requested.brake
        if governed is not None and is_speed_known:
            pedals = self._governed_pedals(throttle, brake, governed.mps - abs(vehicle.speed_mps))
            if pedals != (throttle, brake):
                throttle, brake = pedals
                changed.append(governed.reason)
        if picture_age_ns is not None and is_speed_known:
            excess_mps = abs(vehicle.speed_mps) - self.stopping_limit(picture_age_ns).mps
            minimum_brake = self._stopping_distance_brake(excess_mps)
            if excess_mps > 0 and (throttle > 0 or brake < minimum_brake):
                throttle, brake = 0.0, max(brake, minimum_brake)
                changed.append("stopping distance")
        # The wheels can be beyond the vehicle's limit when the first command arrives.
        target_rad = min(max(rate_limited_rad, -self._max_steering_rad), self._max_steering_rad)
        self._steering_rad, self._at_ns = target_rad, max(now_ns, self._at_ns)
        self.applied_limits = tuple(changed)
        return Actuation(target_rad, throttle, brake)

    def stopping_limit(self, picture_age_ns: int) -> SpeedLimit:
        """Return the speed limit of the stopping distance, for a command from a picture of this age."""
        age_s = picture_age_ns / NS_PER_S
        return SpeedLimit(
            stopping_speed_limit_mps(age_s, self.limits, self._max_acceleration_mps2), "stopping distance"
        )

    def _governed_pedals(self, throttle: float, brake: float, below_mps: float) -> tuple[float, float]:
        """Return throttle and brake with which the speed approaches a limit that it is below by `below_mps`.

        The acceleration is at most the one with which the speed is at the limit after the settling time. Above the
        limit, it is a deceleration of at most `governor_deceleration_mps2`.
        """
        acceleration_mps2 = below_mps / self.limits.stopping_brake_settling_s
        if acceleration_mps2 >= 0:
            return min(throttle, acceleration_mps2 / self._max_acceleration_mps2), brake
        deceleration_mps2 = min(-acceleration_mps2, self.limits.governor_deceleration_mps2)
        return 0.0, max(brake, min(1.0, deceleration_mps2 / self.max_braking_mps2))

    def _stopping_distance_brake(self, excess_mps: float) -> float:
        """Return the pedal that removes the excess speed in the settling time, at most the pedal of a safe stop."""
        deceleration_mps2 = min(excess_mps / self.limits.stopping_brake_settling_s, self.limits.stop_deceleration_mps2)
        return min(1.0, deceleration_mps2 / self.max_braking_mps2)

    def _lateral_limit_rad(self, speed_mps: float, is_known: bool) -> float:
        """Return the road wheel angle at which the lateral acceleration v^2 tan(angle) / wheelbase is at its limit.

        An unknown speed is assumed to be the speed limit, or the reported speed if this is higher and possible.
        """
        if not is_known:
            reported_mps = abs(speed_mps) if abs(speed_mps) <= MAX_REPORTED_MPS else 0.0
            speed_mps = max(reported_mps, self.limits.speed_limit_mps)
        if abs(speed_mps) < 0.1:  # so slow that no angle reaches the limit
            return math.pi / 2
        return math.atan(self.wheelbase_m * self.limits.lateral_acceleration_mps2 / (speed_mps * speed_mps))


def stopping_speed_limit_mps(picture_age_s: float, limits: Limits, max_acceleration_mps2: float) -> float:
    """Return the highest speed from which the car stops on the path of its last command, if no other command follows.

    The path begins where the picture was taken. From there the car has driven for the picture's age. It drives on for
    `stop_after` until the safe stop begins, and then brakes. Until the vehicle is degraded, the last command can give
    full throttle. So the speed v at the command can become w = v + `max_acceleration` x `degraded_after`. The car stops
    on the path if w (age + `stop_after`) + w^2 / (2 `stop_deceleration`) is at most `stopping_distance_limit`. For an
    older picture the returned speed is lower.
    """
    unguided_s = picture_age_s + limits.stop_after_ns / NS_PER_S
    braking_mps2 = limits.stop_deceleration_mps2
    highest_mps = braking_mps2 * (
        math.sqrt(unguided_s * unguided_s + 2 * limits.stopping_distance_limit_m / braking_mps2) - unguided_s
    )
    return max(0.0, highest_mps - max_acceleration_mps2 * limits.degraded_after_ns / NS_PER_S)
