"""The world of the stand-in server: LAVT's own car, renderer and route monitor behind CARLA's actors.

It is no CARLA: it shows that the genuine client accepts our bytes, not that Unreal behaves like this.
"""

from __future__ import annotations

import itertools
import math
import signal
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from msgspec.structs import replace
from tests.carla import carla_wire as wire
from tests.carla.carla_wire import WireActor, WirePose

from lavt.domain import NS_PER_S, Actuation, CameraModel, Pose
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ, CarMotion
from lavt.vehicle.sim.rendering.renderer import Renderer
from lavt.vehicle.sim.road.opendrive_export import export_road
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.route_monitor import RouteMonitor
from lavt.vehicle.sim.simulator import Simulator

REAR_AXLE_M = -1.4235
"""Position of the rear axle relative to the actor's origin, which is in the middle of the body."""
GRAVITY_CENTRE_M = LINCOLN_MKZ.wheelbase_m - LINCOLN_MKZ.front_axle_to_gravity_m
SPAWN_CLEARANCE_M = 4.0
ASYNCHRONOUS_DT_S = 1 / 45
"""Shorter than the period of any camera in the tests."""

Publish = Callable[[int, bytes], None]
"""Sends the data of a stream to its subscribers."""


class Refused(Exception):
    """A request that the server answers with an error."""


class DrivenCar:
    """A car of LAVT's simulator, placed anywhere on a road, whose pose and controls are those of an actor."""

    def __init__(self, road: Road, actor: WireActor, elapsed_ns: int) -> None:
        self._simulator = Simulator(road=road, seed=1, start_mono_ns=elapsed_ns)
        self._actor = actor
        heading_rad = -math.radians(actor.pose.rotation[1])
        x_m = actor.pose.location[0] + REAR_AXLE_M * math.cos(heading_rad)
        y_m = -actor.pose.location[1] + REAR_AXLE_M * math.sin(heading_rad)
        motion = CarMotion(x_m, y_m, heading_rad)
        stations_m = np.arange(road.first_m, road.last_m, 1.0)
        xs_m, ys_m, _, _ = road.centre_at(stations_m)
        near_m = float(stations_m[np.argmin(np.hypot(xs_m - x_m, ys_m - y_m))])
        self._simulator._car.motion = motion
        self._simulator._route_monitor = RouteMonitor(road, LINCOLN_MKZ, near_m, limit_s=1e6)
        self._simulator._route_monitor.update(motion, elapsed_ns)

    def control(self, fields: list[Any], now_ns: int) -> None:
        """Apply a `VehicleControl` from `now_ns` on."""
        throttle, steer, brake, hand_brake, *_ = fields
        self._actor.control = [*fields[:6], 1]
        steering_rad = -float(steer) * LINCOLN_MKZ.max_steering_rad
        self._simulator.apply(Actuation(steering_rad, float(throttle), 1.0 if hand_brake else float(brake)), now_ns)

    def advance(self, to_ns: int) -> bool:
        """Advance to a time; return whether the car collided."""
        events = self._simulator.advance(to_ns)
        motion = self._simulator._car.motion
        actor, heading_rad = self._actor, motion.heading_rad
        cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
        x_m, y_m = motion.x_m - REAR_AXLE_M * cosine, motion.y_m - REAR_AXLE_M * sine
        side_mps = motion.side_speed_mps + motion.yaw_rate_radps * (-REAR_AXLE_M - GRAVITY_CENTRE_M)
        actor.pose = WirePose((x_m, -y_m, 0.0), (0.0, -math.degrees(heading_rad), 0.0))
        actor.velocity = (
            motion.speed_mps * cosine - side_mps * sine,
            -(motion.speed_mps * sine + side_mps * cosine),
            0.0,
        )
        actor.angular_degps = (0.0, 0.0, -math.degrees(motion.yaw_rate_radps))
        return any(event.kind == "collision" for event in events)

    @property
    def wheel_deg(self) -> float:
        """The angle of the front wheels in CARLA's sign."""
        return -math.degrees(self._simulator._car.motion.steering_rad)

    def rear_axle_pose(self) -> Pose:
        """Return the rear axle's pose in LAVT's frame."""
        return self._simulator.pose()


@dataclass
class Faults:
    """What the world does wrong."""

    late_pictures: int = 0
    """So many of the first ticks of a camera have no picture."""
    missing_rows: int = 0
    """Pictures lack so many of their last rows."""
    garbled_states: int = 0
    """So many of the next states cannot be read by the package `carla`."""
    kept_kind: str = ""
    """Actors of this kind cannot be removed."""
    interrupted_process: int = 0
    interrupted_method: str = ""
    interrupting_signal: int = signal.SIGINT
    """During the next request of this method, the process gets this signal."""


class StandInWorld:
    """One episode at a time: actors, settings and the clock of the world. Its user holds a lock around every call."""

    def __init__(self, road: Road, town: str, port: int, publish: Publish, *, seed: int, scenery: Any = "full") -> None:
        self.road, self.town, self._seed, self._scenery = road, town, seed, scenery
        self.map_text = export_road(road).text
        self._stream_port, self._publish = port + 1, publish
        self.frame, self.elapsed_ns, self.episode = 100, 0, 7
        self.settings: list[Any] = [False, False, [False], True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True]
        self.actors: dict[int, WireActor] = {}
        self._cars: dict[int, DrivenCar] = {}
        self._renderers: dict[int, Renderer] = {}
        self._prepared: dict[str, Renderer] = {}
        self._numbers, self._streams = itertools.count(20), itertools.count(2)
        self._pictures = itertools.count()
        self._withheld: dict[int, int] = {}
        self.faults = Faults()
        self.kept_control: list[Any] = []
        """The control of an actor at the moment of the refusal to remove it."""

    @property
    def is_synchronous(self) -> bool:
        """Whether a client ticks the world."""
        return bool(self.settings[0])

    @property
    def start(self) -> WirePose:
        """The place at the start of the route, which the town recommends."""
        x_m, y_m, heading_rad = self.road.start
        return WirePose((x_m, -y_m, 0.0), (0.0, -math.degrees(heading_rad), 0.0))

    @property
    def dt_s(self) -> float:
        """The length of a tick: the setting, or that of the asynchronous world."""
        return float(self.settings[2][1]) if self.settings[2][0] else ASYNCHRONOUS_DT_S

    def tick(self, platform_s: float, dt_s: float | None = None) -> int:
        """Advance the world by one tick and publish its state and its sensors' data; return the frame."""
        dt_s = self.dt_s if dt_s is None else dt_s
        self.frame += 1
        self.elapsed_ns += round(dt_s * NS_PER_S)
        collided = [number for number, car in self._cars.items() if car.advance(self.elapsed_ns)]
        actors = list(self.actors.values())
        for actor in actors:
            self._report_collision(actor, collided)
        state = wire.snapshot_data(self.episode, platform_s, dt_s, actors)
        if self.faults.garbled_states:
            self.faults.garbled_states -= 1
            state = state[:-1]
        self._publish(wire.WORLD_STREAM, self._header(wire.WORLD_SENSOR, WirePose()) + state)
        for actor in actors:  # pictures come last, because they take longest
            self._take_picture(actor)
        return self.frame

    def spawn(self, description: list[Any], pose: WirePose, parent: int = 0) -> list[Any]:
        """Create an actor and return it as the protocol describes it; raise `Refused` if its place is occupied."""
        _, kind, attributes = description
        if kind == wire.VEHICLE:
            for other in self.actors.values():
                distance_m = math.dist(other.pose.location[:2], pose.location[:2])
                if other.kind == wire.VEHICLE and distance_m < SPAWN_CLEARANCE_M:
                    raise Refused("Spawn failed because of collision at spawn position")
        has_stream = kind in {wire.CAMERA, wire.COLLISION}
        actor = WireActor(
            next(self._numbers),
            parent,
            kind,
            {name: (kind_number, text) for name, kind_number, text in attributes},
            pose,
            next(self._streams) if has_stream else 0,
        )
        self.actors[actor.number] = actor
        if kind == wire.VEHICLE:
            self._cars[actor.number] = DrivenCar(self.road, actor, self.elapsed_ns)
        if kind == wire.CAMERA:
            self._withheld[actor.number] = self.faults.late_pictures
            self._renderers[actor.number] = self._build_renderer(actor)
        return actor.packed(self._stream_port)

    def destroy(self, number: int) -> bool:
        """Remove an actor; return whether it existed and is not of the kind that is kept."""
        if number in self.actors and self.actors[number].kind == self.faults.kept_kind:
            self.kept_control = self.actors[number].control
            return False
        self._cars.pop(number, None)
        self._renderers.pop(number, None)
        return self.actors.pop(number, None) is not None

    def reload(self) -> int:
        """Begin a new episode without actors; return its number."""
        for number in list(self.actors):
            self.destroy(number)
        self.episode += 1
        return self.episode

    def packed_actors(self, numbers: list[int]) -> list[Any]:
        """Return the actors that exist in the protocol."""
        return [self.actors[number].packed(self._stream_port) for number in numbers if number in self.actors]

    def control(self, number: int, fields: list[Any]) -> None:
        """Apply a control to a car, if it exists."""
        if number in self._cars:
            self._cars[number].control(fields, self.elapsed_ns)

    def place(self, number: int, pose: WirePose) -> None:
        """Put a car, stationary, at a pose."""
        if number in self._cars:
            actor = self.actors[number]
            actor.pose = pose
            self._cars[number] = DrivenCar(self.road, actor, self.elapsed_ns)

    def physics_control(self, number: int) -> list[Any]:
        """Return the physics control of a car."""
        actor = self.actors[number]
        yaw_rad = math.radians(actor.pose.rotation[1])

        def place(ahead_m: float, right_m: float) -> list[float]:
            x_m, y_m, z_m = actor.pose.location
            return [
                x_m + ahead_m * math.cos(yaw_rad) - right_m * math.sin(yaw_rad),
                y_m + ahead_m * math.sin(yaw_rad) + right_m * math.cos(yaw_rad),
                z_m + 0.35,
            ]

        wheels = wire.WheelSet(LINCOLN_MKZ.wheelbase_m, 1.6, REAR_AXLE_M, math.degrees(LINCOLN_MKZ.max_steering_rad))
        return wire.physics_control(wheels, place, LINCOLN_MKZ.mass_kg, [(0.0, 1.0), (120.0, 1.0)])

    def wheel_deg(self, number: int) -> float:
        """Return the angle of a car's front wheels."""
        return self._cars[number].wheel_deg if number in self._cars else 0.0

    def sensor_token(self, stream: int) -> bytes:
        """Return the token of a stream."""
        return wire.token(stream, self._stream_port)

    def _header(self, kind: int, pose: WirePose) -> bytes:
        return wire.sensor_header(kind, self.frame, self.elapsed_ns / NS_PER_S, pose)

    def _report_collision(self, actor: WireActor, collided: list[int]) -> None:
        if actor.kind == wire.COLLISION and actor.parent in collided:
            car = self.actors[actor.parent].packed(self._stream_port)
            content = msgpack.packb([car, car, [0.0, 100.0, 0.0]])
            self._publish(actor.stream, self._header(wire.COLLISION_SENSOR, actor.pose) + content)

    def _take_picture(self, actor: WireActor) -> None:
        if actor.number in self._renderers and actor.parent in self._cars:
            self._withheld[actor.number] -= 1
            if self._withheld[actor.number] < 0:
                self._publish(actor.stream, self._picture(actor))

    def _picture(self, actor: WireActor) -> bytes:
        pose = self._cars[actor.parent].rear_axle_pose()
        picture = self._renderers[actor.number].render(pose, next(self._pictures))
        picture = picture[: len(picture) - self.faults.missing_rows]
        height_px, width_px, _ = picture.shape
        bgra = np.full((height_px, width_px, 4), 255, np.uint8)
        bgra[:, :, :3] = picture
        field_of_view_deg = float(actor.attributes["fov"][1])
        data = wire.picture_data(width_px, height_px, field_of_view_deg, bgra.tobytes())
        return self._header(wire.CAMERA_SENSOR, actor.pose) + data

    def _build_renderer(self, actor: WireActor) -> Renderer:
        (x_m, y_m, z_m), (pitch_deg, yaw_deg, roll_deg) = actor.pose.location, actor.pose.rotation
        attributes = {name: text for name, (_, text) in actor.attributes.items()}
        return self._renderer_of(
            CameraModel(
                int(attributes["image_size_x"]),
                int(attributes["image_size_y"]),
                math.radians(float(attributes["fov"])),
                round(x_m - REAR_AXLE_M, 6),
                round(z_m, 6),
                round(-math.radians(pitch_deg), 6),
                round(-y_m, 6),
                round(-math.radians(yaw_deg), 6),
                round(math.radians(roll_deg), 6),
            )
        )

    def prepare_camera(self, model: CameraModel) -> None:
        """Build the renderer of a camera before it is spawned, because that takes seconds on a busy machine."""
        self._renderer_of(model)

    def _renderer_of(self, model: CameraModel) -> Renderer:
        key = repr(replace(model, field_of_view_rad=round(model.field_of_view_rad, 6)))
        if key not in self._prepared:
            self._prepared[key] = Renderer(self.road, model, seed=self._seed, scenery=self._scenery)
            self._prepared[key].prepare()
        return self._prepared[key]
