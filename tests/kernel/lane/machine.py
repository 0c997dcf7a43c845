"""One interface to both machines: call a function there, run a program, start one and end it."""

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
Call = Callable[..., Any]
"""(function, *arguments, **keywords) -> what it returns on that machine."""
POLL_NS = 50 * NS_PER_MS


class MachineError(AssertionError):
    """Something failed on a machine: what it said."""


@dataclass(frozen=True)
class Machine:
    """A machine of the lane."""

    name: str
    address: str
    """On the network under test."""
    _call: Call
    interface: str = "vec0"
    """The network under test."""
    python: str = sys.executable
    _started: list[Started] = field(default_factory=list)

    def call(self, function: Callable[P, R], *arguments: P.args, **keywords: P.kwargs) -> R:
        """Call a function of a module on that machine; it, what it takes and what it gives must be picklable."""
        result: R = self._call(function, *arguments, **keywords)
        return result

    def run(self, command: Sequence[str], *, timeout_s: float = 60) -> str:
        """Run a program to its end; give its standard output, or raise `MachineError` with its standard error."""
        code, output, errors = self.call(processes.run, list(command), timeout_s)
        if code != 0:
            raise MachineError(f"{self.name}: {' '.join(command)} ended with {code}: {errors.strip() or output}")
        return output

    def start(self, command: Sequence[str], *, environment: Mapping[str, str] | None = None) -> Started:
        """Start a program, which is ended with the test at the latest."""
        started = Started(self, list(command), self.call(processes.start, list(command), dict(environment or {})))
        self._started.append(started)
        return started

    def start_python(self, module: str, *arguments: str) -> Started:
        """Start a module of Python."""
        return self.start([self.python, "-B", "-m", module, *arguments])

    def end_all(self) -> None:
        """End all that was started, the last one first."""
        while self._started:
            self._started.pop().stop()

    def read(self, path: str | Path) -> bytes:
        """Read a file of that machine."""
        return self.call(Path.read_bytes, Path(path))

    def write(self, path: str | Path, text: str) -> None:
        """Write a file of that machine, in a directory made where there is none."""
        self.call(processes.write, str(path), text)


@dataclass(frozen=True)
class Started:
    """A program that was started on a machine."""

    machine: Machine
    command: list[str]
    number: int

    def poll(self) -> int | None:
        """Exit code, None while it runs."""
        return self.machine.call(processes.poll, self.number)

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.poll() is None

    def wait(self, timeout_s: float = 60) -> int:
        """Wait for its end; give its exit code."""
        wait_until(f"{' '.join(self.command)} has ended", lambda: not self.running, timeout_s)
        return self.poll() or 0

    def stop(self, with_signal: int = signal.SIGINT, timeout_s: float = 15) -> int:
        """Tell it to end and wait until it has; one that does not is killed."""
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
        """Lines of JSON on standard output so far."""
        return [json.loads(line) for line in self.output.splitlines(keepends=True) if line.endswith("\n")]

    def first_line(self, timeout_s: float = 60) -> dict[str, Any]:
        """Wait for the first line of JSON; raise `MachineError` where the program ends without one."""
        wait_until(
            f"{' '.join(self.command)} says something", lambda: "\n" in self.output or not self.running, timeout_s
        )
        lines = self.lines()
        if not lines:
            raise MachineError(f"{self.machine.name}: {' '.join(self.command)} did not start: {self.errors}")
        return lines[0]

    def latest(self) -> dict[str, Any]:
        """Newest line of JSON."""
        tail = self.machine.call(processes.tail, self.number)
        return json.loads(tail) if tail else {}


def wait_until(what: str, holds: Callable[[], bool], timeout_s: float, every_ns: int = POLL_NS) -> None:
    """Wait until something holds; raises `MachineError` where it does not in time."""
    for _ in range(max(1, round(timeout_s * NS_PER_S / every_ns))):
        if holds():
            return
        pause(every_ns)
    raise MachineError(f"waited {timeout_s:g} s in vain until {what}")


def local_machine(name: str, address: str) -> Machine:
    """Give the machine that this runs on."""
    return Machine(name, address, lambda function, *arguments, **keywords: function(*arguments, **keywords))


def remote_machine(name: str, address: str, manager: str, key: bytes) -> Machine:
    """Give the machine whose agent listens at the address `manager`; it may still be booting."""
    found: list[Connection] = []

    def reached() -> bool:
        with suppress(OSError):
            found.append(Client((manager, PORT), authkey=key))
        return bool(found)

    wait_until(f"the {name}'s machine has booted", reached, 120)
    one_at_a_time = threading.Lock()

    def call(function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        with one_at_a_time:
            found[0].send((function, arguments, keywords))
            raised, result = found[0].recv()
        if raised is not None:
            raise MachineError(f"{name}: {raised}")
        return result

    return Machine(name, address, call)
