"""How a car moves: a dynamic bicycle whose tyres saturate, with lag and limits in what drives it.

Above `CarParameters.kinematic_below_mps` side forces follow from the tyres' slip; below, as slip is not defined at
rest, sideways speed and yaw rate go to those of a car that rolls without slip, as fast as the tyres would take them
there at that speed, so that nothing jumps. Plain floats: a step is taken 240 times a second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from lavt.domain import Actuation

GRAVITY_MPS2 = 9.81


RAIL_FRICTION = 0.4
"""Of a car's side on a guard rail or a concrete barrier: our estimate, between sheet on steel and on concrete."""


@dataclass(frozen=True, slots=True)
class CarParameters:
    """A car as numbers; `lavt.vehicle.sim.rendering.cars` has named ones, with where each number is from."""

    wheelbase_m: float
    rear_axle_to_front_m: float
    rear_axle_to_rear_m: float
    body_width_m: float
    """Without mirrors."""
    front_axle_to_gravity_m: float
    mass_kg: float
    yaw_inertia_kgm2: float
    front_stiffness_nprad: float
    rear_stiffness_nprad: float
    """Side force of an axle for each radian of slip."""
    friction: float
    max_steering_rad: float
    max_steering_rate_radps: float
    steering_dead_time_s: float
    """From a command until the wheels begin to follow it."""
    steering_lag_s: float
    """Time constant with which they follow."""
    pedal_dead_time_s: float
    throttle_lag_s: float
    brake_lag_s: float
    max_acceleration_mps2: float
    max_braking_mps2: float
    rolling_resistance_mps2: float
    drag_per_m: float
    """Deceleration by air for each (m/s) squared."""
    kinematic_below_mps: float


@dataclass(frozen=True, slots=True)
class Contact:
    """A point of the body that has got into something that does not give way."""

    ahead_m: float
    left_m: float
    """Of the rear axle, in the car's frame."""
    depth_m: float
    out_rad: float
    """Direction back out, in the world's frame."""


@dataclass(slots=True)
class CarMotion:
    """State of a car: the rear axle's place in the world's frame, speeds of the body, and what drives it now."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float = 0.0
    """Forward."""
    side_speed_mps: float = 0.0
    """Of the centre of gravity, left positive."""
    yaw_rate_radps: float = 0.0
    steering_rad: float = 0.0
    throttle: float = 0.0
    brake: float = 0.0


class CarDynamics:
    """A car with parameters, stepped in time steps of one length."""

    def __init__(self, parameters: CarParameters, motion: CarMotion, step_s: float) -> None:
        self.parameters, self.motion = parameters, motion
        self._step_s = step_s
        self._last_request: Actuation | None = None
        self._target = Actuation(0.0, 0.0, 0.0)
        self._to_rear_m = parameters.wheelbase_m - parameters.front_axle_to_gravity_m
        weight_n = parameters.mass_kg * GRAVITY_MPS2 / parameters.wheelbase_m
        self._front_grip_n = parameters.friction * weight_n * self._to_rear_m
        self._rear_grip_n = parameters.friction * weight_n * parameters.front_axle_to_gravity_m
        self._throttle_factor = _lag_factor(step_s, parameters.throttle_lag_s)
        self._brake_factor = _lag_factor(step_s, parameters.brake_lag_s)
        self._steering_factor = _lag_factor(step_s, parameters.steering_lag_s)
        self._max_steering_change_rad = parameters.max_steering_rate_radps * step_s
        # At the speed where the models meet, tyres take the car to rolling without slip with this rate (1/s).
        stiffness = parameters.front_stiffness_nprad + parameters.rear_stiffness_nprad
        settling = stiffness / (parameters.mass_kg * parameters.kinematic_below_mps)
        self._rolling_factor = 1.0 - math.exp(-step_s * settling)

    def _clamp(self, target: Actuation) -> Actuation:
        max_rad = self.parameters.max_steering_rad
        return Actuation(
            steering_rad=min(max(target.steering_rad, -max_rad), max_rad),
            throttle=min(max(target.throttle, 0.0), 1.0),
            brake=min(max(target.brake, 0.0), 1.0),
        )

    def step(self, target: Actuation) -> None:
        """Live on for one time step under `wanted`; values out of range are taken as the nearest in range."""
        if target is not self._last_request:  # the same for many steps
            self._last_request, self._target = target, self._clamp(target)
        # Everything is read and written once: this is a tenth of what virtual time takes without pixels.
        target, parameters, motion, step_s = self._target, self.parameters, self.motion, self._step_s
        speed_mps, side_speed_mps, yaw_rate_radps = motion.speed_mps, motion.side_speed_mps, motion.yaw_rate_radps
        throttle = motion.throttle + (target.throttle - motion.throttle) * self._throttle_factor
        brake = motion.brake + (target.brake - motion.brake) * self._brake_factor
        max_change_rad = self._max_steering_change_rad
        change_rad = (target.steering_rad - motion.steering_rad) * self._steering_factor
        if change_rad > max_change_rad:
            change_rad = max_change_rad
        elif change_rad < -max_change_rad:
            change_rad = -max_change_rad
        steering_rad = motion.steering_rad + change_rad
        motion.throttle, motion.brake, motion.steering_rad = throttle, brake, steering_rad
        acceleration = (
            throttle * parameters.max_acceleration_mps2
            - brake * parameters.max_braking_mps2
            - parameters.rolling_resistance_mps2
            - parameters.drag_per_m * speed_mps * speed_mps
        )
        if speed_mps >= parameters.kinematic_below_mps:
            side_acceleration, yaw_acceleration, drag = self._tyre_accelerations()
            acceleration = acceleration - drag + side_speed_mps * yaw_rate_radps
            side_acceleration -= speed_mps * yaw_rate_radps
            side_speed_mps += side_acceleration * step_s
            yaw_rate_radps += yaw_acceleration * step_s
        else:
            rolling_radps = speed_mps * math.tan(steering_rad) / parameters.wheelbase_m
            yaw_rate_radps += (rolling_radps - yaw_rate_radps) * self._rolling_factor
            side_speed_mps += (rolling_radps * self._to_rear_m - side_speed_mps) * self._rolling_factor
        # Brakes and resistance stop a car, they do not drive it backwards.
        speed_mps = max(0.0, speed_mps + acceleration * step_s)
        motion.speed_mps, motion.side_speed_mps, motion.yaw_rate_radps = speed_mps, side_speed_mps, yaw_rate_radps
        # The rear axle moves with the heading of the middle of the step.
        rear_side_mps = side_speed_mps - self._to_rear_m * yaw_rate_radps
        turn_rad = yaw_rate_radps * step_s
        middle_rad = motion.heading_rad + turn_rad / 2
        cosine, sine = math.cos(middle_rad), math.sin(middle_rad)
        motion.x_m += (speed_mps * cosine - rear_side_mps * sine) * step_s
        motion.y_m += (speed_mps * sine + rear_side_mps * cosine) * step_s
        motion.heading_rad += turn_rad

    def stop(self) -> None:
        """Take all speed away, as a wall does."""
        motion = self.motion
        motion.speed_mps = motion.side_speed_mps = motion.yaw_rate_radps = 0.0

    def resolve_contact(self, contact: Contact) -> None:
        """Put the car out of what it has got into, and take away its motion into it, with friction along it.

        Inelastic impulses on a rigid body at the point of contact, in the plane: first friction, Coulomb's, then the
        push that stops what motion into it is left.
        """
        motion = self.motion
        motion.x_m += contact.depth_m * math.cos(contact.out_rad)
        motion.y_m += contact.depth_m * math.sin(contact.out_rad)
        point = (contact.ahead_m - self._to_rear_m, contact.left_m)  # from the centre of gravity
        out_rad = contact.out_rad - motion.heading_rad
        outward = (math.cos(out_rad), math.sin(out_rad))
        along = (-outward[1], outward[0])
        max_friction = RAIL_FRICTION * self._stopping_impulse(point, outward)
        if max_friction <= 0.0:
            return
        self._apply_impulse(point, along, min(max(self._stopping_impulse(point, along), -max_friction), max_friction))
        self._apply_impulse(point, outward, max(0.0, self._stopping_impulse(point, outward)))
        motion.speed_mps = max(0.0, motion.speed_mps)

    def _stopping_impulse(self, point: tuple[float, float], direction: tuple[float, float]) -> float:
        """Impulse (N s) that takes a point of the body its speed in a direction; both in the car's frame."""
        motion, parameters = self.motion, self.parameters
        forward_mps = motion.speed_mps - motion.yaw_rate_radps * point[1]
        sideways_mps = motion.side_speed_mps + motion.yaw_rate_radps * point[0]
        lever_m = point[0] * direction[1] - point[1] * direction[0]
        inverse_mass = 1.0 / parameters.mass_kg + lever_m * lever_m / parameters.yaw_inertia_kgm2
        return -(forward_mps * direction[0] + sideways_mps * direction[1]) / inverse_mass

    def _apply_impulse(self, point: tuple[float, float], direction: tuple[float, float], impulse: float) -> None:
        motion, parameters = self.motion, self.parameters
        forward, sideways = impulse * direction[0], impulse * direction[1]
        motion.speed_mps += forward / parameters.mass_kg
        motion.side_speed_mps += sideways / parameters.mass_kg
        motion.yaw_rate_radps += (point[0] * sideways - point[1] * forward) / parameters.yaw_inertia_kgm2

    def _tyre_accelerations(self) -> tuple[float, float, float]:
        """Sideways and yaw acceleration by the tyres' side forces, and how much the turned front tyres slow the car."""
        parameters, motion, to_rear_m = self.parameters, self.motion, self._to_rear_m
        to_front_m, front_grip_n, rear_grip_n = (
            parameters.front_axle_to_gravity_m,
            self._front_grip_n,
            self._rear_grip_n,
        )
        speed_mps, side_speed_mps, yaw_rate_radps = motion.speed_mps, motion.side_speed_mps, motion.yaw_rate_radps
        steering_rad = motion.steering_rad
        front_slip = steering_rad - math.atan2(side_speed_mps + to_front_m * yaw_rate_radps, speed_mps)
        rear_slip = -math.atan2(side_speed_mps - to_rear_m * yaw_rate_radps, speed_mps)
        front_n = front_grip_n * math.tanh(parameters.front_stiffness_nprad * front_slip / front_grip_n)
        rear_n = rear_grip_n * math.tanh(parameters.rear_stiffness_nprad * rear_slip / rear_grip_n)
        across_n = front_n * math.cos(steering_rad)
        turning_nm = to_front_m * across_n - to_rear_m * rear_n
        return (
            (across_n + rear_n) / parameters.mass_kg,
            turning_nm / parameters.yaw_inertia_kgm2,
            front_n * math.sin(steering_rad) / parameters.mass_kg,
        )


def _lag_factor(step_s: float, lag_s: float) -> float:
    """Share of the way to its target that a first-order lag goes in a step; all of it without a lag."""
    return 1.0 - math.exp(-step_s / lag_s) if lag_s > 0.0 else 1.0
