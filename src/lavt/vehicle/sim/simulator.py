"""A simulated car on a road, sampled on a fixed time grid of the monotonic clock."""

from __future__ import annotations

import math
from collections import deque

from lavt.domain import NS_PER_S, Actuation, GroundTruth, Pose, VehicleEvent, VehicleState
from lavt.streams import stream
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ, CarDynamics, CarMotion, CarParameters
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.route_monitor import RouteMonitor
from lavt.vehicle.vehicle import Capabilities, ReachedCommand

STEPS_PER_S = 240

MAX_START_LATERAL_M = 0.25
MAX_START_TURN_RAD = math.radians(1.5)
MAX_START_AHEAD_M = 2.0
"""The largest differences between a run's start and the route's start: to either side, in heading, and ahead. The
actual differences are drawn from the seed."""

INITIAL_ACTUATION = Actuation(steering_rad=0.0, throttle=0.0, brake=1.0)


def grid_ns(index: int) -> int:
    """Return the time of a grid point. It is computed from the index, so that no error accumulates."""
    return index * NS_PER_S // STEPS_PER_S


def start_offset(seed: int) -> tuple[float, float, float]:
    """Return a run's start relative to the route's start: m ahead, m to the left, and the turn to the left in rad."""
    return (
        float(stream(seed, "start position").uniform(0.0, MAX_START_AHEAD_M)),
        float(stream(seed, "start lateral").uniform(-MAX_START_LATERAL_M, MAX_START_LATERAL_M)),
        float(stream(seed, "start heading").uniform(-MAX_START_TURN_RAD, MAX_START_TURN_RAD)),
    )


class Simulator:
    """A simulated `lavt.vehicle.vehicle.Vehicle`. Until the first command it is stationary with full brake.

    Physics is lazy: `advance` makes all steps since its last call, however late it is called. The steps lie on a grid
    of 1/240 s of the monotonic clock, and begin at the first grid point at or after `start_mono_ns`. After a collision
    the car stays where it is or, with `continue_after_collision`, slides along the obstacle. The speed in `state` is
    the true one times `speed_report_factor`.
    """

    def __init__(
        self,
        *,
        road: Road,
        seed: int,
        start_mono_ns: int,
        parameters: CarParameters = LINCOLN_MKZ,
        continue_after_collision: bool = False,
        limit_s: float | None = None,
        speed_report_factor: float = 1.0,
    ) -> None:
        self._speed_report_factor = speed_report_factor
        self._parameters, self._continues_after_collision = parameters, continue_after_collision
        self._steering_dead_ns = round(parameters.steering_dead_time_s * NS_PER_S)
        self._pedal_dead_ns = round(parameters.pedal_dead_time_s * NS_PER_S)
        self._index = -(-start_mono_ns * STEPS_PER_S // NS_PER_S)
        """The index of the newest grid point to which the physics has advanced."""
        ahead_m, lateral_m, turned_rad = start_offset(seed)
        x_m, y_m = road.point_at(ahead_m, lateral_m).tolist()
        motion = CarMotion(x_m, y_m, float(road.centre_at(ahead_m).heading_rad) + turned_rad)
        self._car = CarDynamics(parameters, motion, 1.0 / STEPS_PER_S)
        self._route_monitor = RouteMonitor(road, parameters, near_station_m=ahead_m, limit_s=limit_s)
        self._route_monitor.update(motion, grid_ns(self._index))
        self._actuation = INITIAL_ACTUATION
        self._steering_commands: deque[tuple[int, float]] = deque()
        """Time of effect (ns) and steering angle (rad)."""
        self._pedal_commands: deque[tuple[int, float, float]] = deque()
        """Time of effect (ns), throttle and brake."""
        self._crashed = False
        self._state: VehicleState | None = None
        """The state at the newest grid point, cached once it has been read."""

    @property
    def capabilities(self) -> Capabilities:
        """The properties of this vehicle."""
        parameters = self._parameters
        return Capabilities(
            simulated=True,
            virtual_time=True,
            ground_truth=True,
            reset=False,
            wheelbase_m=parameters.wheelbase_m,
            max_steering_rad=parameters.max_steering_rad,
            max_steering_rate_radps=parameters.max_steering_rate_radps,
            max_acceleration_mps2=parameters.max_acceleration_mps2,
            max_braking_mps2=parameters.max_braking_mps2,
        )

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Make every step up to `to_ns` and return the events of these steps, in order."""
        events: list[VehicleEvent] = []
        car, monitor = self._car, self._route_monitor
        steering, pedals = self._steering_commands, self._pedal_commands
        at_ns, next_ns = grid_ns(self._index), grid_ns(self._index + 1)
        self._state = None
        while next_ns <= to_ns:
            if (steering and steering[0][0] <= at_ns) or (pedals and pedals[0][0] <= at_ns):
                self._apply_due_commands(at_ns)
            self._index += 1
            at_ns, next_ns = next_ns, grid_ns(self._index + 1)
            if self._crashed:
                continue
            car.step(self._actuation)
            new_events = monitor.update(car.motion, at_ns)
            if self._continues_after_collision:
                for contact in monitor.contacts:
                    car.resolve_contact(contact)
            elif new_events and any(event.kind == "collision" for event in new_events):
                self._crashed = True
                car.stop()
            events += new_events
        return events

    def apply(self, actuation: Actuation, now_ns: int) -> None:
        """Put `actuation` into effect at the first grid point at or after `now_ns` plus the dead time.

        Steering and pedals have a dead time each. `now_ns` must not decrease.
        """
        self._steering_commands.append((now_ns + self._steering_dead_ns, actuation.steering_rad))
        self._pedal_commands.append((now_ns + self._pedal_dead_ns, actuation.throttle, actuation.brake))

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Do nothing: the simulator is always engaged."""

    def take_reached(self) -> list[ReachedCommand]:
        """Return an empty list: the simulator does not report when the wheels reach a command."""
        return []

    def _apply_due_commands(self, at_ns: int) -> None:
        """Put into effect the commands whose dead time has passed."""
        steering_rad, throttle, brake = self._actuation.steering_rad, self._actuation.throttle, self._actuation.brake
        while self._steering_commands and self._steering_commands[0][0] <= at_ns:
            _, steering_rad = self._steering_commands.popleft()
        while self._pedal_commands and self._pedal_commands[0][0] <= at_ns:
            _, throttle, brake = self._pedal_commands.popleft()
        previous = self._actuation
        if steering_rad != previous.steering_rad or throttle != previous.throttle or brake != previous.brake:
            self._actuation = Actuation(steering_rad, throttle, brake)

    def state(self) -> VehicleState:
        """Return reported speed and road wheel angle at the newest grid point."""
        if self._state is None:
            motion = self._car.motion
            reported_mps = motion.speed_mps * self._speed_report_factor
            self._state = VehicleState(grid_ns(self._index), reported_mps, motion.steering_rad, "drive")
        return self._state

    def ground_truth(self) -> GroundTruth:
        """Return the ground truth at the newest grid point."""
        motion, track = self._car.motion, self._route_monitor.track(self._car.motion)
        return GroundTruth(
            grid_ns(self._index),
            motion.x_m,
            motion.y_m,
            motion.heading_rad,
            motion.speed_mps,
            motion.steering_rad,
            track.cross_track_m,
            track.heading_error_rad,
            track.progress_m,
        )

    def pose(self) -> Pose:
        """Return the car's pose at the newest grid point."""
        motion = self._car.motion
        return Pose(grid_ns(self._index), motion.x_m, motion.y_m, motion.heading_rad)

    def next_wake_ns(self) -> int:
        """Return the time of the next grid point."""
        return grid_ns(self._index + 1)
