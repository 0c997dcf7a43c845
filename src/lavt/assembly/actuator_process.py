"""The actuator in a separate process, which stops the vehicle when the server's process is frozen or killed.

The server's process renders, encodes and sends pictures. If that process fails, the actuator's process keeps running,
detects the command timeout, and stops the vehicle. If the actuator's process is frozen, no CAN frames are sent, and the
watchdog of the kit in the vehicle brakes.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
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
from lavt.nodes.payloads import Event
from lavt.operating_system import HANGUP
from lavt.runtime import process_priority
from lavt.runtime.output import queue_output
from lavt.runtime.realtime import RealRuntime
from lavt.runtime.remote_node import NodeHost, RemoteNodeProxy
from lavt.runtime.resident_memory import lock_memory
from lavt.runtime.thread_failures import fail_on_thread_errors
from lavt.vehicle.dbw.vehicle import DbwVehicle

NAME = "actuator"
READY_TIMEOUT_S = 30.0
STOP_TIMEOUT_S = 12.0
"""The maximum time for stopping and disengaging the vehicle when the server ends. A vehicle whose speed is implausible
brakes for at least 8 s."""
POLL_PERIOD_S = 0.05
KILL_AFTER_S = 13
"""This many seconds after the server's end, an alarm kills the actuator's process, even if its node is stuck."""
IGNORED_SIGNALS = (signal.SIGINT, signal.SIGTERM, *HANGUP)
"""Signals that all processes of a terminal or service receive. The server's process handles them; this process detects
that the server's process ends."""
THREAD_STACK_BYTES = 2 << 20
"""Size of the stacks of the actuator's threads, which are locked whole. By default it is 8 MiB. At Python's recursion
limit, a recursion through C functions uses more than 1 MiB and less than 2 MiB (measured)."""
ONE_BLAS_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""Environment of the actuator's process. By default, the two copies of OpenBLAS (of NumPy and OpenCV) map a stack and
buffers for each processor, which would be locked: 176 MiB more with two processors (measured)."""

log = logging.getLogger(__name__)


class ActuatorProcess(RemoteNodeProxy):
    """The server's handle of the actuator's process."""

    def __init__(self, process: BaseProcess, connection: Connection) -> None:
        super().__init__(NAME, connection, heartbeat="state", on_silent=_record_silence)
        self._process = process

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid or 0

    def in_force(self) -> tuple[int, int]:
        """Return the epoch in force and the sequence number of its last accepted command, as last reported.

        Before the first report the result is (0, -1): no epoch and no command.
        """
        return self.status or (0, -1)

    def end(self) -> None:
        """Stop the vehicle, disengage, and wait for the end of the process."""
        self.close(STOP_TIMEOUT_S + 2)
        self._process.join(1)
        if self._process.is_alive():  # a frozen process: it sends no CAN frames, so the kit brakes by itself
            self._process.kill()


def _record_silence(runtime: RealRuntime) -> None:
    """Record that the actuator's process no longer reports a state."""
    now = runtime.now()
    log.warning("the process of the %s reports no state", NAME)
    runtime.record("event", Event(now.mono_ns, "silent", f"the process of the {NAME} reports no state"), now)


def start_actuator(config: ServerConfig, *, host: str, video_port: int) -> ActuatorProcess:
    """Start the process; raise its start-up error, which is a `UserError` for invalid input."""
    process, server_end = spawn(serve_actuator, config, host, video_port)
    try:
        error = server_end.recv() if server_end.poll(READY_TIMEOUT_S) else "it did not become ready in time"
    except EOFError:
        error = "it ended"
    except BaseException:  # such as Ctrl-C during the start
        process.kill()
        raise
    if error is None:
        return ActuatorProcess(process, server_end)
    process.kill()
    if isinstance(error, UserError):
        raise error
    raise WorkError(f"the process of the {NAME} failed to start: {error}")


def spawn(serve: Callable[..., None], *arguments: object) -> tuple[BaseProcess, Connection]:
    """Start a process that calls `serve` with a connection and `arguments`; return it and this end of the connection.

    The libraries read the environment when they are loaded, so it must be set when the process starts.
    """
    context = multiprocessing.get_context("spawn")
    own_end, other_end = context.Pipe()
    process = context.Process(target=serve, args=(other_end, *arguments), name=NAME)
    environment = dict(os.environ)
    os.environ.update(ONE_BLAS_THREAD)
    try:
        process.start()
    finally:
        for name in ONE_BLAS_THREAD:
            del os.environ[name]
        os.environ.update(environment)
    other_end.close()
    return process, own_end


def serve_actuator(connection: Connection, config: ServerConfig, host: str, video_port: int) -> None:
    """Run the actuator's process: drive until the server's process ends or requests the end, then stop the vehicle."""
    for signal_number in IGNORED_SIGNALS:
        signal.signal(signal_number, signal.SIG_IGN)
    threading.stack_size(THREAD_STACK_BYTES)
    queue_output("stdout", "stderr")
    os.setsid()  # the kernel schedules this process in a group of its own, apart from the server's
    process_priority.raise_priority(process_priority.VEHICLE_NICENESS)
    if reason := lock_memory():
        log.warning("the process of the %s may have to wait for the disk when memory is scarce: %s", NAME, reason)
    clock = MachineClock()
    try:
        vehicle, start = open_by_wire(config, clock), clock.now()
        node = build_actuator(
            config, vehicle, MachineEntropy(), start, host=host, video_port=video_port, route=driven_route(config)
        )
    except Exception as error:  # the server's process reports every error
        connection.send(error if isinstance(error, UserError) else f"{type(error).__name__}: {error}")
        return
    connection.send(None)
    disconnected = threading.Event()
    node_host = NodeHost(connection, clock, node, get_status=node.gate.in_force, on_disconnect=disconnected.set)
    node_host.start()
    try:
        with fail_on_thread_errors(node_host.runtime.fail):
            while not disconnected.wait(POLL_PERIOD_S) and not node_host.runtime.stopped.is_set():
                pass
            signal.alarm(KILL_AFTER_S)
            node_host.deliver("server_ends", None)
            _wait_until_disengaged(node_host, vehicle, clock)
    finally:
        node_host.close()
        vehicle.close()


def _wait_until_disengaged(node_host: NodeHost, vehicle: DbwVehicle, clock: Clock) -> None:
    """Wait until the vehicle has stopped and is disengaged."""
    end_ns = clock.now().mono_ns + round(STOP_TIMEOUT_S * NS_PER_S)
    never_set = threading.Event()
    while clock.now().mono_ns < end_ns and not node_host.runtime.stopped.is_set():
        never_set.wait(POLL_PERIOD_S)
        if vehicle.is_idle_or_overridden:
            return
