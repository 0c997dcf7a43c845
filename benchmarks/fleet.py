"""Measure what vehicles cost a router in the cloud, and what a vehicle's video costs a rendezvous.

One separate router (`lavt router zenoh-configs/router-cloud.json5`, without encryption) serves all vehicles. Light
vehicles are Zenoh sessions in a few processes, with everything that a server declares. They publish states of the real
size at the real rate and do nothing else. A watcher subscribes to all states, and reads those of ten vehicles, to
measure their latency. Driven vehicles and their clients use LAVT's links: each client sends 50 commands a second, and
its vehicle answers each with a state. All processes share one machine, and no video goes through the router.

With the topology `routers`, each vehicle and each client has an embedded router, which is LAVT's default; with
`clients`, each has a session with the cloud's router. If the vehicles cannot publish at the full rate, because the
machine is too small for them, the step is repeated at a tenth of the rate. With 100 vehicles or more, the smallest
number of driven ones is measured at both rates, which separates the costs of messages from those of sessions. A step
that cannot be built is left out with a sentence, and so are the steps with more vehicles.

    python benchmarks/fleet.py [--seconds 20] [--topology routers] [--vehicles 1 --vehicles 10] [--driven 1] [--short]

Prints a table row for each step, the costs per vehicle, and finally a line of JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package `benchmarks`

from benchmarks.fleet_parts.costs import costs_per_vehicle, is_complete, table_row
from benchmarks.fleet_parts.rendezvous import measure_rendezvous
from benchmarks.fleet_parts.sessions import SAMPLED
from benchmarks.fleet_parts.usage import usage
from benchmarks.quiet import Quiet
from benchmarks.round_trip.results import markdown

import lavt
from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_S
from lavt.errors import LavtError, UserError, WorkError
from lavt.experiment.runs.processes import Process, Processes
from lavt.runtime import process_priority

REPOSITORY = Path(__file__).parents[1]
TOPOLOGIES = ("routers", "clients")
VEHICLES = (1, 10, 100, 1000)
DRIVEN = (1, 10)
RATE_HZ, REDUCED_RATE_HZ = 50.0, 5.0
BOTH_RATES_FROM = 100
"""With so many light vehicles, both rates are measured: the difference separates messages from sessions."""
VEHICLES_PER_PROCESS = 50
MAX_PROCESSES = 8
MIN_RATE_SHARE = 0.9
"""A step whose vehicles publish less than this share of their rate does not measure the router."""
BUILD_LIMIT_S = 300.0
READY_LIMIT_S = 60.0
END_LIMIT_S = 15.0
SETTLE_S = 2.0
HEADS = (
    "topology",
    "light vehicles",
    "driven",
    "states per vehicle and second",
    "router: processor s/s",
    "router: MB",
    "router: descriptors, threads",
    "state latency p50 / p99 ms",
    "received states",
    "command round trip p50 / p99 ms",
    "lost commands",
    "built in s",
)


class Part:
    """A process of `fleet_parts/process.py`."""

    def __init__(self, role: str, **arguments: Any) -> None:
        self.name = role
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed in `kill`)
        paths = os.pathsep.join(
            [str(REPOSITORY), str(Path(lavt.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        )
        self.popen = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.fleet_parts.process", role, json.dumps(arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            cwd=REPOSITORY,
            env={**os.environ, "PYTHONPATH": paths, "RUST_BACKTRACE": "0"},
        )
        self.is_ready = threading.Event()
        self.connected = 0
        self._lines: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.popen.stdout is not None
        for text in self.popen.stdout:
            with suppress(ValueError):
                line = json.loads(text)
                self.connected = line.get("connected", self.connected)
                if "ready" in line:
                    self.is_ready.set()
                elif "connected" not in line:
                    self._lines.put(line)

    def wait_ready(self, limit_s: float) -> bool:
        """Return whether the process gets ready in time; raise `WorkError` if it ends before."""
        clock = MachineClock()
        until_ns = clock.now().mono_ns + round(limit_s * NS_PER_S)
        while not self.is_ready.wait(0.1):
            if self.popen.poll() is not None:
                raise WorkError(f"a process of the fleet ({self.name}) ended too early: {self._last_error()}")
            if clock.now().mono_ns > until_ns:
                return False
        return True

    def _last_error(self) -> str:
        self._errors.seek(0)
        lines = self._errors.read().strip().splitlines()
        return lines[-1] if lines else "no message"

    def begin(self) -> None:
        """Let the process measure from now on."""
        assert self.popen.stdin is not None
        self.popen.stdin.write("begin\n")
        self.popen.stdin.flush()

    def end(self) -> dict[str, Any]:
        """End the process, and return its results."""
        assert self.popen.stdin is not None
        self.popen.stdin.close()
        try:
            return self._lines.get(timeout=END_LIMIT_S)
        except queue.Empty:
            raise WorkError(f"a process of the fleet ({self.name}) printed no results: {self._last_error()}") from None

    def kill(self) -> None:
        """Kill the process if it still runs."""
        self.popen.kill()
        self.popen.wait()
        self._errors.close()


class Step:
    """One step: numbers of light and driven vehicles, at one rate, with one router at `port`."""

    def __init__(self, topology: str, light: int, driven: int, rate_hz: float, port: int) -> None:
        self.parts: list[Part] = []
        self._topology, self._light, self._driven, self._rate_hz, self._port = topology, light, driven, rate_hz, port
        self._clock = MachineClock()

    def run(self, router_pid: int, seconds: float) -> dict[str, Any]:
        """Build the fleet, measure, and return the results; raise `WorkError` if it cannot be built."""
        begin_ns = self._clock.now().mono_ns
        empty = usage(router_pid)
        watcher = self._start("watcher")
        if not watcher.wait_ready(READY_LIMIT_S):
            raise WorkError(f"the watcher did not get ready within {READY_LIMIT_S:.0f} s")
        fleet = self._start_light()
        clients = self._start_driven()
        built_s = self._elapsed_s(begin_ns)
        pause(round(SETTLE_S * NS_PER_S))
        for part in self.parts:
            part.begin()
        before, before_ns = usage(router_pid), self._clock.now().mono_ns
        pause(round(seconds * NS_PER_S))
        after, elapsed_s = usage(router_pid), self._elapsed_s(before_ns)
        sent_per_s = sum(part.end()["sent_per_s"] for part in fleet)
        answers = clients.end()
        latencies_ns = watcher.end()["latencies_ns"]
        return {
            "topology": self._topology,
            "light": self._light,
            "driven": self._driven,
            "rate_hz": self._rate_hz,
            "sent_per_s": round(sent_per_s, 1),
            "processor_share": round((after.processor_s - before.processor_s) / elapsed_s, 4),
            "resident_mb": round(after.resident_mb, 1),
            "empty_mb": round(empty.resident_mb, 1),
            "descriptors": after.descriptors,
            "threads": after.threads,
            "state_ms": percentiles_ms(latencies_ns),
            "states_received_share": round(len(latencies_ns) / self._expected_states(sent_per_s, elapsed_s), 3),
            "round_trip_ms": percentiles_ms(answers["round_trips_ns"]),
            "lost_commands": max(0, answers["sent"] - len(answers["round_trips_ns"])),
            "built_s": round(built_s, 1),
        }

    def _elapsed_s(self, since_ns: int) -> float:
        return (self._clock.now().mono_ns - since_ns) / NS_PER_S

    def _expected_states(self, sent_per_s: float, elapsed_s: float) -> float:
        """Return the number of states that the sampled vehicles have sent; at least one."""
        return max(1.0, sent_per_s * elapsed_s * min(SAMPLED, self._light) / self._light)

    def _start(self, role: str, **arguments: Any) -> Part:
        part = Part(role, topology=self._topology, port=self._port, **arguments)
        self.parts.append(part)
        return part

    def _start_light(self) -> list[Part]:
        """Start the light vehicles; raise `WorkError` if they are not connected in time."""
        count = min(MAX_PROCESSES, -(-self._light // VEHICLES_PER_PROCESS))
        fleet = [
            self._start("light", numbers=list(range(first, self._light, count)), rate_hz=self._rate_hz)
            for first in range(count)
        ]
        begin_ns = self._clock.now().mono_ns
        for part in fleet:
            if not part.wait_ready(BUILD_LIMIT_S - self._elapsed_s(begin_ns)):
                connected = sum(one.connected for one in fleet)
                raise WorkError(f"{connected} of {self._light} vehicles were connected after {BUILD_LIMIT_S:.0f} s")
        return fleet

    def _start_driven(self) -> Part:
        """Start the driven vehicles and their clients, and return the process of the clients."""
        vehicles = self._start("vehicles", count=self._driven)
        clients = self._start("clients", count=self._driven)
        if not (vehicles.wait_ready(READY_LIMIT_S) and clients.wait_ready(READY_LIMIT_S)):
            raise WorkError(f"the {self._driven} driven vehicles did not answer within {READY_LIMIT_S:.0f} s")
        return clients


def percentiles_ms(times_ns: Sequence[int]) -> list[float]:
    """Return the median, the 99th percentile in milliseconds, and the number of times; without any, an empty list."""
    if not times_ns:
        return []
    return [round(float(value) / 1e6, 3) for value in np.percentile(times_ns, (50, 99))] + [len(times_ns)]


@contextmanager
def cloud_router(sessions: int) -> Iterator[tuple[Process, int]]:
    """Run a router that accepts so many sessions; yield its process and its UDP port."""
    changes = [
        'listen.endpoints=["udp/127.0.0.1:0?rel=1;mixed_rel=1"]',
        f"transport.unicast.max_sessions={sessions}",
        f"transport.unicast.accept_pending={sessions}",
        "transport.unicast.accept_timeout=30000",
    ]
    words = [word for change in changes for word in ("--set", change)]
    with tempfile.TemporaryDirectory() as folder, Processes(Path(folder)) as processes:
        router = processes.start("cloud-router", "router", "zenoh-configs/router-cloud.json5", *words)
        locator = router.wait_ready()["locators"][0]
        yield router, int(locator.partition("?")[0].rpartition(":")[2])


def measure_step(topology: str, light: int, driven: int, rate_hz: float, seconds: float) -> dict[str, Any]:
    """Measure one step with a new router; raise `WorkError` if it cannot be built."""
    with cloud_router(sessions=light + 2 * driven + 10) as (router, port):
        step = Step(topology, light, driven, rate_hz, port)
        try:
            return step.run(router.popen.pid, seconds)
        finally:
            for part in step.parts:
                part.kill()


def measure_topology(
    topology: str, sizes: Sequence[int], driven: Sequence[int], seconds: float
) -> list[dict[str, Any]]:
    """Measure all steps of a topology, print each, and return the results."""
    results: list[dict[str, Any]] = []
    rates = [RATE_HZ, REDUCED_RATE_HZ]
    for light in sorted(sizes):
        for count in sorted(driven):
            for rate_hz in list(rates):
                name = f"{topology}, {light} light and {count} driven vehicles, {rate_hz:g} Hz"
                try:
                    result = measure_step(topology, light, count, rate_hz, seconds)
                except WorkError as error:
                    print(f"{name}: not measured, like all larger steps: {error}", flush=True)
                    return results
                print(f"{name}: {json.dumps(result)}", flush=True)
                if not is_complete(result):
                    print(f"{name}: states were lost, so this step does not count for the costs", flush=True)
                if result["sent_per_s"] >= MIN_RATE_SHARE * rate_hz * light:
                    results.append(result)
                    if light >= BOTH_RATES_FROM and count == min(driven):
                        continue
                    break
                print(
                    f"{name}: not a measurement of the router: the vehicles' processes sent only "
                    f"{result['sent_per_s']:.0f} of {rate_hz * light:.0f} states a second",
                    flush=True,
                )
                rates.remove(rate_hz)  # larger steps cannot have it, either
            if not rates:
                print(f"{topology}: all larger steps are left out: this machine is too slow", flush=True)
                return results
    return results


def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure all steps."""
    sizes, driven = options.vehicles or VEHICLES, options.driven or DRIVEN
    return [
        result
        for topology in options.topology or TOPOLOGIES
        for result in measure_topology(topology, sizes, driven, options.seconds)
    ]


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of the measurement of each step")
    parser.add_argument("--topology", action="append", choices=TOPOLOGIES, help="repeatable; by default both")
    parser.add_argument("--vehicles", action="append", type=int, help="number of light vehicles; repeatable")
    parser.add_argument("--driven", action="append", type=int, help="number of driven vehicles; repeatable")
    parser.add_argument("--short", action="store_true", help="2 s for each step, 1 and 10 vehicles, 1 driven")
    options = parser.parse_args(words)
    if options.short:
        options.seconds, options.vehicles, options.driven = 2.0, options.vehicles or [1, 10], options.driven or [1]
    if options.seconds <= 0 or any(count < 1 for count in (*(options.vehicles or ()), *(options.driven or ()))):
        parser.error("--seconds, --vehicles and --driven must be above zero")
    return options


def main() -> int:
    """Measure, print, and return the exit code: 1 if no step could be measured."""
    options = arguments()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the router is ended, too
    process_priority.raise_priority()  # as the server and the client do; all processes inherit it
    quiet = Quiet()
    try:
        results = measure(options)
        rendezvous = measure_rendezvous(options.seconds)
    except LavtError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    print(f"\n{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, {quiet.sentence()}\n")
    print(markdown(HEADS, [table_row(result) for result in results]))
    costs = {topology: costs_per_vehicle(results, topology) for topology in TOPOLOGIES}
    for topology, cost in costs.items():
        print(f"{topology}: {json.dumps(cost)}")
    print(f"rendezvous: {json.dumps(rendezvous)}")
    print(json.dumps({"steps": results, "costs": costs, "rendezvous": rendezvous}))
    return 0 if results else 1


if __name__ == "__main__":
    sys.exit(main())
