"""A session with a CARLA server: connect, spawn, tick, and leave the server as it was.

The order matters. A server of another version aborts the client's process, so the version is asked for first. The
world is synchronous: it stands still unless this client ticks it, so a dead client leaves a frozen world and no driving
car. The next session removes the actors of a killed one, which it finds by their role name.
"""

from __future__ import annotations

import atexit
import math
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Final

from lavt.domain import Actuation
from lavt.errors import UserError, VehicleError
from lavt.vehicle.carla.frames import (
    Axles,
    CarlaPose,
    actor_pose,
    camera_mount,
    curve_at,
    find_axles,
    forward_speed_mps,
    rear_axle_pose,
    road_wheel_rad,
    steer_for,
)
from lavt.vehicle.carla.library import SUPPORTED, load_library
from lavt.vehicle.carla.pictures import PictureBox
from lavt.vehicle.carla.settings import CarlaEvent, CarlaSettings, Snapshot

SUBSTEP_S: Final = 0.01
"""The longest step of CARLA's physics."""
SPAWN_HEIGHT_M: Final = 0.3
"""The car is spawned at this height above the lane, and drops."""
SETTLING_S: Final = 3.0
"""The longest time that the car may take to come to rest after it was spawned."""
AT_REST_MPS: Final = 0.05
MAX_TICKS_TO_PICTURE: Final = 60
PICTURE_WAIT_S: Final = 0.25
OTHER_CLIENT_WAIT_S: Final = 1.0
CLOSE_TIMEOUT_S: Final = 2.0
BRAKED: Final = Actuation(0.0, 0.0, 1.0)
MPS_TO_KMH: Final = 3.6


class CarlaSession:
    """A car with its sensors in a CARLA server, ticked by this client only.

    Raises `UserError` if the server is absent, of another version, ticked by another client, or has no such town, car
    or free start; raises `VehicleError` if it stops answering.
    """

    def __init__(self, settings: CarlaSettings) -> None:
        self.settings = settings
        self._carla = load_library()
        self.pictures = PictureBox()
        self._events: deque[CarlaEvent] = deque()
        self._actors: list[Any] = []
        """The spawned actors, in order."""
        self._saved: tuple[Any, Any] | None = None
        """The settings and the weather of the world before this session."""
        self._is_closed = False
        self._axles = Axles(0.0, 0.0)
        self._client = self._connect()
        atexit.register(self.close)
        try:
            self._world = self._open_world()
            self._car = self._spawn_car()
            self._settle()
            self._measure_car()
            self._add_sensors()
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

    def tick(self, actuation: Actuation, *, hand_brake: bool = False) -> Snapshot:
        """Advance the world by one tick under an actuation and return the car after it."""
        self._apply(actuation, hand_brake=hand_brake)
        before = self._frame
        with self._failures("complete a tick"):
            self._frame = self._world.tick(self.settings.tick_timeout_s)
            if before and self._frame != before + 1:
                raise VehicleError(
                    f"the CARLA server at {self.settings.address} went from frame {before} to {self._frame} in one tick: "
                    "end the other client that ticks it"
                )
            self._snapshot = self._read()
        return self._snapshot

    @property
    def snapshot(self) -> Snapshot:
        """The car after the newest tick."""
        return self._snapshot

    def take_events(self) -> list[CarlaEvent]:
        """Return the collisions and lane invasions that arrived since the last call."""
        events = []
        with suppress(IndexError):
            while True:
                events.append(self._events.popleft())
        return events

    def close(self) -> None:
        """Brake, destroy the actors in reverse order, and restore the world's settings; a dead server is ignored."""
        if self._is_closed:
            return
        self._is_closed = True
        atexit.unregister(self.close)
        with suppress(RuntimeError):
            self._client.set_timeout(CLOSE_TIMEOUT_S)
            for actor in reversed(self._actors):
                if actor.type_id.startswith("sensor.") and actor.is_listening:
                    actor.stop()
                actor.destroy()
            if self._saved is not None:
                settings, weather = self._saved
                if self.settings.weather:
                    self._world.set_weather(weather)
                self._world.apply_settings(settings)
        self._actors.clear()

    # Opening.

    def _connect(self) -> Any:
        settings = self.settings
        client = self._carla.Client(settings.host, settings.port)
        client.set_timeout(settings.timeout_s)
        try:
            found = client.get_server_version()
        except RuntimeError:
            raise UserError(
                f"no CARLA server answers at {settings.address} within {settings.timeout_s:g} s: start CARLA "
                f"{SUPPORTED} there, or set vehicle.carla.host and vehicle.carla.port"
            ) from None
        if found != SUPPORTED:
            raise UserError(
                f"the CARLA server at {settings.address} has version {found!r}, but LAVT supports {SUPPORTED} only: start "
                f"CARLA {SUPPORTED}"
            )
        return client

    def _open_world(self) -> Any:
        with self._failures("open its world"):
            world = self._client.get_world()
            found = world.get_settings()
            if found.synchronous_mode:
                self._check_nobody_ticks(world)
            world = self._load_town(world)
            before = world.get_settings()
            self._saved = (_to_restore(self._carla, before), world.get_weather())
            self._world = world
            world.apply_settings(self._own_settings(before))
            self._frame = 0
            world.tick(self.settings.tick_timeout_s)  # without a tick, a frozen world shows no actors
            self._remove_leftovers(world)
            if self.settings.weather:
                world.set_weather(self._weather())
        return world

    def _check_nobody_ticks(self, world: Any) -> None:
        with suppress(RuntimeError):
            world.wait_for_tick(OTHER_CLIENT_WAIT_S)
            raise UserError(
                f"another client ticks the CARLA server at {self.settings.address}: end it, because only one client can"
            )

    def _load_town(self, world: Any) -> Any:
        town = self.settings.town
        if not town or _town_of(world) == town:
            return world
        known = sorted(path.rpartition("/")[2] for path in self._client.get_available_maps())
        if town not in known:
            raise UserError(
                f"the CARLA server at {self.settings.address} has no town {town!r}: set vehicle.carla.town to one of "
                f"{', '.join(known)}"
            )
        self._client.set_timeout(self.settings.load_timeout_s)
        world = self._client.load_world(town)
        self._client.set_timeout(self.settings.timeout_s)
        if _town_of(world) != town:
            raise VehicleError(f"the CARLA server loaded the town {_town_of(world)!r} instead of {town!r}: restart it")
        return world

    def _own_settings(self, before: Any) -> Any:
        settings = _copied(self._carla, before)
        settings.synchronous_mode = True
        settings.fixed_delta_seconds = self.settings.tick_s
        settings.substepping = True
        settings.max_substep_delta_time = SUBSTEP_S
        settings.max_substeps = min(16, max(10, math.ceil(self.settings.tick_s / SUBSTEP_S)))
        settings.no_rendering_mode = False
        return settings

    def _weather(self) -> Any:
        weather = getattr(self._carla.WeatherParameters, self.settings.weather, None)
        if not isinstance(weather, self._carla.WeatherParameters):
            raise UserError(
                f"CARLA has no weather {self.settings.weather!r}: set vehicle.carla.weather to a preset such as ClearNoon"
            )
        return weather

    def _remove_leftovers(self, world: Any) -> None:
        """Destroy the actors of a killed session: those with our role name, sensors first."""
        role_name = self.settings.role_name
        ours = [actor for actor in world.get_actors() if actor.attributes.get("role_name") == role_name]
        for actor in sorted(ours, key=lambda actor: actor.id, reverse=True):
            actor.destroy()

    def _spawn_car(self) -> Any:
        settings, carla = self.settings, self._carla
        with self._failures("spawn the car"):
            blueprint = self._blueprint(settings.blueprint)
            # The distance of the rear axle is not known yet, so the origin is put where the middle of the car will be.
            pose = actor_pose(settings.start, self._guessed_rear_axle_m(), settings.map_shift_m)
            lane = self._world.get_map().get_waypoint(carla.Location(pose.x_m, pose.y_m, 0.0), project_to_road=False)
            if lane is None:
                raise UserError(
                    f"the start of the route, x {pose.x_m:.1f} m and y {pose.y_m:.1f} m in CARLA, is on no lane of "
                    f"{_town_of(self._world)}: set vehicle.carla.town and vehicle.carla.map_shift_m, or another route"
                )
            pose = pose._replace(z_m=lane.transform.location.z + SPAWN_HEIGHT_M)
            car = self._world.try_spawn_actor(blueprint, _transform(carla, pose))
            if car is None:
                raise UserError(
                    f"the start of the route is occupied in the CARLA server at {settings.address}: remove the other "
                    "actor, or choose another vehicle.carla.start"
                )
            self._actors.append(car)
        return car

    def _guessed_rear_axle_m(self) -> float:
        return -1.4

    def _settle(self) -> None:
        """Tick, braked, until the car has a pose and rests on the road."""
        self._max_steering_rad, self._steering_curve = 1.0, ()
        for count in range(math.ceil(SETTLING_S / self.settings.tick_s)):
            self.tick(BRAKED, hand_brake=True)
            velocity = self._car.get_velocity()
            if count >= 2 and math.hypot(velocity.x, velocity.y, velocity.z) < AT_REST_MPS:
                return

    def _measure_car(self) -> None:
        with self._failures("describe the car"):
            physics = self._car.get_physics_control()
            pose = _pose(self._car.get_transform())
        wheels = [(wheel.position.x, wheel.position.y) for wheel in physics.wheels]
        if len(wheels) != 4:
            raise UserError(
                f"{self.settings.blueprint} has {len(wheels)} wheels: set vehicle.carla.blueprint to a car with four"
            )
        self._axles = find_axles(pose, wheels)
        if not 1.0 < self._axles.wheelbase_m < 10.0:
            raise VehicleError(
                f"CARLA reports a wheelbase of {self._axles.wheelbase_m:.3g} m for {self.settings.blueprint}: set another "
                "vehicle.carla.blueprint"
            )
        announced_rad = math.radians(max(wheel.max_steer_angle for wheel in physics.wheels))
        self._max_steering_rad = self.settings.max_steering_rad or announced_rad
        if not 0.0 < self._max_steering_rad < math.pi / 2:
            raise VehicleError(
                f"CARLA reports a largest steering angle of {math.degrees(announced_rad):.3g} degrees: measure it with "
                "`lavt carla calibrate` and set vehicle.carla.max_steering_deg"
            )
        self._steering_curve = tuple((point.x, point.y) for point in physics.steering_curve)
        # Now the rear axle is known: put it exactly where the route starts.
        target = actor_pose(self.settings.start, self._axles.rear_axle_m, self.settings.map_shift_m, pose.z_m)
        with self._failures("place the car"):
            self._car.set_transform(_transform(self._carla, target._replace(pitch_deg=pose.pitch_deg)))
        self.tick(BRAKED, hand_brake=True)

    def _add_sensors(self) -> None:
        with self._failures("spawn the sensors"):
            collision = self._attach(self._blueprint("sensor.other.collision"), CarlaPose(0.0, 0.0, 0.0))
            collision.listen(self._note_collision)
            lanes = self._attach(self._blueprint("sensor.other.lane_invasion"), CarlaPose(0.0, 0.0, 0.0))
            lanes.listen(self._note_lane_invasion)
            model = self.settings.camera
            if model is None:
                return
            blueprint = self._blueprint("sensor.camera.rgb")
            for name, text in (
                ("image_size_x", str(model.width_px)),
                ("image_size_y", str(model.height_px)),
                ("fov", repr(math.degrees(model.field_of_view_rad))),
                ("sensor_tick", "0.0"),
                ("motion_blur_intensity", "0.0"),
            ):
                if blueprint.has_attribute(name):
                    blueprint.set_attribute(name, text)
            camera = self._attach(blueprint, camera_mount(model, self._axles.rear_axle_m))
            camera.listen(self.pictures.put)
        for _ in range(MAX_TICKS_TO_PICTURE):
            self.tick(BRAKED, hand_brake=True)
            if self.pictures.wait_for_any(PICTURE_WAIT_S):
                return
        raise VehicleError(
            f"the CARLA server at {self.settings.address} sent no picture in {MAX_TICKS_TO_PICTURE} ticks: start it with "
            "rendering (-RenderOffScreen, not -nullrhi)"
        )

    def _attach(self, blueprint: Any, pose: CarlaPose) -> Any:
        sensor = self._world.spawn_actor(blueprint, _transform(self._carla, pose), attach_to=self._car)
        self._actors.append(sensor)
        return sensor

    def _blueprint(self, name: str) -> Any:
        try:
            blueprint = self._world.get_blueprint_library().find(name)
        except IndexError:
            raise UserError(f"the CARLA server has no {name!r}: set vehicle.carla.blueprint to another car") from None
        if blueprint.has_attribute("role_name"):
            blueprint.set_attribute("role_name", self.settings.role_name)
        return blueprint

    # Driving.

    def _apply(self, actuation: Actuation, *, hand_brake: bool) -> None:
        speed_kmh = abs(self._car.get_velocity().length()) * MPS_TO_KMH
        factor = curve_at(self._steering_curve, speed_kmh)
        control = self._carla.VehicleControl(
            throttle=actuation.throttle,
            steer=steer_for(actuation.steering_rad, self._max_steering_rad, factor),
            brake=actuation.brake,
            hand_brake=hand_brake,
        )
        with self._failures("accept a command"):
            self._car.apply_control(control)

    def _read(self) -> Snapshot:
        wheel = self._carla.VehicleWheelLocation
        left_deg, right_deg = (self._car.get_wheel_steer_angle(place) for place in (wheel.FL_Wheel, wheel.FR_Wheel))
        pose, velocity = _pose(self._car.get_transform()), self._car.get_velocity()
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

    @contextmanager
    def _failures(self, work: str) -> Iterator[None]:
        """Turn an error of the wheel into a sentence."""
        try:
            yield
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise VehicleError(
                f"the CARLA server at {self.settings.address} did not {work} ({reason}): check that it runs, and restart it"
            ) from None


def _copied(carla: Any, found: Any) -> Any:
    settings = carla.WorldSettings()
    for name in dir(found):
        if not name.startswith("_"):
            setattr(settings, name, getattr(found, name))
    return settings


def _to_restore(carla: Any, found: Any) -> Any:
    """Return the settings for the end: those that were found, but of a world that a killed client left frozen, running.

    Nobody ticked the world when it was found, so a synchronous world was frozen.
    """
    settings = _copied(carla, found)
    if found.synchronous_mode:
        settings.synchronous_mode = False
        settings.fixed_delta_seconds = None
    return settings


def _town_of(world: Any) -> str:
    return str(world.get_map().name).rpartition("/")[2]


def _transform(carla: Any, pose: CarlaPose) -> Any:
    return carla.Transform(
        carla.Location(pose.x_m, pose.y_m, pose.z_m), carla.Rotation(pose.pitch_deg, pose.yaw_deg, pose.roll_deg)
    )


def _pose(transform: Any) -> CarlaPose:
    location, rotation = transform.location, transform.rotation
    return CarlaPose(location.x, location.y, location.z, rotation.pitch, rotation.yaw, rotation.roll)
