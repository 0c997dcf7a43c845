"""Measures the round trip of a command between two processes through two routers, beside raw UDP, pyzmq and CycloneDDS.

The message is an encoded command. One process sends it, another sends it back; the first one has the time. Zenoh has
what LAVT has: a router for each side (`lavt router` with the files of `zenoh-configs/`, linked by
`udp?rel=1;mixed_rel=1`), the quality of service of commands, and a callback that hands over to the node's thread. The
others are two sockets, or two participants, with nothing in between. Everything is on the loopback of one machine, so
what is compared is work, not network. All carriers take their turns in each round.

pyzmq and CycloneDDS are measured where they are installed: pip install pyzmq cyclonedds. LAVT does not need them.

    python benchmarks/control_round_trip.py [--rounds 5] [--seconds 10] [--messages 2000] [--only udp --only zenoh]

Prints each run and a table of medians over the rounds; last, one line of JSON with these and their ratios to raw UDP.
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

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a program it finds only what is beside it

from benchmarks.round_trip.carriers import CARRIERS

import lavt
from lavt.errors import LavtError, UserError, WorkError
from lavt.experiment.runs.processes import Processes
from lavt.runtime import process_priority

FOLDER = Path(__file__).parents[1]
PACES = {"at_50_hz": "50 Hz", "back_to_back": "back to back"}
PERCENTILES = (50, 95, 99)
LOCAL = "tcp/127.0.0.1:0"
BETWEEN = "udp/127.0.0.1:{port}?rel=1;mixed_rel=1"
LONGEST_S = 30.0
"""Beyond the measurement itself: starting, finding each other, ending."""

Measured = dict[str, dict[str, float]]
"""By pace: microseconds by percentile, and lost echoes."""


def start_routers(processes: Processes) -> tuple[str, str]:
    """Start the vehicle's router and the operator's, which dials it; tell their endpoints for sessions."""
    endpoints = []
    dialled = ""
    for side, listens in (("server", [LOCAL, BETWEEN.format(port=0)]), ("client", [LOCAL])):
        connects = [dialled] if dialled else []
        changes = [f"listen.endpoints={json.dumps(listens)}", f"connect.endpoints={json.dumps(connects)}"]
        words = [word for change in changes for word in ("--set", change)]
        router = processes.start(f"{side}-router", "router", f"zenoh-configs/router-{side}.json5", *words)
        locators = router.ready()["locators"]
        endpoints.append(next(each for each in locators if each.startswith("tcp/")))
        remote = next((each for each in locators if each.startswith("udp/")), "")
        dialled = BETWEEN.format(port=remote.partition("?")[0].rpartition(":")[2])
    return endpoints[0], endpoints[1]


def side(*words: str) -> subprocess.Popen[str]:
    """Start a process of `round_trip/side.py`."""
    paths = os.pathsep.join([str(FOLDER), str(Path(lavt.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.round_trip.side", *words], stdout=subprocess.PIPE, text=True, cwd=FOLDER,
        env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip


def run(carrier: str, routers: tuple[str, str], seconds: float, messages: int) -> Measured:
    """Measure one carrier once; raises `WorkError` where a process fails."""
    told = json.dumps(routers)
    echo = side("echo", carrier, told)
    try:
        assert echo.stdout is not None
        line = echo.stdout.readline()
        if not line:
            raise WorkError(f"the echo of {carrier} ended before its time; see above")
        asker = side("ask", carrier, told, json.loads(line)["address"], str(seconds), str(messages))
        try:
            said, _ = asker.communicate(timeout=LONGEST_S + 2 * seconds + messages / 100)
        except subprocess.TimeoutExpired:
            asker.kill()
            raise WorkError(f"the round trips of {carrier} did not end") from None
        if asker.returncode:
            raise WorkError(f"the round trips of {carrier} could not be measured; see above")
        echo.wait(LONGEST_S)
    finally:
        echo.kill()
        echo.communicate()
    return {pace: percentiles(carrier, times) for pace, times in json.loads(said).items()}


def percentiles(carrier: str, times_ns: Sequence[int | None]) -> dict[str, float]:
    """Give the percentiles in microseconds, and how many echoes were lost; raises `WorkError` where all were."""
    known_ns = [each for each in times_ns if each is not None]
    if not known_ns:
        raise WorkError(f"{carrier} lost every echo")
    values = np.percentile(known_ns, PERCENTILES) / 1000
    named = {f"p{each}_us": round(float(value), 1) for each, value in zip(PERCENTILES, values, strict=True)}
    return {**named, "lost": len(times_ns) - len(known_ns)}


def summary(rounds: Mapping[str, Sequence[Measured]]) -> dict[str, Any]:
    """Give medians over the rounds by carrier and pace, and their ratios to raw UDP where that was measured."""
    found: dict[str, Any] = {}
    for carrier, measured in rounds.items():
        found[carrier] = {}
        for pace in PACES:
            values = {name: float(np.median([each[pace][name] for each in measured])) for name in measured[0][pace]}
            floor = values if carrier == "udp" else found.get("udp", {}).get(pace)
            names = [f"p{each}" for each in PERCENTILES] if floor else []
            ratios = {f"{each}_ratio": round(values[f"{each}_us"] / floor[f"{each}_us"], 2) for each in names}
            found[carrier][pace] = {**values, **ratios}
    return found


def table(found: Mapping[str, Any]) -> str:
    """Draw the medians."""
    heads = ["carrier", *(f"{words}: {' / '.join(f'p{each}' for each in PERCENTILES)}" for words in PACES.values())]
    rows = [[CARRIERS[carrier].words, *(_cell(paces[pace]) for pace in PACES)] for carrier, paces in found.items()]
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), *rows))


def _cell(values: Mapping[str, float]) -> str:
    times = " / ".join(f"{values[f'p{each}_us']:.0f}" for each in PERCENTILES)
    ratio = values.get("p50_ratio")
    lost = f", {values['lost']:.0f} lost" if values["lost"] else ""
    return f"{times} us{lost}" + ("" if ratio is None else f" ({ratio:.1f} x)")


def measure(carriers: Sequence[str], rounds: int, seconds: float, messages: int) -> dict[str, Any]:
    """Measure all carriers in turns, every second round the other way round."""
    measured: dict[str, list[Measured]] = {carrier: [] for carrier in carriers}
    with tempfile.TemporaryDirectory() as folder, Processes(Path(folder)) as processes:
        routers = start_routers(processes)
        for number in range(rounds):
            for carrier in carriers if number % 2 == 0 else reversed(carriers):
                found = run(carrier, routers, seconds, messages)
                measured[carrier].append(found)
                said = "; ".join(f"{words} {_cell(found[pace])}" for pace, words in PACES.items())
                print(f"{number + 1} {carrier}: {said}", flush=True)
    return summary(measured)


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0, help="at 50 Hz, in each run")
    parser.add_argument("--messages", type=int, default=2000, help="back to back, in each run")
    parser.add_argument("--only", action="append", choices=CARRIERS, help="a carrier; may be given again")
    requested = parser.parse_args(words)
    if requested.rounds < 1 or requested.seconds <= 0 or requested.messages < 1:
        parser.error("--rounds, --seconds and --messages must be above zero")
    return requested


def main() -> int:
    """Measure what is asked for and there; 2 where what is asked for is not there."""
    requested = arguments()
    process_priority.raise_priority()  # as the server and the client do; routers and both sides inherit it
    missing = [name for name, carrier in CARRIERS.items() if carrier.missing and name in (requested.only or CARRIERS)]
    for name in missing:
        print(f"{name} is not measured: it is not installed (pip install {CARRIERS[name].package})", file=sys.stderr)
    carriers = [name for name in CARRIERS if name in (requested.only or CARRIERS) and name not in missing]
    if not carriers:
        return 2
    try:
        found = measure(carriers, requested.rounds, requested.seconds, requested.messages)
    except LavtError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    load = os.getloadavg()[0]
    print(f"\n{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, load {load:.1f}\n")
    print(table(found))
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
