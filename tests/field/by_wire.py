"""A server that drives a software car over CAN: real processes, which the tests observe from the car's side."""

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
from tests.support.stalls import STALL_MS, Stalls, excuse_slow_machine

from lavt.clock import MachineClock, pause
from lavt.config import RunConfig
from lavt.config_file import parse_config
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.processes import LAVT, Processes
from lavt.experiment.runs.real_run import LoopProcesses, start_loop
from lavt.experiment.runs.side_configs import server_config

MULTICAST_GROUP = "239.74.163.2"
"""A UDP multicast group that serves as a CAN bus between processes where the kernel has none."""
CLOCK = MachineClock()
MAX_WAIT_NS = 60 * NS_PER_S
KIT_TIMEOUT_MS = 100
"""A kit disengages this long after the last command that it received."""
TOLERANCE_MS = 60
"""Tolerance for a busy machine, added to the design's limits."""
KIT_LOOKBACK_MS = 200
"""A stall of the host excuses a kit that disengages at most this long after the end of the stall."""
STOP_LOOKBACK_MS = 1500
"""A stall of the host excuses a safe stop that is noticed at most this long after the end of the stall. The stop begins
500 ms after the last command and is reported within 200 ms."""
STOP_STALL_MS = 100
"""The shortest stall that can cause a safe stop."""
SLOW_MACHINE_LOOKBACK_MS = 3000
"""Many short stalls in this time before a stop can cause the stop together."""
TIMING_FAILURES = ("reports are missing", "did not stay enabled", "did not brake within")
"""The failures of `lavt can test-watchdog` that depend on timing."""
GENERATIONS = ("dataspeed_gen1", "dataspeed_gen2")


def pass_watchdog_test(profile: str, work: Path, stalls: Stalls) -> RunConfig:
    """Return a run of a software car on a bus of its own, after the car's kit has passed the watchdog test."""
    run = run_config(profile, work / f"{profile}.json")
    config = write_config(run, work / f"{profile}.yaml")
    with software_car(config) as car:
        command = [sys.executable, "-m", "lavt", "can", "test-watchdog", str(config), "--yes"]
        since_ns = CLOCK.now().mono_ns
        completed = subprocess.run(command, capture_output=True, text=True, check=False)
        message = f"{completed.stderr}, {car.events}"
        assert completed.returncode == 0 or depends_on_timing(completed.stderr), message
        stalls.require(completed.returncode == 0, message, since_ns, CLOCK.now().mono_ns)
    return run


def depends_on_timing(message: str) -> bool:
    """Return whether the message of a failed watchdog test names a failure that a stalled host can cause."""
    return any(part in message for part in TIMING_FAILURES)


def write_config(run: RunConfig, path: Path) -> Path:
    """Write the server's config of a run."""
    path.write_text(yaml.safe_dump(server_config(run, plan_run(run).seed).model_dump(mode="json")))
    return path


def run_config(profile: str, proof: Path) -> RunConfig:
    """Return a run whose vehicle is a software car on a bus of its own."""
    dbw = {
        "profile": profile,
        "interface": "udp_multicast",
        "channel": MULTICAST_GROUP,
        "options": {"port": free_port()},
        "truth": f"127.0.0.1:{free_port()}",
        "steering_sign": 1,
        "watchdog_proof": str(proof),
    }
    settings = {
        "vehicle": {"kind": "dbw", "route": "a_key", "scenery": "none", "dbw": dbw},
        "camera": {"width_px": 320, "height_px": 240, "rate_hz": 30},
        "network": {"injection": "none"},
        "time": "real",
    }
    return parse_config(RunConfig, settings, "the run")


def ms_since(at_ns: int, since_ns: int) -> float:
    """Return the time between two times in ms."""
    return (at_ns - since_ns) / NS_PER_MS


@dataclass
class SoftwareCarProcess:
    """`lavt software-car` as a process, with the events that it printed.

    If `stalls` is given, a stall of the host at the time of a late reaction excuses the reaction. `explain` gets the
    exception for a kit that disengaged although the test had caused no fault, and the time, and returns the exception
    to raise.
    """

    process: subprocess.Popen[str]
    stalls: Stalls | None = None
    stall_ms: float = STALL_MS
    explain: Callable[[Exception, int], Exception] = lambda failure, _at_ns: failure
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

    def execute(self, command: str) -> int:
        """Execute a console command and return the time."""
        assert self.process.stdin is not None
        at_ns = CLOCK.now().mono_ns
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()
        return at_ns

    def event_ns(self, kind: str, text: str, *, since_ns: int = 0) -> int | None:
        """Return the time of the first matching event since a time, or None."""
        while not self._lines.empty():
            line = self._lines.get()
            if line is not None and "kind" in line:
                self.events.append(line)
        matching = (event for event in self.events if event["kind"] == kind and text in event["text"])
        return next((event["mono_ns"] for event in matching if event["mono_ns"] >= since_ns), None)

    def was_enabled(self, since_ns: int = 0) -> bool:
        """Return whether the kit has enabled an axis since a time."""
        return self.event_ns("enabled", "enabled: ", since_ns=since_ns) is not None

    def wait(self, kind: str, text: str, *, since_ns: int = 0, within_ns: int = MAX_WAIT_NS) -> int:
        """Wait for an event and return its time; raise if the watchdog brakes first.

        If the event never comes, the test fails even if the host stalled.
        """
        end_ns = CLOCK.now().mono_ns + within_ns
        braked_ns = None
        while braked_ns is None and CLOCK.now().mono_ns < end_ns:
            braked_ns = self.watchdog_braked_ns()
            at_ns = self.event_ns(kind, text, since_ns=since_ns)
            if at_ns is not None:
                return at_ns
            pause(5 * NS_PER_MS)
        message = f"the car had no event {kind!r} with {text!r}: {self.events}"
        raise AssertionError(message) if braked_ns is None else self.unexpected_release(braked_ns, message)

    def watchdog_braked_ns(self) -> int | None:
        """Return the time at which the watchdog braked first, or None."""
        return self.event_ns("watchdog", "watchdog brakes")

    def unexpected_release(self, braked_ns: int, message: str) -> Exception:
        """Return the exception for a kit that got no command in time although the test had caused no fault."""
        since_ns = braked_ns - KIT_LOOKBACK_MS * NS_PER_MS
        failure = self.verdict(message, since_ns, braked_ns)
        if self.stalls is not None:
            # Several stalls before the release excuse it like one that is as long as all of them.
            share = self.stall_ms / KIT_LOOKBACK_MS
            failure = excuse_slow_machine(failure, self.stalls, since_ns, braked_ns, share=share)
            since_ns = braked_ns - SLOW_MACHINE_LOOKBACK_MS * NS_PER_MS
            failure = excuse_slow_machine(failure, self.stalls, since_ns, braked_ns)
        return self.explain(failure, braked_ns)

    def verdict(self, message: str, since_ns: int, until_ns: int) -> Exception:
        """Return the exception for a late reaction: `HostStalled` if the host stalled between the times."""
        if self.stalls is None:
            return AssertionError(message)
        return self.stalls.verdict(message, since_ns, until_ns, stall_ms=self.stall_ms)

    def wait_for_watchdog_ms(self, since_ns: int, *, tolerance_ms: float = TOLERANCE_MS) -> float:
        """Wait until the watchdog brakes, check that it brakes in time, and return the time since `since_ns` in ms."""
        at_ns = self.wait("watchdog", "watchdog brakes: no command in time", since_ns=since_ns)
        took_ms, limit_ms = ms_since(at_ns, since_ns), KIT_TIMEOUT_MS + tolerance_ms
        if took_ms >= limit_ms:
            message = f"the kit brakes only after {took_ms:.0f} ms: {self.events}"
            raise self.verdict(message, since_ns - KIT_TIMEOUT_MS * NS_PER_MS, since_ns + round(limit_ms * NS_PER_MS))
        return took_ms

    def wait_for_park_ms(self, since_ns: int) -> float:
        """Wait until the car is in park and released, and return the time from `since_ns` to park in ms."""
        at_ns = self.wait("gear", "gear PARK", since_ns=since_ns)
        self.wait("enabled", "released: ", since_ns=since_ns)
        braked_ns = self.watchdog_braked_ns()
        if braked_ns is not None:
            raise self.unexpected_release(braked_ns, f"the watchdog stopped the car: {self.events}")
        return ms_since(at_ns, since_ns)

    def end(self) -> None:
        """End the process, as Ctrl-C does."""
        self.process.send_signal(signal.SIGINT)
        self.process.wait(20)
        self._reader.join()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


@contextmanager
def software_car(config: str | Path, *changes: str, **settings: Any) -> Iterator[SoftwareCarProcess]:
    """Run `lavt software-car` with a server's config; end it afterwards. `settings` are for `SoftwareCarProcess`."""
    process = subprocess.Popen(
        [sys.executable, "-m", "lavt", "software-car", str(config), *changes, "--json"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    car = SoftwareCarProcess(process, **settings)
    try:
        yield car
    finally:
        car.end()


@dataclass
class RunningDrive:
    """A running drive over CAN."""

    car: SoftwareCarProcess
    loop: LoopProcesses
    out: Path
    actuator_pid: int
    stalls: Stalls

    @property
    def pids(self) -> tuple[int, int]:
        """The ids of the actuator's and of the server's process."""
        return self.actuator_pid, self.loop.server.popen.pid

    def status(self) -> dict[str, Any]:
        """Return the newest status that the server printed."""
        status: dict[str, Any] = self.loop.server.latest.get("status", {})
        return status

    def reach_speed(self) -> None:
        """Wait until the car drives at more than 5 m/s; an earlier stop is a failure, unless the host stalled."""
        self.wait(lambda status: status.get("speed_mps", 0.0) > 5.0 or self.has_stopped(), "the car does not drive")
        if self.has_stopped():
            raise self.unexpected_stop()

    def has_stopped(self) -> bool:
        """Return whether the watchdog has braked or the server has stopped the car."""
        return self.status().get("safety") == "safe_stop" or self.car.watchdog_braked_ns() is not None

    def unexpected_stop(self) -> Exception:
        """Return the exception for a stop that the test did not cause; call it soon after the stop."""
        message, braked_ns = (
            f"the car stopped: {self.loop.server.latest}, {self.car.events}",
            self.car.watchdog_braked_ns(),
        )
        now_ns = CLOCK.now().mono_ns
        if braked_ns is not None:
            return self.car.unexpected_release(braked_ns, message)
        since_ns = now_ns - STOP_LOOKBACK_MS * NS_PER_MS
        failure = self.stalls.verdict(message, since_ns, now_ns, stall_ms=STOP_STALL_MS)
        return excuse_slow_machine(failure, self.stalls, now_ns - SLOW_MACHINE_LOOKBACK_MS * NS_PER_MS, now_ns)

    def require_within(self, took_ms: float, limit_ms: float, since_ns: int, what: str) -> None:
        """Require that something took less than a limit; only a stall before the limit excuses a delay."""
        until_ns = since_ns + round(limit_ms * NS_PER_MS)
        message = f"{what} only after {took_ms:.0f} ms: {self.car.events}"
        self.stalls.require(took_ms < limit_ms, message, since_ns, until_ns, stall_ms=STOP_STALL_MS)

    def wait(self, condition: Callable[[dict[str, Any]], bool], failure: str) -> None:
        """Wait for a condition on the server's status; if it is never true, the test fails even if the host stalled."""
        end_ns = CLOCK.now().mono_ns + MAX_WAIT_NS
        while not condition(self.status()):
            assert CLOCK.now().mono_ns < end_ns, f"{failure}: {self.loop.server.latest}, {self.car.events}"
            pause(20 * NS_PER_MS)


@contextmanager
def driving(run: RunConfig, work: Path, stalls: Stalls, *, program: Sequence[str] = LAVT) -> Iterator[RunningDrive]:
    """Drive a software car, through routers and sockets on the loopback; yield when it drives at more than 5 m/s."""
    with running_drive(run, work, stalls, program=program) as drive:
        drive.reach_speed()
        yield drive


@contextmanager
def running_drive(
    run: RunConfig, work: Path, stalls: Stalls, *, program: Sequence[str] = LAVT
) -> Iterator[RunningDrive]:
    """Run a software car, its server and a client, without waiting until the car drives."""
    config = write_config(run, work / "car.yaml")
    with software_car(config, stalls=stalls) as car, Processes(work) as processes:
        loop = start_loop(processes, plan_run(run), work, work, once=False, server_program=program)
        drive = RunningDrive(car, loop, work, loop.server_ready["actuator_pid"], stalls)
        try:
            yield drive
        finally:
            for pid in drive.pids:
                with suppress(ProcessLookupError):  # a suspended process cannot end, and would keep its ports
                    os.kill(pid, signal.SIGCONT)
