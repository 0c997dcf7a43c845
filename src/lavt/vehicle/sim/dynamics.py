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


@dataclass(frozen=True, slots=True)
class CarParameters:
    """A car of the class of a Lincoln MKZ.

    Sizes, steering and pedals: ApolloAuto/apollo, modules/common/data/vehicle_param.pb.txt (LINCOLN_MKZ: steering
    wheel to 8.203 rad at 8.552 rad/s, ratio 16). Mass and tyres: Apollo's lateral controller for the same car. Yaw
    inertia, centre of gravity, friction, lags and resistance: our estimates for a car of this class.
    """

    wheelbase_m: float = 2.8448
    rear_axle_to_front_m: float = 3.89
    rear_axle_to_rear_m: float = 1.043
    body_width_m: float = 1.86
    """Without mirrors."""
    front_axle_to_gravity_m: float = 1.40
    mass_kg: float = 2080.0
    yaw_inertia_kgm2: float = 3300.0
    axle_stiffness_nprad: float = 155_495.0
    """Side force of an axle for each radian of slip, front as rear."""
    friction: float = 0.9
    max_steering_rad: float = 0.513
    max_steering_rate_radps: float = 0.534
    steering_lag_s: float = 0.12
    pedal_lag_s: float = 0.2
    max_acceleration_mps2: float = 2.0
    max_braking_mps2: float = 6.0
    rolling_resistance_mps2: float = 0.1
    drag_per_m: float = 0.0002
    """Deceleration by air for each (m/s) squared: half of 1.2 kg/m3 x 0.3 x 2.3 m2 over the mass."""
    kinematic_below_mps: float = 3.0


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


class Car:
    """A car with parameters, stepped in time steps of one length."""

    def __init__(self, parameters: CarParameters, motion: CarMotion, step_s: float) -> None:
        self.parameters, self.motion = parameters, motion
        self._step_s = step_s
        self._to_rear_m = parameters.wheelbase_m - parameters.front_axle_to_gravity_m
        weight_n = parameters.mass_kg * GRAVITY_MPS2 / parameters.wheelbase_m
        self._front_grip_n = parameters.friction * weight_n * self._to_rear_m
        self._rear_grip_n = parameters.friction * weight_n * parameters.front_axle_to_gravity_m
        self._pedal_share = 1.0 - math.exp(-step_s / parameters.pedal_lag_s)
        self._steering_share = 1.0 - math.exp(-step_s / parameters.steering_lag_s)
        # At the speed where the models meet, tyres take the car to rolling without slip with this rate (1/s).
        settling = 2 * parameters.axle_stiffness_nprad / (parameters.mass_kg * parameters.kinematic_below_mps)
        self._rolling_share = 1.0 - math.exp(-step_s * settling)

    def step(self, wanted: Actuation) -> None:
        """Live on for one time step under `wanted`; values out of range are taken as the nearest in range."""
        self._follow(wanted)
        motion, step_s = self.motion, self._step_s
        side_acceleration, yaw_acceleration, drag = 0.0, 0.0, 0.0
        if motion.speed_mps >= self.parameters.kinematic_below_mps:
            side_acceleration, yaw_acceleration, drag = self._tyre_accelerations()
        acceleration = self._pedal_acceleration() - drag
        if motion.speed_mps >= self.parameters.kinematic_below_mps:
            acceleration += motion.side_speed_mps * motion.yaw_rate_radps
            side_acceleration -= motion.speed_mps * motion.yaw_rate_radps
            motion.side_speed_mps += side_acceleration * step_s
            motion.yaw_rate_radps += yaw_acceleration * step_s
        else:
            rolling_radps = motion.speed_mps * math.tan(motion.steering_rad) / self.parameters.wheelbase_m
            motion.yaw_rate_radps += (rolling_radps - motion.yaw_rate_radps) * self._rolling_share
            motion.side_speed_mps += (rolling_radps * self._to_rear_m - motion.side_speed_mps) * self._rolling_share
        # Brakes and resistance stop a car, they do not drive it backwards.
        motion.speed_mps = max(0.0, motion.speed_mps + acceleration * step_s)
        self._move()

    def stop_dead(self) -> None:
        """Take all speed away, as a wall does."""
        motion = self.motion
        motion.speed_mps = motion.side_speed_mps = motion.yaw_rate_radps = 0.0

    def _follow(self, wanted: Actuation) -> None:
        parameters, motion = self.parameters, self.motion
        motion.throttle += (min(max(wanted.throttle, 0.0), 1.0) - motion.throttle) * self._pedal_share
        motion.brake += (min(max(wanted.brake, 0.0), 1.0) - motion.brake) * self._pedal_share
        target_rad = min(max(wanted.steering_rad, -parameters.max_steering_rad), parameters.max_steering_rad)
        furthest_rad = parameters.max_steering_rate_radps * self._step_s
        change_rad = (target_rad - motion.steering_rad) * self._steering_share
        motion.steering_rad += min(max(change_rad, -furthest_rad), furthest_rad)

    def _pedal_acceleration(self) -> float:
        parameters, motion = self.parameters, self.motion
        return (
            motion.throttle * parameters.max_acceleration_mps2
            - motion.brake * parameters.max_braking_mps2
            - parameters.rolling_resistance_mps2
            - parameters.drag_per_m * motion.speed_mps * motion.speed_mps
        )

    def _tyre_accelerations(self) -> tuple[float, float, float]:
        """Sideways and yaw acceleration by the tyres' side forces, and how much the turned front tyres slow the car."""
        parameters, motion = self.parameters, self.motion
        stiffness = parameters.axle_stiffness_nprad
        front_speed = motion.side_speed_mps + parameters.front_axle_to_gravity_m * motion.yaw_rate_radps
        rear_speed = motion.side_speed_mps - self._to_rear_m * motion.yaw_rate_radps
        front_slip = motion.steering_rad - math.atan2(front_speed, motion.speed_mps)
        rear_slip = -math.atan2(rear_speed, motion.speed_mps)
        front_n = self._front_grip_n * math.tanh(stiffness * front_slip / self._front_grip_n)
        rear_n = self._rear_grip_n * math.tanh(stiffness * rear_slip / self._rear_grip_n)
        across_n = front_n * math.cos(motion.steering_rad)
        turning_nm = parameters.front_axle_to_gravity_m * across_n - self._to_rear_m * rear_n
        return (
            (across_n + rear_n) / parameters.mass_kg,
            turning_nm / parameters.yaw_inertia_kgm2,
            front_n * math.sin(motion.steering_rad) / parameters.mass_kg,
        )

    def _move(self) -> None:
        """Move the rear axle, with the heading of the middle of the step."""
        motion, step_s = self.motion, self._step_s
        rear_side_mps = motion.side_speed_mps - self._to_rear_m * motion.yaw_rate_radps
        middle_rad = motion.heading_rad + motion.yaw_rate_radps * step_s / 2
        cosine, sine = math.cos(middle_rad), math.sin(middle_rad)
        motion.x_m += (motion.speed_mps * cosine - rear_side_mps * sine) * step_s
        motion.y_m += (motion.speed_mps * sine + rear_side_mps * cosine) * step_s
        motion.heading_rad += motion.yaw_rate_radps * step_s
