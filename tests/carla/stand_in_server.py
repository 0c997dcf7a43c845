"""A stand-in for a CARLA server, for tests: msgpack-rpc on a TCP port, sensor data on the next one.

    python -m tests.carla.stand_in_server --port 2000 --road a_key

prints a line with its port when it accepts connections, and then answers commands on standard input, at whose end it
ends. Only the genuine wheel `carla` 0.9.16 is used to talk to it.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import queue
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import msgpack
from tests.carla import carla_wire as wire
from tests.carla.stand_in_world import ASYNCHRONOUS_DT_S, Refused, StandInWorld

from lavt.domain import NS_PER_S, CameraModel
from lavt.vehicle.sim.road.road import load_road

MAP_FILE = "OpenDrive"


MAX_WAITING = 64
"""So many messages wait for a subscriber that does not read; further ones are dropped for it."""


class Subscriber:
    """A client of a stream, with a thread that sends: a client that does not read must not stop the world."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._waiting: queue.Queue[bytes] = queue.Queue(MAX_WAITING)
        self.is_gone = False
        threading.Thread(target=self._send, daemon=True).start()

    def put(self, data: bytes) -> None:
        """Send data when the client reads."""
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(data)

    def _send(self) -> None:
        try:
            while True:
                self._connection.sendall(self._waiting.get())
        except OSError:
            self.is_gone = True


class Streams:
    """The subscribers of each stream."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribers: dict[int, list[Subscriber]] = {}

    def subscribe(self, connection: socket.socket) -> None:
        """Read the number of the stream that a client wants, and add the client."""
        number = connection.recv(4, socket.MSG_WAITALL)
        if len(number) == 4:
            with self._lock:
                self._subscribers.setdefault(struct.unpack("<I", number)[0], []).append(Subscriber(connection))

    def publish(self, stream: int, data: bytes) -> None:
        """Send data to all subscribers; forget those that are gone."""
        with self._lock:
            subscribers = [each for each in self._subscribers.get(stream, []) if not each.is_gone]
            self._subscribers[stream] = subscribers
        for subscriber in subscribers:
            subscriber.put(struct.pack("<I", len(data)) + data)


def _described(control: list[Any]) -> str:
    """Return throttle, brake and hand brake of a `VehicleControl`."""
    throttle, _, brake, hand_brake, *_ = control
    return f"{throttle} {brake} {hand_brake}"


class StandInServer:
    """The methods of the protocol by name, on a world."""

    def __init__(self, world: StandInWorld, version: str) -> None:
        self._world, self._version = world, version
        self._lock = threading.Lock()
        self._tick_times_ns: list[int] = []
        """When each tick began."""
        self._pace = 1.0
        """How much faster than the clock an asynchronous world runs."""
        self._methods: dict[str, Callable[..., Any]] = {
            "version": lambda: wire.value(self._version),
            "get_episode_info": lambda: wire.value([world.episode, [world.sensor_token(wire.WORLD_STREAM)]]),
            "get_sensor_token": lambda stream: wire.value([world.sensor_token(stream)]),
            "get_episode_settings": lambda: wire.value(world.settings),
            "set_episode_settings": self._set_settings,
            "get_required_files": lambda *_: wire.value([]),
            "query_lights_state": lambda *_: wire.value([]),
            "get_available_maps": lambda: wire.value([f"/Game/Carla/Maps/{world.town}"]),
            "get_map_info": lambda: wire.value([f"Carla/Maps/{world.town}", [world.start.packed()]]),
            "get_map_data": lambda: wire.value(world.map_text),
            "request_file": lambda *_: wire.value(world.map_text.encode()),
            "get_actor_definitions": lambda: wire.value(wire.DEFINITIONS),
            "spawn_actor": lambda description, pose: wire.value(world.spawn(description, wire.pose_of(pose))),
            "spawn_actor_with_parent": lambda description, pose, parent, *_: wire.value(
                world.spawn(description, wire.pose_of(pose), parent)
            ),
            "get_actors_by_id": lambda numbers: wire.value(world.packed_actors(numbers)),
            "get_actor_bounding_box": lambda _: wire.value(wire.BOX),
            "destroy_actor": lambda number: wire.value(world.destroy(number)),
            "get_physics_control": lambda number: wire.value(world.physics_control(number)),
            "get_wheel_steer_angle": lambda number, _: wire.value(world.wheel_deg(number)),
            "apply_control_to_vehicle": self._control,
            "apply_batch": self._batch,
            "set_actor_target_velocity": lambda *_: wire.done(),
            "set_actor_transform": self._place,
            "get_weather_parameters": lambda: wire.value(wire.WEATHER),
            "tick_cue": self._tick_cue,
            "load_new_episode": lambda *_: wire.value(world.reload()),
            "set_weather_parameters": lambda *_: wire.done(),
            "enable_sensor_for_ros": lambda *_: wire.done(),
            "disable_sensor_for_ros": lambda *_: wire.done(),
            "is_sensor_enabled_for_ros": lambda *_: wire.value(False),
        }

    def serve(self, connection: socket.socket) -> None:
        """Answer the requests of a client until it goes."""
        unpacker = msgpack.Unpacker(raw=False, strict_map_key=False)
        while data := _received(connection):
            unpacker.feed(data)
            for _, number, method, arguments in unpacker:
                answer = msgpack.packb([1, number, None, self._answer(method, arguments[1:])])
                try:
                    connection.sendall(answer)
                except OSError:
                    return

    def run_asynchronously(self) -> None:
        """Tick in real time as long as the world is not synchronous; elapsed time follows the clock exactly."""
        last_ns = time.monotonic_ns()
        due_s = last_ns / NS_PER_S
        while True:
            due_s = max(due_s + ASYNCHRONOUS_DT_S, time.monotonic())
            time.sleep(max(0.0, due_s - time.monotonic()))
            with self._lock:
                now_ns = time.monotonic_ns()
                if not self._world.is_synchronous:
                    self._tick_times_ns.append(now_ns)
                    self._world.tick(now_ns / NS_PER_S, (now_ns - last_ns) / NS_PER_S * self._pace)
            last_ns = now_ns

    def report(self, command: list[str]) -> str:
        """Return the answer to a test's command on standard input."""
        world = self._world
        with self._lock:
            match command:
                case ["actors"]:
                    return " ".join(actor.kind for actor in world.actors.values())
                case ["settings"]:
                    return f"{world.settings[0]} {world.settings[2]}"
                case ["park", x_m, y_m]:
                    pose = wire.WirePose((float(x_m), -float(y_m), 0.0))
                    world.spawn([0, wire.VEHICLE, [["role_name", wire.STRING, "parked"]]], pose)
                    return "parked"
                case ["fault", name, value]:
                    setattr(world.faults, name, int(value) if value.isdecimal() else value)
                    return "set"
                case ["destroy", kind]:
                    number = next(actor.number for actor in world.actors.values() if actor.kind == kind)
                    return str(world.destroy(number))
                case ["tick_times"]:
                    return " ".join(map(str, self._tick_times_ns))
                case ["pace", factor]:
                    self._pace = float(factor)
                    return "set"
                case ["control", kind]:
                    return _described(next(actor for actor in world.actors.values() if actor.kind == kind).control)
                case ["kept_control"]:
                    return _described(world.kept_control)
                case ["frame"]:
                    return str(world.frame)
                case ["speed"]:
                    return " ".join(f"{math.hypot(*actor.velocity):.3f}" for actor in world.actors.values())
                case _:
                    return "unknown"

    def _answer(self, method: str, arguments: list[Any]) -> Any:
        if method not in self._methods:
            print(f"stand-in: no method {method} {arguments!r}", file=sys.stderr, flush=True)
            return wire.failure(f"the stand-in has no method {method}")
        with self._lock:
            if method == self._world.faults.interrupted_method:
                self._world.faults.interrupted_method = ""
                os.kill(self._world.faults.interrupted_process, self._world.faults.interrupting_signal)
            try:
                return self._methods[method](*arguments)
            except Refused as refusal:
                return wire.failure(str(refusal))

    def _set_settings(self, settings: list[Any]) -> Any:
        self._world.settings = settings
        return wire.value(self._world.frame)

    def _control(self, number: int, fields: list[Any]) -> Any:
        self._world.control(number, fields)
        return wire.done()

    def _batch(self, commands: list[Any], _: bool) -> Any:
        """Apply controls to cars: the only command that LAVT sends in a batch."""
        for [[kind, [number, fields]]] in commands:
            assert kind == wire.APPLY_VEHICLE_CONTROL
            self._world.control(number, fields)
        return [wire.value(number) for [[_, [number, _]]] in commands]

    def _place(self, number: int, pose: Any) -> Any:
        self._world.place(number, wire.pose_of(pose))
        return wire.done()

    def _tick_cue(self) -> Any:
        self._tick_times_ns.append(time.monotonic_ns())
        return wire.value(self._world.tick(time.monotonic()))


def _received(connection: socket.socket) -> bytes:
    try:
        return connection.recv(1 << 16)
    except OSError:
        return b""


def _accept(listener: socket.socket, serve: Callable[[socket.socket], None]) -> None:
    while True:
        connection, _ = listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=serve, args=(connection,), daemon=True).start()


def main() -> None:
    """Serve until standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--road", default="a_key")
    parser.add_argument("--town", default="StandIn")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scenery", default="full")
    parser.add_argument("--version", default=wire.VERSION)
    parser.add_argument("--camera", type=int, nargs=2, help="prepare the default camera in this size")
    given = parser.parse_args()
    streams = Streams()
    world = StandInWorld(
        load_road(given.road), given.town, given.port, streams.publish, seed=given.seed, scenery=given.scenery
    )
    if given.camera:
        world.prepare_camera(CameraModel(*given.camera))
    server = StandInServer(world, given.version)
    for port, serve in ((given.port, server.serve), (given.port + 1, streams.subscribe)):
        listener = socket.create_server(("127.0.0.1", port))
        threading.Thread(target=_accept, args=(listener, serve), daemon=True).start()
    threading.Thread(target=server.run_asynchronously, daemon=True).start()
    print(f"ready {given.port}", flush=True)
    for line in sys.stdin:
        print(server.report(line.split()), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
