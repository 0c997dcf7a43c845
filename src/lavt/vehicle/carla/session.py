"""A car with its sensors in a CARLA server: spawn them, tick, and leave the server as it was.

By default the world is synchronous: it stands still unless this client ticks it. So a dead client leaves a frozen world
and no driving car. An asynchronous world runs by itself (`follower.py`). The next session removes the actors of a
killed one, which it finds by their role name.
"""

from __future__ import annotations

import atexit
import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

from lavt.domain import Actuation, CameraModel
from lavt.errors import UserError, VehicleError
from lavt.vehicle.carla.actors import SpawnedActors, find_blueprint, set_camera
from lavt.vehicle.carla.connection import (
    OpenedWorld,
    connect,
    open_world,
    sentences,
    to_pose,
    to_transform,
    town_of,
)
from lavt.vehicle.carla.frames import (
    Axles,
    CarlaPose,
    FlatPose,
    actor_pose,
    camera_mount,
    curve_at,
    find_axles,
    forward_speed_mps,
    rear_axle_pose,
    road_wheel_rad,
    steer_for,
)
from lavt.vehicle.carla.library import load_library
from lavt.vehicle.carla.pictures import PictureBox
from lavt.vehicle.carla.plausible import SentControls, check_finite, check_tick, checked
from lavt.vehicle.carla.settings import CarlaEvent, CarlaSettings, Snapshot

SPAWN_HEIGHT_M: Final = 0.3
"""The car is spawned at this height above the lane, and drops."""
SETTLING_S: Final = 3.0
"""The longest time that the car may take to come to rest after it was spawned."""
AT_REST_MPS: Final = 0.05
GUESSED_REAR_AXLE_M: Final = -1.4
"""Where the rear axle is assumed until the wheels have been seen."""
MAX_TICKS_TO_PICTURE: Final = 60
PICTURE_WAIT_S: Final = 0.25
"""A picture that has not come this long after a tick was not taken: a camera starts some ticks after it was spawned."""
CLOSE_TIMEOUT_S: Final = 2.0
BRAKED: Final = Actuation(0.0, 0.0, 1.0)
MPS_TO_KMH: Final = 3.6
STEER_DITHER: Final = 1e-6
"""Two controls in turn differ by this much: the package does not send one that is equal to its last one, although
the guard may have braked since."""
COLLISION, LANE_INVASION, CAMERA = "sensor.other.collision", "sensor.other.lane_invasion", "sensor.camera.rgb"


class CarlaSession:
    """A car with its sensors, in a world that only this client ticks or, if it is asynchronous, that runs by itself.

    Raises `UserError` if the server is absent, of another version, ticked by another client, or has no such town, car
    or free start; raises `VehicleError` if it stops answering.
    """

    def __init__(self, settings: CarlaSettings) -> None:
        self.settings = settings
        self.pictures = PictureBox(settings.camera or CameraModel())
        self._carla = load_library()
        self._events: deque[CarlaEvent] = deque()
        self._actors = SpawnedActors()
        self._opened: OpenedWorld | None = None
        self._is_closed = False
        self.is_car_gone = False
        """Whether `close` has removed the car."""
        self._axles = Axles(GUESSED_REAR_AXLE_M, 1.0)
        self._max_steering_rad = 1.0
        self._steering_curve: tuple[tuple[float, float], ...] = ()
        self._frame, self._is_ticking = 0, False
        self._dither = 0.0
        self.steer = 0.0  # of the last control
        self._sent = SentControls()
        self._elapsed_s = 0.0
        self._start = FlatPose(0.0, 0.0, 0.0)
        self._client = connect(self._carla, settings)
        atexit.register(self.close)
        try:
            self._opened = open_world(self._carla, self._client, settings)
            self._world = self._opened.world
            self._car = self._spawn_car()
            self._settle()
            self._measure_car()
            self.reset()
            self._add_sensors()
            self._client.set_timeout(settings.tick_timeout_s)
        except BaseException:
            self.close()
            raise

    @property
    def wheelbase_m(self) -> float:
        """The distance of the axles, from the wheels' positions."""
        return self._axles.wheelbase_m

    @property
    def max_steering_rad(self) -> float:
        """The road wheel angle at full steer: the configured one, or the one that the server announces."""
        return self._max_steering_rad

    @property
    def car_number(self) -> int:
        """The number of the car among the server's actors."""
        return int(self._car.id)

    def tick(self, actuation: Actuation, *, hand_brake: bool = False) -> Snapshot:
        """Advance the world by one tick, or wait for the next one of an asynchronous world; return the car after it."""
        if self.settings.is_asynchronous:
            self.apply(actuation, hand_brake=hand_brake)
            self.snapshot = self.wait_for_state()
            self._actors.are_new = False
            return self.snapshot
        with sentences(self.settings, "complete a tick"):
            self.apply(actuation, hand_brake=hand_brake)
            before = self._frame
            self._advance(self._world, self.settings.tick_timeout_s)
            state = self._world.get_snapshot()
        if before and self._frame != before + 1:
            raise VehicleError(
                f"the CARLA server at {self.settings.address} went from frame {before} to {self._frame} in one tick: "
                "end the other client that ticks it"
            )
        check_tick(state.timestamp.delta_seconds, self.settings.tick_s, self.settings.address)
        if before and state.find(self._car.id) is None:
            raise self._car_is_gone()
        with sentences(self.settings, "report the car"):
            self.snapshot = checked(self._read(), self.settings.address)
        return self.snapshot

    def wait_for_state(self) -> Snapshot:
        """Return the car in the next state of an asynchronous world; raise `VehicleError` if none comes.

        The steering angle is that of the control: to ask for the wheels' own would stop all threads during the request.
        """
        with sentences(self.settings, "send a state"):
            state = self._world.wait_for_tick(self.settings.tick_timeout_s)
            car = state.find(self._car.id)
            if car is None and self._frame:
                raise self._car_is_gone()
            pose, velocity = CarlaPose(0.0, 0.0, 0.0), (0.0, 0.0)
            if car is not None:
                self._frame = state.frame
                pose, vector = to_pose(car.get_transform()), car.get_velocity()
                velocity = (vector.x, vector.y)
            control = self._car.get_control()
        self._elapsed_s = state.timestamp.elapsed_seconds
        self._sent.check(self._elapsed_s, control.throttle, control.brake, self.settings.address)
        check_finite((pose.yaw_deg, *velocity), self.settings.address)
        snapshot = Snapshot(
            state.frame,
            rear_axle_pose(pose, self._axles.rear_axle_m, self.settings.map_shift_m),
            forward_speed_mps(velocity, pose.yaw_deg),
            -control.steer * self._max_steering_rad * self._curve_factor(math.hypot(*velocity)),
            control.gear,
            self._elapsed_s,
            state.timestamp.platform_timestamp,
        )
        return checked(snapshot, self.settings.address)

    def _car_is_gone(self) -> VehicleError:
        return VehicleError(
            f"the car is gone from the CARLA server at {self.settings.address}: end the other client that destroyed it"
        )

    def ask_version(self) -> str:
        """Return the server's version: its answer takes as long as the shortest request does."""
        with sentences(self.settings, "say its version"):
            return str(self._client.get_server_version())

    @property
    def town(self) -> str:
        """The name of the loaded town."""
        with sentences(self.settings, "name its town"):
            return town_of(self._world)

    def check_camera(self) -> None:
        """Raise `VehicleError` if another client has destroyed the camera, or if its pictures have another size."""
        self.pictures.check_size(self.settings.address)
        camera = next((actor for actor in self._actors if actor.type_id == CAMERA), None)
        with sentences(self.settings, "list its actors"):
            is_there = camera is None or self._world.get_snapshot().has_actor(camera.id)
        if not is_there:
            raise VehicleError(
                f"the camera is gone from the CARLA server at {self.settings.address}: end the other client that "
                "destroyed it"
            )

    def take_events(self) -> list[CarlaEvent]:
        """Return the collisions and lane invasions that arrived since the last call."""
        return [self._events.popleft() for _ in range(len(self._events))]

    def reset(self) -> None:
        """Put the car, stationary, with its rear axle exactly at the start."""
        with sentences(self.settings, "place the car"):
            now = to_pose(self._car.get_transform())
            pose = actor_pose(self._start, self._axles.rear_axle_m, self.settings.map_shift_m, now.z_m)
            self._car.set_target_velocity(self._carla.Vector3D())
            self._car.set_transform(to_transform(self._carla, pose._replace(pitch_deg=now.pitch_deg)))
        self._settle()

    def close(self) -> None:
        """Destroy the actors in reverse order and restore the world's settings.

        The settings come last, because with them the world may run by itself again. If the server does not answer or
        the car stays, the world stays frozen, with the rest of the actors, until the next session removes them;
        `is_car_gone` then is false. What a Ctrl-C in this method prevents is done by its next call, at the latest when
        the process ends.
        """
        if self._is_closed:
            return
        with suppress(RuntimeError):
            self._client.set_timeout(CLOSE_TIMEOUT_S)
            if self._opened is not None:
                if self._actors.are_new:
                    with suppress(RuntimeError):  # without another state, it is worth trying
                        self._advance(self._opened.world, CLOSE_TIMEOUT_S)
                braked = self._carla.VehicleControl(brake=1.0, hand_brake=True)
                self.is_car_gone = self._actors.destroy(self._opened.world, braked)
                if self.is_car_gone and not self._is_ticked_by_another():
                    self._opened.restore(has_own_weather=bool(self.settings.weather))
        self._is_closed = True
        atexit.unregister(self.close)

    def _advance(self, world: Any, timeout_s: float) -> None:
        """Wait for the next state of the world, and in a synchronous one make it by a tick."""
        if self.settings.is_asynchronous:
            world.wait_for_tick(timeout_s)
        else:
            self._is_ticking = True
            self._frame = world.tick(timeout_s)
            self._is_ticking = False
        self._actors.are_new = False

    def _is_ticked_by_another(self) -> bool:
        """Return whether another client has ticked the world since: if it ran by itself, that client's car drove on.

        A Ctrl-C in a tick loses that tick's number.
        """
        newest_own = self._frame + self._is_ticking
        return not self.settings.is_asynchronous and self._frame > 0 and newest_own < self._world.get_snapshot().frame

    def _spawn_car(self) -> Any:
        settings = self.settings
        with sentences(settings, "spawn the car"):
            town = self._world.get_map()
            if settings.start is None:
                pose = to_pose(next(iter(town.get_spawn_points()), self._carla.Transform()))
                self._start = rear_axle_pose(pose, GUESSED_REAR_AXLE_M, settings.map_shift_m)
            else:
                self._start = settings.start
            pose = actor_pose(self._start, GUESSED_REAR_AXLE_M, settings.map_shift_m)
            lane = town.get_waypoint(self._carla.Location(pose.x_m, pose.y_m, 0.0), project_to_road=False)
            if lane is None:
                raise UserError(
                    f"the start, x {pose.x_m:.1f} m and y {pose.y_m:.1f} m in CARLA, is on no lane of "
                    f"{town_of(self._world)}: set vehicle.carla.town and vehicle.carla.map_shift_m, or another route"
                )
            pose = pose._replace(z_m=lane.transform.location.z + SPAWN_HEIGHT_M)
            blueprint = self._blueprint(settings.blueprint)
            car = self._actors.add(self._world.try_spawn_actor, blueprint, to_transform(self._carla, pose))
        if car is None:
            raise UserError(
                f"the start is occupied in the CARLA server at {settings.address}: remove the other actor, or set "
                "vehicle.carla.start or another route"
            )
        return car

    def _settle(self) -> None:
        """Tick, braked, until the car has a pose and rests on the road."""
        for count in range(math.ceil(SETTLING_S / self.settings.tick_s)):
            self.tick(BRAKED, hand_brake=True)
            velocity = self._car.get_velocity()
            if count >= 2 and math.hypot(velocity.x, velocity.y, velocity.z) < AT_REST_MPS:
                return

    def _measure_car(self) -> None:
        """Read where the axles are, and how far the wheels turn."""
        blueprint = self.settings.blueprint
        with sentences(self.settings, "describe the car"):
            physics, pose = self._car.get_physics_control(), to_pose(self._car.get_transform())
        wheels = [(wheel.position.x, wheel.position.y) for wheel in physics.wheels]
        if len(wheels) != 4:
            raise UserError(f"{blueprint} has {len(wheels)} wheels: set vehicle.carla.blueprint to a car with four")
        self._axles = find_axles(pose, wheels)
        if not 1.0 < self._axles.wheelbase_m < 10.0:
            raise VehicleError(
                f"CARLA reports a wheelbase of {self._axles.wheelbase_m:.3g} m for {blueprint}: set another "
                "vehicle.carla.blueprint"
            )
        announced_rad = math.radians(max(wheel.max_steer_angle for wheel in physics.wheels))
        self._max_steering_rad = self.settings.max_steering_rad or announced_rad
        if not 0.0 < self._max_steering_rad < math.pi / 2:
            raise VehicleError(
                f"CARLA reports a largest steering angle of {math.degrees(announced_rad):.3g} degrees for {blueprint}: "
                "set vehicle.carla.max_steering_deg"
            )
        curve = tuple((point.x, point.y) for point in physics.steering_curve)
        if not all(math.isfinite(x) and 0.0 < y < math.inf for x, y in curve):
            raise VehicleError(
                f"CARLA reports a steering curve that is not above 0 for {blueprint}: set another "
                "vehicle.carla.blueprint"
            )
        self._steering_curve = curve

    def _add_sensors(self) -> None:
        with sentences(self.settings, "spawn the sensors"):
            origin = CarlaPose(0.0, 0.0, 0.0)
            self._attach(self._blueprint(COLLISION), origin, self._note_collision)
            self._attach(self._blueprint(LANE_INVASION), origin, self._note_lane_invasion)
            if self.settings.camera is not None:
                blueprint = self._blueprint(CAMERA)
                set_camera(blueprint, self.settings.camera)
                self._attach(blueprint, camera_mount(self.settings.camera, self._axles.rear_axle_m), self.pictures.put)
        if self.settings.camera is not None:
            self._await_picture()

    def _await_picture(self) -> None:
        for _ in range(MAX_TICKS_TO_PICTURE):
            self.tick(BRAKED, hand_brake=True)
            if self.pictures.wait_for_any(PICTURE_WAIT_S):
                return
            self.pictures.check_size(self.settings.address)
        raise VehicleError(
            f"the CARLA server at {self.settings.address} sent no picture in {MAX_TICKS_TO_PICTURE} ticks: start it "
            "with rendering (-RenderOffScreen, not -nullrhi)"
        )

    def _attach(self, blueprint: Any, pose: CarlaPose, listener: Callable[[Any], None]) -> None:
        sensor = self._actors.add(self._world.spawn_actor, blueprint, to_transform(self._carla, pose), self._car)
        sensor.listen(listener)

    def _blueprint(self, name: str) -> Any:
        return find_blueprint(self._world, name, self.settings.role_name)

    def apply(self, actuation: Actuation, *, hand_brake: bool = False) -> None:
        """Put an actuation in force, without waiting for the server."""
        factor = self._curve_factor(self._car.get_velocity().length())
        steer = self.steer = steer_for(actuation.steering_rad, self._max_steering_rad, factor)
        if self.settings.is_asynchronous:
            self._dither = STEER_DITHER - self._dither
            steer -= math.copysign(self._dither, steer)
            self._sent.note(self._elapsed_s, actuation.throttle, actuation.brake)
        control = self._carla.VehicleControl(
            throttle=actuation.throttle,
            steer=steer,
            brake=actuation.brake,
            hand_brake=hand_brake,
        )
        self._car.apply_control(control)

    def _curve_factor(self, speed_mps: float) -> float:
        """Return the factor by which the server multiplies the steer at a speed."""
        return curve_at(self._steering_curve, speed_mps * MPS_TO_KMH)

    def _read(self) -> Snapshot:
        wheel = self._carla.VehicleWheelLocation
        left_deg, right_deg = (self._car.get_wheel_steer_angle(place) for place in (wheel.FL_Wheel, wheel.FR_Wheel))
        pose, velocity = to_pose(self._car.get_transform()), self._car.get_velocity()
        check_finite((pose.yaw_deg, velocity.x, velocity.y, left_deg, right_deg), self.settings.address)
        return Snapshot(
            self._frame,
            rear_axle_pose(pose, self._axles.rear_axle_m, self.settings.map_shift_m),
            forward_speed_mps((velocity.x, velocity.y), pose.yaw_deg),
            road_wheel_rad(left_deg, right_deg),
            self._car.get_control().gear,
        )

    def _note_collision(self, event: Any) -> None:
        self._events.append(CarlaEvent(event.frame, "collision", f"with {event.other_actor.type_id}"))

    def _note_lane_invasion(self, event: Any) -> None:
        marks = ", ".join(str(mark.type) for mark in event.crossed_lane_markings)
        self._events.append(CarlaEvent(event.frame, "lane_invasion", f"over {marks}"))
