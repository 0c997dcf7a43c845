"""One interface to both machines: call functions on a machine, and run, start and stop programs."""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Client, Connection
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from tests.kernel.lane import processes
from tests.kernel.lane.agent import PORT

from lavt.clock import pause
from lavt.domain import NS_PER_MS, NS_PER_S

P = ParamSpec("P")
R = TypeVar("R")
RemoteCall = Callable[..., Any]
"""Call `function(*arguments, **keywords)` on a machine and return the function's value."""
POLL_NS = 50 * NS_PER_MS


class MachineError(AssertionError):
    """A failure on a machine, with its output."""


@dataclass(frozen=True)
class Machine:
    """A machine of the lane."""

    name: str
    address: str
    """Address on the network under test."""
    _call: RemoteCall
    interface: str = "vec0"
    """Interface on the network under test."""
    python: str = sys.executable
    _started: list[StartedProgram] = field(default_factory=list)

    def call(self, function: Callable[P, R], *arguments: P.args, **keywords: P.kwargs) -> R:
        """Call a function of a module on that machine; function, arguments and return value must be picklable."""
        result: R = self._call(function, *arguments, **keywords)
        return result

    def run(self, command: Sequence[str], *, timeout_s: float = 60) -> str:
        """Run a program to completion. Return its standard output, or raise `MachineError` with its standard error."""
        code, output, errors = self.call(processes.run, list(command), timeout_s)
        if code != 0:
            raise MachineError(f"{self.name}: {' '.join(command)} ended with {code}: {errors.strip() or output}")
        return output

    def start(self, command: Sequence[str], *, environment: Mapping[str, str] | None = None) -> StartedProgram:
        """Start a program; it is stopped at the end of the test at the latest."""
        started = StartedProgram(
            self, list(command), self.call(processes.start, list(command), dict(environment or {}))
        )
        self._started.append(started)
        return started

    def start_python(self, module: str, *arguments: str) -> StartedProgram:
        """Start a Python module."""
        return self.start([self.python, "-B", "-m", module, *arguments])

    def stop_all(self) -> None:
        """Stop all started programs, the last one first."""
        while self._started:
            self._started.pop().stop()

    def read(self, path: str | Path) -> bytes:
        """Return the contents of a file of that machine."""
        return self.call(Path.read_bytes, Path(path))

    def write(self, path: str | Path, text: str) -> None:
        """Write a file of that machine, and create its directory if necessary."""
        self.call(processes.write, str(path), text)


@dataclass(frozen=True)
class StartedProgram:
    """A program that was started on a machine."""

    machine: Machine
    command: list[str]
    number: int

    def poll(self) -> int | None:
        """Return the exit code, or None while the program runs."""
        return self.machine.call(processes.poll, self.number)

    @property
    def running(self) -> bool:
        """Whether the program runs."""
        return self.poll() is None

    def wait(self, timeout_s: float = 60) -> int:
        """Wait until the program ends; return its exit code."""
        wait_until(f"{' '.join(self.command)} has ended", lambda: not self.running, timeout_s)
        return self.poll() or 0

    def stop(self, with_signal: int = signal.SIGINT, timeout_s: float = 15) -> int:
        """Send a signal and wait until the program ends; kill it after the timeout. Return the exit code."""
        return self.machine.call(processes.stop, self.number, with_signal, timeout_s)

    @property
    def output(self) -> str:
        """Standard output so far."""
        return self.machine.call(processes.output, self.number, "out")

    @property
    def errors(self) -> str:
        """Standard error so far."""
        return self.machine.call(processes.output, self.number, "err")

    def lines(self) -> list[dict[str, Any]]:
        """Return the lines of JSON on standard output so far."""
        return [json.loads(line) for line in self.output.splitlines(keepends=True) if line.endswith("\n")]

    def first_line(self, timeout_s: float = 60) -> dict[str, Any]:
        """Wait for the first line of JSON and return it. Raise `MachineError` if the program ends without one."""
        wait_until(
            f"{' '.join(self.command)} prints a line or ends",
            lambda: "\n" in self.output or not self.running,
            timeout_s,
        )
        lines = self.lines()
        if not lines:
            raise MachineError(f"{self.machine.name}: {' '.join(self.command)} did not start: {self.errors}")
        return lines[0]

    def latest(self) -> dict[str, Any]:
        """Return the newest line of JSON, or an empty dict."""
        line = self.machine.call(processes.newest_line, self.number)
        return json.loads(line) if line else {}


def wait_until(description: str, condition: Callable[[], bool], timeout_s: float, every_ns: int = POLL_NS) -> None:
    """Wait until a condition is true. Raise `MachineError` after `timeout_s`; `description` states the condition."""
    for _ in range(max(1, round(timeout_s * NS_PER_S / every_ns))):
        if condition():
            return
        pause(every_ns)
    raise MachineError(f"not true within {timeout_s:g} s: {description}")


def local_machine(name: str, address: str) -> Machine:
    """Return the machine that this code runs on."""
    return Machine(name, address, lambda function, *arguments, **keywords: function(*arguments, **keywords))


def remote_machine(name: str, address: str, management_address: str, key: bytes) -> Machine:
    """Return the machine whose agent listens at the management address; wait while the machine is still booting."""
    connections: list[Connection] = []

    def is_reachable() -> bool:
        with suppress(OSError):
            connections.append(Client((management_address, PORT), authkey=key))
        return bool(connections)

    wait_until(f"the machine '{name}' has booted", is_reachable, 120)
    lock = threading.Lock()

    def call(function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        with lock:
            connections[0].send((function, arguments, keywords))
            error, result = connections[0].recv()
        if error is not None:
            raise MachineError(f"{name}: {error}")
        return result

    return Machine(name, address, call)
