"""The actuator in a process of its own, for vehicles that must not be driven by a server that stands still.

The server's process has pictures to draw, to encode and to send. Whatever it is busy with, and also when it is frozen
or killed, the actuator's goes on, finds silence, and stops the vehicle. When the actuator's own process is frozen, no
frame leaves it, and the vehicle's own watchdog brakes.
"""

from __future__ import annotations

import multiprocessing
import signal
import threading
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

from lavt.assembly.by_wire import open_by_wire
from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.nodes import build_actuator
from lavt.assembly.vehicles import driven_route
from lavt.clock import Clock, MachineClock
from lavt.config import ServerConfig
from lavt.domain import NS_PER_S
from lavt.errors import UserError, WorkError
from lavt.runtime import process_priority
from lavt.runtime.remote_node import NodeHost, RemoteNodeProxy
from lavt.vehicle.dbw.vehicle import DbwVehicle

NAME = "actuator"
READY_S = 30.0
REST_S = 10.0
"""So long a vehicle gets to be stopped and let go of when the server ends."""
LOOK_S = 0.05
IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""These go to all processes of a terminal or service; the server's process decides, and its end is noticed."""


class ActuatorProcess(RemoteNodeProxy):
    """The actuator's process, as the server's sees it."""

    def __init__(self, process: BaseProcess, connection: Connection) -> None:
        super().__init__(NAME, connection)
        self._process = process

    @property
    def pid(self) -> int:
        """The process' number."""
        return self._process.pid or 0

    @property
    def in_force(self) -> tuple[int, int]:
        """The epoch in force and the sequence of the command last obeyed under it, as last told."""
        return self.status or (0, -1)

    def end(self) -> None:
        """Have the vehicle stopped and let go of, and wait for the end."""
        self.close(REST_S + 2)
        self._process.join(1)
        if self._process.is_alive():  # it does not run: nothing leaves it, and the vehicle brakes by itself
            self._process.kill()


def start_actuator(config: ServerConfig, *, host: str, video_port: int) -> ActuatorProcess:
    """Start the process; raises what went wrong in it: `UserError` for wrong input."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=serve_actuator, args=(there, config, host, video_port), name=NAME)
    process.start()
    there.close()
    try:
        said = here.recv() if here.poll(READY_S) else "it did not get ready"
    except EOFError:
        said = "it ended"
    except BaseException:  # Ctrl-C, while it gets ready
        process.kill()
        raise
    if said is None:
        return ActuatorProcess(process, here)
    process.kill()
    if isinstance(said, UserError):
        raise said
    raise WorkError(f"the process of the {NAME} cannot be used: {said}")


def serve_actuator(connection: Connection, config: ServerConfig, host: str, video_port: int) -> None:
    """Be the actuator's process: drive until the server's process ends or says so, then stop the vehicle."""
    for number in IGNORED:
        signal.signal(number, signal.SIG_IGN)
    process_priority.raise_priority(process_priority.VEHICLE_NICENESS)
    clock = MachineClock()
    try:
        vehicle, start = open_by_wire(config.vehicle, clock), clock.now()
        node = build_actuator(
            config, vehicle, MachineEntropy(), start, host=host, video_port=video_port, route=driven_route(config)
        )
    except Exception as error:  # whatever it is, the server's process says it
        connection.send(error if isinstance(error, UserError) else f"{type(error).__name__}: {error}")
        return
    connection.send(None)
    parted = threading.Event()
    here = NodeHost(connection, clock, node, get_status=lambda: node.gate.in_force, on_disconnect=parted.set)
    here.start()
    try:
        while not parted.wait(LOOK_S) and not here.runtime.stopped.is_set():
            pass
        here.deliver("server_ends", None)
        _wait_for_rest(here, vehicle, clock)
    finally:
        here.close()
        vehicle.close()


def _wait_for_rest(here: NodeHost, vehicle: DbwVehicle, clock: Clock) -> None:
    """Wait until the vehicle was stopped and is let go of."""
    end_ns = clock.now().mono_ns + round(REST_S * NS_PER_S)
    rest = threading.Event()
    while clock.now().mono_ns < end_ns and not here.runtime.stopped.is_set():
        rest.wait(LOOK_S)
        if vehicle.is_silent:
            return
