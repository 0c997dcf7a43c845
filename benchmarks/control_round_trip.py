"""Measure the round trip of a command: embedded and separate Zenoh routers, raw UDP, pyzmq and CycloneDDS.

The message is an encoded command. One process sends it, a second process echoes it, and the first process measures the
time until the echo arrives. A carrier is what carries the message. All carriers have the same structure: in each
process a listening thread receives, and passes the message to the main thread, as in LAVT. Zenoh is used with LAVT's
link and gateway, with embedded routers (the default of LAVT) and with a separate router for each side, plain and secure
(QUIC with certificates, and signatures). The other carriers connect the two processes directly. All processes run on
one machine and use its loopback, so the benchmark compares processing, not networks. In each round every carrier is
measured once; every second round is in reverse order.

Further variants of the embedded routers leave one part out or add one, and stamps in both processes divide the
round trip into stages. `--only` selects carriers; `--no-variants` leaves out the variants.

pyzmq and CycloneDDS are measured if they are installed: pip install pyzmq cyclonedds. LAVT does not need them.

    python benchmarks/control_round_trip.py [--rounds 7] [--seconds 10] [--messages 2000] [--only udp --only embedded]

Prints each run, tables (medians and ranges over the rounds, ratios to raw UDP), the goals, and finally a line of JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package `benchmarks`

from benchmarks.quiet import Quiet
from benchmarks.round_trip.carriers import CARRIERS
from benchmarks.round_trip.results import (
    PACE_LABELS,
    PaceResults,
    carriers_table,
    cell,
    goals,
    run_results,
    stages_table,
    summary,
    variants_table,
)
from benchmarks.round_trip.surroundings import make_keys, start_routers
from benchmarks.round_trip.zenoh_end import Places

import lavt
from lavt.errors import LavtError, UserError, WorkError
from lavt.experiment.runs.processes import Processes
from lavt.runtime import process_priority

REPOSITORY = Path(__file__).parents[1]
MAX_OVERHEAD_S = 60.0
"""The time limit for start, discovery and end, in addition to the time of the measurement."""
MAX_MEAN_ROUND_TRIP_S = 0.01
"""The time limit for each message that is sent back to back, on average."""
OVERHEAD_S = 4.0
"""The time of a run in addition to that of its messages, for the estimate."""
SHORT = {"rounds": 1, "seconds": 1.0, "messages": 50}


def start_process(*words: str) -> subprocess.Popen[str]:
    """Start a process of `round_trip/process.py`."""
    paths = os.pathsep.join([str(REPOSITORY), str(Path(lavt.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", "benchmarks.round_trip.process", *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": paths},
    )


def run(carrier: str, places: Places, seconds: float, messages: int) -> PaceResults:
    """Measure one carrier once; raise `WorkError` if a process fails."""
    where = msgspec.json.encode(places).decode()
    echo = start_process("echo", carrier, where)
    try:
        assert echo.stdout is not None
        line = echo.stdout.readline()
        if not line:
            raise WorkError(f"the echo process of {carrier} ended too early; see above")
        asked = _ask(carrier, where, json.loads(line)["address"], seconds, messages)
        try:
            echoed, _ = echo.communicate(timeout=MAX_OVERHEAD_S)  # closes its standard input, which ends it
        except subprocess.TimeoutExpired:
            raise WorkError(f"the echo process of {carrier} did not end") from None
        if echo.returncode:
            raise WorkError(f"the echo process of {carrier} failed; see above")
    finally:
        echo.kill()
        echo.communicate()
    return run_results(carrier, asked, json.loads(echoed))


def _ask(carrier: str, where: str, address: str, seconds: float, messages: int) -> dict[str, Any]:
    sender = start_process("ask", carrier, where, address, str(seconds), str(messages))
    try:
        output, _ = sender.communicate(timeout=MAX_OVERHEAD_S + 2 * seconds + MAX_MEAN_ROUND_TRIP_S * messages)
    except subprocess.TimeoutExpired:
        raise WorkError(f"the round trips of {carrier} did not end") from None
    finally:
        sender.kill()
        sender.communicate()
    if sender.returncode:
        raise WorkError(f"the round trips of {carrier} could not be measured; see above")
    asked: dict[str, Any] = json.loads(output)
    return asked


def prepare(carriers: Sequence[str], processes: Processes, folder: Path) -> dict[str, Places]:
    """Make keys and start the separate routers that the carriers need; return the places for each carrier."""
    keys = make_keys(folder / "keys") if any(CARRIERS[name].needs_keys for name in carriers) else ""
    places = {}
    for name in carriers:
        variant = CARRIERS[name].zenoh
        if variant is None or variant.is_embedded:
            places[name] = Places(keys=keys)
        else:
            places[name] = start_routers(processes, folder, keys if variant.is_tls else "")
    return places


def measure(carriers: Sequence[str], rounds: int, seconds: float, messages: int) -> dict[str, Any]:
    """Measure every carrier once in each round, and return the summary; a carrier that fails is left out."""
    rounds_by_carrier: dict[str, list[PaceResults]] = {carrier: [] for carrier in carriers}
    with tempfile.TemporaryDirectory() as folder, Processes(Path(folder)) as processes:
        places = prepare(carriers, processes, Path(folder))
        for number in range(rounds):
            names = list(rounds_by_carrier)
            for carrier in names if number % 2 == 0 else reversed(names):
                try:
                    results = run(carrier, places[carrier], seconds, messages)
                except WorkError as error:
                    print(f"{carrier} is left out from now on: {error}", file=sys.stderr)
                    del rounds_by_carrier[carrier]
                    continue
                rounds_by_carrier[carrier].append(results)
                cells = (
                    f"{label} {cell(results[pace], 50)} / {cell(results[pace], 99)} us"
                    + (f", {results[pace]['lost']:.0f} lost" if results[pace]["lost"] else "")
                    for pace, label in PACE_LABELS.items()
                )
                print(f"{number + 1} {carrier}: {'; '.join(cells)}", flush=True)
    return summary(rounds_by_carrier)


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of the part at 50 Hz of each run")
    parser.add_argument("--messages", type=int, default=2000, help="number of messages back to back in each run")
    parser.add_argument("--only", action="append", choices=CARRIERS, help="a carrier; repeatable")
    parser.add_argument("--no-variants", action="store_true", help="leave out the variants of the embedded routers")
    parser.add_argument("--short", action="store_true", help="one round of a second each, to try the benchmark")
    options = parser.parse_args(words)
    if options.short:
        vars(options).update(SHORT)
    if options.rounds < 1 or options.seconds <= 0 or options.messages < 1:
        parser.error("--rounds, --seconds and --messages must be above zero")
    return options


def select(options: argparse.Namespace) -> list[str]:
    """Return the carriers to measure, and say which are not installed."""
    requested = [
        name
        for name, carrier in CARRIERS.items()
        if name in (options.only or CARRIERS) and not (options.no_variants and carrier.is_variant)
    ]
    missing = [name for name in requested if CARRIERS[name].is_missing]
    for name in missing:
        print(f"{name} is not measured: it is not installed (pip install {CARRIERS[name].package})", file=sys.stderr)
    return [name for name in requested if name not in missing]


def main() -> int:
    """Measure the selected carriers, and return the exit code: 2 if none is installed, 1 if one failed."""
    options = arguments()
    process_priority.raise_priority()  # as the server and the client do; routers and measuring processes inherit it
    carriers = select(options)
    if not carriers:
        return 2
    run_s = options.seconds + options.messages * 0.0005 + OVERHEAD_S
    print(f"{len(carriers)} carriers, about {options.rounds * len(carriers) * run_s / 60:.0f} min", flush=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the separate routers are ended, too
    quiet = Quiet()
    try:
        medians = measure(carriers, options.rounds, options.seconds, options.messages)
    except LavtError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    print(f"\n{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, {quiet.sentence()}\n")
    measured = {name: values for name, values in medians.items() if not CARRIERS[name].is_variant}
    for text in (carriers_table(measured), stages_table(medians), variants_table(medians), "\n".join(goals(medians))):
        print(f"{text}\n")
    print(json.dumps(medians))
    return 0 if len(medians) == len(carriers) else 1


if __name__ == "__main__":
    sys.exit(main())
