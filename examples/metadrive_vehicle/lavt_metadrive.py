"""A car of the simulator MetaDrive 0.3.0.1 as a vehicle of LAVT: `vehicle.kind: metadrive`.

MetaDrive computes the car's motion (Bullet's physics on a flat plane). The road, the pictures and the ground truth are
LAVT's. MetaDrive's y points to the right and its headings are positive to the right; LAVT's are to the left.
"""

from __future__ import annotations

import contextlib
import functools
import math
import sys
from dataclasses import replace
from typing import Any, Final

import numpy as np

from lavt.assembly.vehicles import VehicleSetup, build_simulator, start_pose
from lavt.config import ServerConfig
from lavt.domain import NS_PER_MS, Actuation, GroundTruth, VehicleEvent, VehicleState
from lavt.vehicle.carla.frames import FlatPose
from lavt.vehicle.contract import ContractLimits
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ, CarMotion
from lavt.vehicle.sim.road.road import Road, load_road
from lavt.vehicle.sim.route_monitor import RouteMonitor
from lavt.vehicle.vehicle import Capabilities, ReachedCommand

STEP_NS: Final = 10 * NS_PER_MS
STEP_S: Final = 0.01
FRONT_AXLE_M, REAR_AXLE_M = 1.05234, -1.4166
"""The axles of MetaDrive's default car, relative to its position."""
BODY = replace(
    LINCOLN_MKZ,
    wheelbase_m=FRONT_AXLE_M - REAR_AXLE_M,
    rear_axle_to_front_m=4.51 / 2 - REAR_AXLE_M,
    rear_axle_to_rear_m=4.51 / 2 + REAR_AXLE_M,
    body_width_m=1.852,
)
"""The size of the body, for the ground truth on the road."""
MAX_STEERING_RAD: Final = math.radians(40.0)
STEERING_RATE_RADPS: Final = 0.6
"""MetaDrive's wheels turn at once; these turn at this rate."""
BRAKE_SHARE: Final = 0.45
"""MetaDrive's full brake decelerates by 17 m/s2, which no car can."""
ACCELERATION_MPS2, BRAKING_MPS2 = 2.7, 7.0
HELD_BELOW_MPS: Final = 0.3
"""Below this speed a braked car is held: Bullet's cars creep with up to 0.12 m/s and never rest."""
SETTLING_STEPS: Final = 200
LIMITS: Final = ContractLimits(speed_mps=(2.2, 3.2), full_throttle_mps=4.5)
"""What this car does in the checks of the contract."""


@functools.cache
def metadrive_car() -> tuple[Any, Any]:
    """Return MetaDrive's car and its physics; a process has one of each."""
    with contextlib.redirect_stdout(sys.stderr):  # MetaDrive greets on standard output
        from metadrive import MetaDriveEnv  # noqa: PLC0415 (takes seconds)

        env = MetaDriveEnv({"use_render": False, "traffic_density": 0.0, "map": "S", "environment_num": 1})
        env.reset()
    return env.vehicle, env.engine.physics_world.dynamic_world


class MetaDriveVehicle:
    """A `Vehicle` on a road of LAVT; a new one replaces the last one of this process."""

    def __init__(self, road: Road, start: FlatPose, start_ns: int, *, limit_s: float | None = None) -> None:
        self._car, self._physics = metadrive_car()
        self._now_ns = start_ns
        self._actuation = Actuation(0.0, 0.0, 1.0)
        self._steering_rad = 0.0
        self._is_held = False
        self._is_engaged = False
        self._place(start)
        for _ in range(SETTLING_STEPS):  # the car drops onto its wheels
            self._step()
        self._place(start)
        self._hold()
        stations_m = np.arange(road.first_m, road.last_m, 1.0)
        xs_m, ys_m, _, _ = road.centre_at(stations_m)
        near_m = float(stations_m[np.argmin(np.hypot(xs_m - start.x_m, ys_m - start.y_m))])
        self._motion = CarMotion(*start)
        self._monitor = RouteMonitor(road, BODY, near_station_m=near_m, limit_s=limit_s)
        self._monitor.update(self._motion, start_ns)

    @property
    def capabilities(self) -> Capabilities:
        """Return the properties of this vehicle."""
        return Capabilities(
            simulated=True,
            virtual_time=True,
            ground_truth=True,
            reset=False,
            wheelbase_m=BODY.wheelbase_m,
            max_steering_rad=MAX_STEERING_RAD,
            max_steering_rate_radps=STEERING_RATE_RADPS,
            max_acceleration_mps2=ACCELERATION_MPS2,
            max_braking_mps2=BRAKING_MPS2,
        )

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Make the steps of the physics up to `to_ns` and return their events."""
        events: list[VehicleEvent] = []
        while self._now_ns + STEP_NS <= to_ns:
            self._now_ns += STEP_NS
            self._step()
            pose = self._pose()
            motion = self._motion
            motion.x_m, motion.y_m, motion.heading_rad = pose
            motion.speed_mps, motion.steering_rad = self._speed_mps(), self._steering_rad
            events += self._monitor.update(motion, self._now_ns)
        return events

    def apply(self, actuation: Actuation, now_ns: int) -> None:  # noqa: ARG002 (the next step uses it)
        """Apply `actuation` from the next step on; of a car that is not engaged, only the brake is used."""
        brake = max(actuation.brake, 1.0)
        self._actuation = actuation if self._is_engaged else Actuation(0.0, 0.0, brake)

    def engage(self, wanted: bool, now_ns: int) -> None:  # noqa: ARG002 (part of the protocol)
        """Engage the car if `wanted`, otherwise disengage it."""
        self._is_engaged = wanted

    def take_reached(self) -> list[ReachedCommand]:
        """Return an empty list: this car does not report when the wheels reach a command."""
        return []

    def state(self) -> VehicleState:
        """Return the state after the newest step."""
        return VehicleState(self._now_ns, self._speed_mps(), self._steering_rad, "drive", is_engaged=self._is_engaged)

    def ground_truth(self) -> GroundTruth:
        """Return the ground truth after the newest step."""
        track, pose = self._monitor.track(self._motion), self._pose()
        return GroundTruth(
            self._now_ns,
            *pose,
            self._speed_mps(),
            self._steering_rad,
            track.cross_track_m,
            track.heading_error_rad,
            track.progress_m,
        )

    def next_wake_ns(self) -> int:
        """Return the time of the next step."""
        return self._now_ns + STEP_NS

    def _step(self) -> None:
        actuation, car = self._actuation, self._car
        limit_rad = max(-MAX_STEERING_RAD, min(MAX_STEERING_RAD, actuation.steering_rad))
        turn_rad = STEERING_RATE_RADPS * STEP_S
        self._steering_rad += max(-turn_rad, min(turn_rad, limit_rad - self._steering_rad))
        is_braked = actuation.throttle == 0.0 and actuation.brake > 0.0
        if is_braked and (self._is_held or abs(self._speed_mps()) < HELD_BELOW_MPS):
            self._hold()
            return
        self._is_held = False
        for wheel in range(4):
            if wheel < 2:
                car.system.setSteeringValue(math.degrees(self._steering_rad), wheel)
            car.system.applyEngineForce(actuation.throttle * car.config["max_engine_force"], wheel)
            car.system.setBrake(actuation.brake * BRAKE_SHARE * car.config["max_brake_force"], wheel)
        self._physics.doPhysics(STEP_S, 1, STEP_S)

    def _hold(self) -> None:
        """Hold the car where it is, until it is no longer braked."""
        from panda3d.core import Vec3  # noqa: PLC0415 (as MetaDrive)

        self._is_held = True
        self._car.body.setLinearVelocity(Vec3(0.0, 0.0, 0.0))
        self._car.body.setAngularVelocity(Vec3(0.0, 0.0, 0.0))

    def _place(self, pose: FlatPose) -> None:
        """Put the car with its rear axle at a pose."""
        x_m = pose.x_m - REAR_AXLE_M * math.cos(pose.heading_rad)
        y_m = pose.y_m - REAR_AXLE_M * math.sin(pose.heading_rad)
        self._car.set_position((x_m, -y_m))
        self._car.set_heading_theta(-pose.heading_rad)

    def _pose(self) -> FlatPose:
        """Return the rear axle's pose in LAVT's frame."""
        (x_m, right_m), heading_rad = self._car.position, -float(self._car.heading_theta)
        return FlatPose(
            float(x_m) + REAR_AXLE_M * math.cos(heading_rad),
            -float(right_m) + REAR_AXLE_M * math.sin(heading_rad),
            heading_rad,
        )

    def _speed_mps(self) -> float:
        """Return the forward speed; exactly 0 for a car that is held."""
        if self._is_held:
            return 0.0
        velocity = self._car.body.getLinearVelocity()
        heading_rad = -float(self._car.heading_theta)
        return float(velocity.x * math.cos(heading_rad) + velocity.y * math.sin(heading_rad))


def build_metadrive(config: ServerConfig) -> VehicleSetup:
    """Return the car with the camera of LAVT's simulator on the configured road."""
    road = load_road(config.vehicle.route)
    return replace(
        build_simulator(config),
        start=lambda now: MetaDriveVehicle(
            road, start_pose(config, road), now.mono_ns, limit_s=config.vehicle.time_limit_s
        ),
        catches_up=False,
    )
