"""Vehicle dynamics: a dynamic bicycle model with saturating tyres and with lags and limits in its actuators.

At `CarParameters.kinematic_below_mps` and above, side forces follow from tyre slip. Slip is undefined at rest. So at
lower speeds another model applies: lateral speed and yaw rate approach those of a car that rolls without slip. The time
constant of this approach is that of the tyres at the speed where the two models meet, so the transition is smooth.
The state consists of plain floats, because there are 240 steps a second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from lavt.domain import Actuation
from lavt.errors import UserError

GRAVITY_MPS2 = 9.81


RAIL_FRICTION = 0.4
"""Friction coefficient between a car's side and a guard rail or concrete barrier.

Our estimate: a value between sheet metal on steel and sheet metal on concrete.
"""


@dataclass(frozen=True, slots=True)
class CarParameters:
    """The parameters of a car; `CARS` has the named cars with the source of each number."""

    wheelbase_m: float
    rear_axle_to_front_m: float
    rear_axle_to_rear_m: float
    body_width_m: float
    """Without mirrors."""
    front_axle_to_gravity_m: float
    """Distance from the front axle to the centre of gravity."""
    mass_kg: float
    yaw_inertia_kgm2: float
    front_stiffness_nprad: float
    rear_stiffness_nprad: float
    """Side force of an axle per radian of slip."""
    friction: float
    """Friction coefficient between tyres and road."""
    max_steering_rad: float
    max_steering_rate_radps: float
    steering_dead_time_s: float
    """Time until the wheels begin to follow a command."""
    steering_lag_s: float
    """Time constant of the wheels' first-order lag."""
    pedal_dead_time_s: float
    """Time until throttle and brake begin to follow a command."""
    throttle_lag_s: float
    brake_lag_s: float
    """Time constants of the first-order lags of throttle and brake."""
    max_acceleration_mps2: float
    max_braking_mps2: float
    rolling_resistance_mps2: float
    drag_per_m: float
    """Deceleration by air resistance per (m/s) squared."""
    kinematic_below_mps: float
    """Below this speed the model of a car that rolls without slip applies."""


LINCOLN_MKZ = CarParameters(
    # ApolloAuto/apollo, modules/common/data/vehicle_param.pb.txt, brand LINCOLN_MKZ. (Its width of 2.11 m includes the
    # mirrors.)
    wheelbase_m=2.8448,
    rear_axle_to_front_m=3.89,
    rear_axle_to_rear_m=1.043,
    max_steering_rad=0.513,  # steering wheel to 8.203 rad, ratio 16
    max_steering_rate_radps=0.534,  # steering wheel at 8.552 rad/s
    max_acceleration_mps2=2.0,
    max_braking_mps2=6.0,
    # Apollo's lateral controller for the same car (lat_controller_conf): 520 kg on each wheel, stiffness of each axle.
    mass_kg=2080.0,
    front_stiffness_nprad=155_495.0,
    rear_stiffness_nprad=155_495.0,
    # Our estimates for a car of this class.
    body_width_m=1.86,
    front_axle_to_gravity_m=1.40,
    yaw_inertia_kgm2=3300.0,
    friction=0.9,  # dry asphalt
    steering_dead_time_s=0.0,
    steering_lag_s=0.12,  # between 0.05 and 0.27 s in published models of by-wire cars
    pedal_dead_time_s=0.0,
    throttle_lag_s=0.2,
    brake_lag_s=0.2,
    rolling_resistance_mps2=0.1,  # 1 % of the weight
    drag_per_m=0.0002,  # half of 1.2 kg/m3 x 0.3 x 2.3 m2, divided by the mass
    kinematic_below_mps=3.0,  # the dynamic model is stiff at 2 m/s and singular at rest
)

CARS = {"lincoln_mkz": LINCOLN_MKZ}


def named_car(name: str) -> CarParameters:
    """Return the car with this name. If there is none, raise a `UserError` that lists the known cars."""
    if name not in CARS:
        raise UserError(f"there is no car {name!r}: the known ones are {', '.join(CARS)}")
    return CARS[name]


@dataclass(frozen=True, slots=True)
class Contact:
    """A contact: a point of the body that has entered a rigid obstacle."""

    ahead_m: float
    left_m: float
    """Position of the point relative to the rear axle, in the car's frame."""
    depth_m: float
    """Distance that the point has to move to leave the obstacle."""
    out_rad: float
    """Direction out of the obstacle, in the world frame."""


@dataclass(slots=True)
class CarMotion:
    """The state of a car: the rear axle's pose in the world frame, the body's speeds, and the actuator positions."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_mps: float = 0.0
    """Forward."""
    side_speed_mps: float = 0.0
    """Lateral speed of the centre of gravity, left positive."""
    yaw_rate_radps: float = 0.0
    steering_rad: float = 0.0
    throttle: float = 0.0
    brake: float = 0.0


class CarDynamics:
    """A car with parameters and a state, which advances in fixed time steps."""

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
        # The inverse of the tyres' time constant at the speed where the two models meet.
        stiffness_nprad = parameters.front_stiffness_nprad + parameters.rear_stiffness_nprad
        settling_per_s = stiffness_nprad / (parameters.mass_kg * parameters.kinematic_below_mps)
        self._rolling_factor = 1.0 - math.exp(-step_s * settling_per_s)

    def _clamp(self, target: Actuation) -> Actuation:
        max_rad = self.parameters.max_steering_rad
        return Actuation(
            steering_rad=min(max(target.steering_rad, -max_rad), max_rad),
            throttle=min(max(target.throttle, 0.0), 1.0),
            brake=min(max(target.brake, 0.0), 1.0),
        )

    def step(self, target: Actuation) -> None:
        """Advance by one time step under `target`; values out of range are clamped."""
        if target is not self._last_request:  # for many steps the caller passes the same object
            self._last_request, self._target = target, self._clamp(target)
        # Read and write each attribute once, for speed: in a virtual run without pixels this function takes a tenth of
        # the time.
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
        # Brakes and resistance stop a car; they do not drive it backwards.
        speed_mps = max(0.0, speed_mps + acceleration * step_s)
        motion.speed_mps, motion.side_speed_mps, motion.yaw_rate_radps = speed_mps, side_speed_mps, yaw_rate_radps
        # Move the rear axle with the heading at the middle of the step.
        rear_side_mps = side_speed_mps - self._to_rear_m * yaw_rate_radps
        turn_rad = yaw_rate_radps * step_s
        middle_heading_rad = motion.heading_rad + turn_rad / 2
        cosine, sine = math.cos(middle_heading_rad), math.sin(middle_heading_rad)
        motion.x_m += (speed_mps * cosine - rear_side_mps * sine) * step_s
        motion.y_m += (speed_mps * sine + rear_side_mps * cosine) * step_s
        motion.heading_rad += turn_rad

    def stop(self) -> None:
        """Set all speeds to zero."""
        motion = self.motion
        motion.speed_mps = motion.side_speed_mps = motion.yaw_rate_radps = 0.0

    def resolve_contact(self, contact: Contact) -> None:
        """Move the car out of an obstacle, stop its motion into the obstacle, and apply friction along the obstacle.

        The impulses act on a rigid body in the plane, at the contact point: first the impulse of Coulomb friction, then
        the impulse that stops the remaining motion into the obstacle. The car does not bounce back.
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
        """Return the impulse (N s) that stops the motion of a point of the body in a direction.

        Point (m from the centre of gravity) and direction (unit vector) are given ahead and to the left, in the car's
        frame.
        """
        motion, parameters = self.motion, self.parameters
        (ahead_m, left_m), (ahead_share, left_share) = point, direction
        forward_mps = motion.speed_mps - motion.yaw_rate_radps * left_m
        sideways_mps = motion.side_speed_mps + motion.yaw_rate_radps * ahead_m
        lever_m = ahead_m * left_share - left_m * ahead_share
        inverse_mass = 1.0 / parameters.mass_kg + lever_m * lever_m / parameters.yaw_inertia_kgm2
        return -(forward_mps * ahead_share + sideways_mps * left_share) / inverse_mass

    def _apply_impulse(self, point: tuple[float, float], direction: tuple[float, float], impulse: float) -> None:
        motion, parameters = self.motion, self.parameters
        (ahead_m, left_m), (ahead_share, left_share) = point, direction
        forward, sideways = impulse * ahead_share, impulse * left_share
        motion.speed_mps += forward / parameters.mass_kg
        motion.side_speed_mps += sideways / parameters.mass_kg
        motion.yaw_rate_radps += (ahead_m * sideways - left_m * forward) / parameters.yaw_inertia_kgm2

    def _tyre_accelerations(self) -> tuple[float, float, float]:
        """Return the effect of the tyres' side forces: lateral acceleration, yaw acceleration, and deceleration.

        The deceleration is that by the steered front tyres.
        """
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
    """Return the share of the remaining change that a first-order lag makes in a step; 1 without a lag."""
    return 1.0 - math.exp(-step_s / lag_s) if lag_s > 0.0 else 1.0
