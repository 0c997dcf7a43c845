"""Measure the round trip of a command through two Zenoh routers, compared with raw UDP, pyzmq and CycloneDDS.

The message is an encoded command. One process sends it, a second process echoes it, and the first process measures the
time until the echo arrives. A carrier is what carries the message: Zenoh, or one of the three compared with it. Zenoh
is set up as in LAVT: with a router for each side (`lavt router` with the files of `zenoh-configs/`, linked by
`udp?rel=1;mixed_rel=1`), with the quality of service of commands, and with a listening thread that passes messages to
the node's thread. The other carriers connect the two processes directly. All processes run on one machine and use its
loopback, so the benchmark compares processing, not networks. In each round every carrier is measured once.

pyzmq and CycloneDDS are measured if they are installed: pip install pyzmq cyclonedds. LAVT does not need them.

    python benchmarks/control_round_trip.py [--rounds 5] [--seconds 10] [--messages 2000] [--only udp --only zenoh]

Prints each run, a table of medians over the rounds, and finally a line of JSON with the medians and their ratios to raw
UDP.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package `benchmarks`

from benchmarks.round_trip.carriers import CARRIERS

import lavt
from lavt.errors import LavtError, UserError, WorkError
from lavt.experiment.runs.processes import Processes
from lavt.runtime import process_priority

REPOSITORY = Path(__file__).parents[1]
PACE_LABELS = {"at_50_hz": "50 Hz", "back_to_back": "back to back"}
PERCENTILES = (50, 95, 99)
SESSION_ENDPOINT = "tcp/127.0.0.1:0"
ROUTER_LINK = "udp/127.0.0.1:{port}?rel=1;mixed_rel=1"
MAX_OVERHEAD_S = 30.0
"""The time limit for start, discovery and end, in addition to the time of the measurement."""
MAX_MEAN_ROUND_TRIP_S = 0.01
"""The time limit for each message that is sent back to back, on average."""

PaceResults = dict[str, dict[str, float]]
"""For each pace, the percentiles of the round trip in microseconds, and the number of lost echoes."""


def start_routers(processes: Processes) -> tuple[str, str]:
    """Start the vehicle's router, then the operator's, which connects to the vehicle's.

    Returns the endpoints for sessions, the vehicle's first.
    """
    endpoints = []
    remote_endpoint = ""
    for side, listen in (("server", [SESSION_ENDPOINT, ROUTER_LINK.format(port=0)]), ("client", [SESSION_ENDPOINT])):
        connect = [remote_endpoint] if remote_endpoint else []
        changes = [f"listen.endpoints={json.dumps(listen)}", f"connect.endpoints={json.dumps(connect)}"]
        words = [word for change in changes for word in ("--set", change)]
        router = processes.start(f"{side}-router", "router", f"zenoh-configs/router-{side}.json5", *words)
        locators = router.wait_ready()["locators"]
        endpoints.append(next(locator for locator in locators if locator.startswith("tcp/")))
        remote = next((locator for locator in locators if locator.startswith("udp/")), "")
        remote_endpoint = ROUTER_LINK.format(port=remote.partition("?")[0].rpartition(":")[2])
    return endpoints[0], endpoints[1]


def start_process(*words: str) -> subprocess.Popen[str]:
    """Start a process of `round_trip/process.py`."""
    paths = os.pathsep.join([str(REPOSITORY), str(Path(lavt.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.round_trip.process", *words],
        stdout=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": paths},
    )


def run(carrier: str, routers: tuple[str, str], seconds: float, messages: int) -> PaceResults:
    """Measure one carrier once; raise `WorkError` if a process fails."""
    endpoints = json.dumps(routers)
    echo = start_process("echo", carrier, endpoints)
    try:
        assert echo.stdout is not None
        line = echo.stdout.readline()
        if not line:
            raise WorkError(f"the echo process of {carrier} ended too early; see above")
        sender = start_process("ask", carrier, endpoints, json.loads(line)["address"], str(seconds), str(messages))
        try:
            output, _ = sender.communicate(timeout=MAX_OVERHEAD_S + 2 * seconds + MAX_MEAN_ROUND_TRIP_S * messages)
        except subprocess.TimeoutExpired:
            sender.kill()
            raise WorkError(f"the round trips of {carrier} did not end") from None
        if sender.returncode:
            raise WorkError(f"the round trips of {carrier} could not be measured; see above")
        echo.wait(MAX_OVERHEAD_S)
    finally:
        echo.kill()
        echo.communicate()
    return {pace: percentiles(carrier, times_ns) for pace, times_ns in json.loads(output).items()}


def percentiles(carrier: str, times_ns: Sequence[int | None]) -> dict[str, float]:
    """Return percentiles of the round trip in microseconds and the number of lost echoes, which are None in `times_ns`.

    Raise `WorkError` if all echoes were lost.
    """
    received_ns = [time_ns for time_ns in times_ns if time_ns is not None]
    if not received_ns:
        raise WorkError(f"{carrier} lost every echo")
    values = np.percentile(received_ns, PERCENTILES) / 1000
    named = {f"p{rank}_us": round(float(value), 1) for rank, value in zip(PERCENTILES, values, strict=True)}
    return {**named, "lost": len(times_ns) - len(received_ns)}


def summary(rounds: Mapping[str, Sequence[PaceResults]]) -> dict[str, Any]:
    """Return medians over the rounds by carrier and pace, with ratios to raw UDP if raw UDP was measured."""
    medians: dict[str, Any] = {}
    for carrier, carrier_rounds in rounds.items():
        medians[carrier] = {}
        for pace in PACE_LABELS:
            values = {
                name: float(np.median([results[pace][name] for results in carrier_rounds]))
                for name in carrier_rounds[0][pace]
            }
            udp_values = values if carrier == "udp" else medians.get("udp", {}).get(pace)
            names = [f"p{rank}" for rank in PERCENTILES] if udp_values else []
            ratios = {f"{name}_ratio": round(values[f"{name}_us"] / udp_values[f"{name}_us"], 2) for name in names}
            medians[carrier][pace] = {**values, **ratios}
    return medians


def table(medians: Mapping[str, Any]) -> str:
    """Return the medians as a Markdown table."""
    ranks = " / ".join(f"p{rank}" for rank in PERCENTILES)
    heads = ["carrier", *(f"{label}: {ranks}" for label in PACE_LABELS.values())]
    rows = [
        [CARRIERS[carrier].label, *(_cell(by_pace[pace]) for pace in PACE_LABELS)]
        for carrier, by_pace in medians.items()
    ]
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), *rows))


def _cell(values: Mapping[str, float]) -> str:
    times = " / ".join(f"{values[f'p{rank}_us']:.0f}" for rank in PERCENTILES)
    ratio = values.get("p50_ratio")
    lost = f", {values['lost']:.0f} lost" if values["lost"] else ""
    return f"{times} us{lost}" + ("" if ratio is None else f" ({ratio:.1f} x)")


def measure(carriers: Sequence[str], rounds: int, seconds: float, messages: int) -> dict[str, Any]:
    """Measure every carrier once in each round, and return the summary; every second round is in reverse order."""
    rounds_by_carrier: dict[str, list[PaceResults]] = {carrier: [] for carrier in carriers}
    with tempfile.TemporaryDirectory() as folder, Processes(Path(folder)) as processes:
        routers = start_routers(processes)
        for number in range(rounds):
            for carrier in carriers if number % 2 == 0 else reversed(carriers):
                results = run(carrier, routers, seconds, messages)
                rounds_by_carrier[carrier].append(results)
                cells = "; ".join(f"{label} {_cell(results[pace])}" for pace, label in PACE_LABELS.items())
                print(f"{number + 1} {carrier}: {cells}", flush=True)
    return summary(rounds_by_carrier)


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of the part at 50 Hz of each run")
    parser.add_argument("--messages", type=int, default=2000, help="number of messages back to back in each run")
    parser.add_argument("--only", action="append", choices=CARRIERS, help="a carrier; repeatable")
    options = parser.parse_args(words)
    if options.rounds < 1 or options.seconds <= 0 or options.messages < 1:
        parser.error("--rounds, --seconds and --messages must be above zero")
    return options


def main() -> int:
    """Measure the selected carriers that are installed, and return the exit code: 2 if none is installed."""
    options = arguments()
    process_priority.raise_priority()  # as the server and the client do; routers and measuring processes inherit it
    missing = [name for name, carrier in CARRIERS.items() if carrier.missing and name in (options.only or CARRIERS)]
    for name in missing:
        print(f"{name} is not measured: it is not installed (pip install {CARRIERS[name].package})", file=sys.stderr)
    carriers = [name for name in CARRIERS if name in (options.only or CARRIERS) and name not in missing]
    if not carriers:
        return 2
    try:
        medians = measure(carriers, options.rounds, options.seconds, options.messages)
    except LavtError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    load = os.getloadavg()[0]
    print(f"\n{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, load {load:.1f}\n")
    print(table(medians))
    print(json.dumps(medians))
    return 0


if __name__ == "__main__":
    sys.exit(main())
