"""A server that drives a software car over CAN, as real processes, and what somebody beside the car sees of it."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from tests.support.ports import free_port
from tests.support.stalls import STALL_MS, Stalls

from lavt.clock import MachineClock, pause
from lavt.config import RunConfig
from lavt.config_file import parse_config
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.processes import LAVT, Processes
from lavt.experiment.runs.real_run import LoopProcesses, start_loop
from lavt.experiment.runs.side_configs import server_config

GROUP = "239.74.163.2"
"""Of UDP multicast, which is a CAN bus between processes where the kernel has none."""
CLOCK = MachineClock()
LONGEST_NS = 60 * NS_PER_S
KIT_MS = 100
"""The kit lets go so long after the last command, and had one before the fault."""
ROOM_MS = 60
"""For a busy machine, beside what the design promises."""
BEFORE_MS = 200
"""What the host did so long before the kit let go may be why."""
STOP_BEFORE_MS, STOP_STALL_MS = 1500, 100
"""The same for a safe stop, which comes after 500 ms and is told within 200 ms; a shorter stall does not explain it."""
GENERATIONS = ("dataspeed_gen1", "dataspeed_gen2")


def proved(profile: str, work: Path, stalls: Stalls) -> RunConfig:
    """Give a run whose vehicle is a software car on a bus of its own; that its watchdog brakes is proved."""
    run = run_config(profile, work / f"{profile}.json")
    config = write_config(run, work / f"{profile}.yaml")
    with software_car(config) as car:
        command = [sys.executable, "-m", "lavt", "can", "test-watchdog", str(config), "--yes"]
        since_ns = CLOCK.now().mono_ns
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        stalls.require(done.returncode == 0, f"{done.stderr}, {car.events}", since_ns, CLOCK.now().mono_ns)
    return run


def write_config(run: RunConfig, path: Path) -> Path:
    """Write the server's part of a run."""
    path.write_text(yaml.safe_dump(server_config(run, plan_run(run).seed).model_dump(mode="json")))
    return path


def run_config(profile: str, proof: Path) -> RunConfig:
    """Give a run whose vehicle is a software car on a bus of its own."""
    dbw = {
        "profile": profile,
        "interface": "udp_multicast",
        "channel": GROUP,
        "options": {"port": free_port()},
        "truth": f"127.0.0.1:{free_port()}",
        "steering_sign": 1,
        "watchdog_proof": str(proof),
    }
    said = {
        "vehicle": {"kind": "dbw", "route": "a_key", "scenery": "none", "dbw": dbw},
        "camera": {"width_px": 320, "height_px": 240, "rate_hz": 30},
        "network": {"injection": "none"},
        "time": "real",
    }
    return parse_config(RunConfig, said, "the run")


def ms_since(at_ns: int, since_ns: int) -> float:
    """Tell how many ms there are between two times."""
    return (at_ns - since_ns) / NS_PER_MS


@dataclass
class Car:
    """`lavt software-car` as a process, and what it told.

    What it does too late is excused by stalls of the host at that time; without their record nothing is.
    """

    process: subprocess.Popen[str]
    stalls: Stalls | None = None
    stall_ms: float = STALL_MS
    events: list[dict[str, Any]] = field(default_factory=list)
    _lines: queue.SimpleQueue[dict[str, Any] | None] = field(default_factory=queue.SimpleQueue)
    _reader: threading.Thread = field(default_factory=threading.Thread)

    def __post_init__(self) -> None:
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        assert "ready" in (self._lines.get(timeout=60) or {})

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(json.loads(line))
        self._lines.put(None)

    def act(self, words: str) -> int:
        """Say words to it; tell when."""
        assert self.process.stdin is not None
        at_ns = CLOCK.now().mono_ns
        self.process.stdin.write(words + "\n")
        self.process.stdin.flush()
        return at_ns

    def heard(self, kind: str, text: str, *, since_ns: int = 0) -> int | None:
        """Tell when something was first told after a time; None: it was not."""
        while not self._lines.empty():
            line = self._lines.get()
            if line is not None and "kind" in line:
                self.events.append(line)
        told = (each for each in self.events if each["kind"] == kind and text in each["text"])
        return next((each["mono_ns"] for each in told if each["mono_ns"] >= since_ns), None)

    def wait(self, kind: str, text: str, *, since_ns: int = 0, within_ns: int = LONGEST_NS) -> int:
        """Wait until it tells something, unless its watchdog brakes before; tell when that was.

        What never comes is a fault, whatever the host did.
        """
        end_ns = CLOCK.now().mono_ns + within_ns
        braked_ns = None
        while braked_ns is None and CLOCK.now().mono_ns < end_ns:
            braked_ns = self.braked_ns()
            at_ns = self.heard(kind, text, since_ns=since_ns)
            if at_ns is not None:
                return at_ns
            pause(5 * NS_PER_MS)
        said = f"the car told no {kind!r} with {text!r}: {self.events}"
        raise AssertionError(said) if braked_ns is None else self.let_go_wrongly(braked_ns, said)

    def braked_ns(self) -> int | None:
        """Tell when its watchdog braked first; None: it did not."""
        return self.heard("watchdog", "watchdog brakes")

    def let_go_wrongly(self, braked_ns: int, said: str) -> Exception:
        """Give what to raise where the kit got no command in time though nothing was broken."""
        return self.verdict(said, braked_ns - BEFORE_MS * NS_PER_MS, braked_ns)

    def verdict(self, said: str, since_ns: int, until_ns: int) -> Exception:
        """Give what to raise for something that was too late."""
        if self.stalls is None:
            return AssertionError(said)
        return self.stalls.verdict(said, since_ns, until_ns, stall_ms=self.stall_ms)

    def held(self, since_ns: int, *, room_ms: float = ROOM_MS) -> float:
        """Wait until the kit has let go and brakes by its watchdog, in time; tell how many ms after something."""
        at_ns = self.wait("watchdog", "watchdog brakes: no command in time", since_ns=since_ns)
        took_ms, limit_ms = ms_since(at_ns, since_ns), KIT_MS + room_ms
        if took_ms >= limit_ms:
            said = f"the kit brakes only {took_ms:.0f} ms after: {self.events}"
            raise self.verdict(said, since_ns - KIT_MS * NS_PER_MS, since_ns + round(limit_ms * NS_PER_MS))
        return took_ms

    def parked(self, since_ns: int) -> float:
        """Wait until it stands in park and nothing is enabled; tell how many ms after something it was in park."""
        at_ns = self.wait("gear", "gear PARK", since_ns=since_ns)
        self.wait("enabled", "lets go", since_ns=since_ns)
        braked_ns = self.braked_ns()
        if braked_ns is not None:
            raise self.let_go_wrongly(braked_ns, f"the watchdog stopped it: {self.events}")
        return ms_since(at_ns, since_ns)

    def end(self) -> None:
        """End it, as Ctrl-C does."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(20)
        self._reader.join()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


@contextmanager
def software_car(
    config: str | Path, *changes: str, stalls: Stalls | None = None, stall_ms: float = STALL_MS
) -> Iterator[Car]:
    """Start a software car of a server's config."""
    process = subprocess.Popen(
        [sys.executable, "-m", "lavt", "software-car", str(config), *changes, "--json"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    car = Car(process, stalls, stall_ms)
    try:
        yield car
    finally:
        car.end()


@dataclass
class Driven:
    """A drive over CAN that is under way."""

    car: Car
    loop: LoopProcesses
    out: Path
    actuator_pid: int
    stalls: Stalls

    def status(self) -> dict[str, Any]:
        """Give what the server told of itself last."""
        told: dict[str, Any] = self.loop.server.latest.get("status", {})
        return told

    def reach_speed(self) -> None:
        """Wait until it drives at more than 5 m/s; a stop before is a fault, unless the host stalled."""
        self.wait(lambda status: status.get("speed_mps", 0.0) > 5.0 or self.stopped(), "it does not drive")
        if self.stopped():
            raise self.stopped_wrongly()

    def stopped(self) -> bool:
        """Tell whether its watchdog has braked, or its server has stopped it."""
        return self.status().get("safety") == "safe_stop" or self.car.braked_ns() is not None

    def stopped_wrongly(self) -> Exception:
        """Give what to raise where it stopped though nothing was broken; it must be called soon after the stop."""
        said, braked_ns = f"it stopped: {self.loop.server.latest}, {self.car.events}", self.car.braked_ns()
        if braked_ns is not None:
            return self.car.let_go_wrongly(braked_ns, said)
        now_ns = CLOCK.now().mono_ns
        return self.stalls.verdict(said, now_ns - STOP_BEFORE_MS * NS_PER_MS, now_ns, stall_ms=STOP_STALL_MS)

    def in_time(self, took_ms: float, limit_ms: float, since_ns: int, what: str) -> None:
        """Judge how long something took; only stalls until the limit excuse it."""
        until_ns = since_ns + round(limit_ms * NS_PER_MS)
        said = f"{what} only {took_ms:.0f} ms after: {self.car.events}"
        self.stalls.require(took_ms < limit_ms, said, since_ns, until_ns, stall_ms=STOP_STALL_MS)

    def wait(self, what: Callable[[dict[str, Any]], bool], why: str) -> None:
        """Wait until the server's status says something; what never comes is a fault, whatever the host did."""
        end_ns = CLOCK.now().mono_ns + LONGEST_NS
        while not what(self.status()):
            assert CLOCK.now().mono_ns < end_ns, f"{why}: {self.loop.server.latest}, {self.car.events}"
            pause(20 * NS_PER_MS)


@contextmanager
def driving(run: RunConfig, work: Path, stalls: Stalls, *, program: Sequence[str] = LAVT) -> Iterator[Driven]:
    """Drive a software car at more than 5 m/s, over routers and sockets of the loopback."""
    with started(run, work, stalls, program=program) as driven:
        driven.reach_speed()
        yield driven


@contextmanager
def started(run: RunConfig, work: Path, stalls: Stalls, *, program: Sequence[str] = LAVT) -> Iterator[Driven]:
    """Start a software car, its server and a client."""
    config = write_config(run, work / "car.yaml")
    with software_car(config, stalls=stalls) as car, Processes(work) as processes:
        loop = start_loop(processes, plan_run(run), work, work, once=False, server_program=program)
        try:
            yield Driven(car, loop, work, loop.server_ready["actuator_pid"], stalls)
        finally:
            with suppress(ProcessLookupError):  # what stands still cannot end, and would keep its ports
                os.killpg(loop.server.popen.pid, signal.SIGCONT)
