"""Measure how much a hostile page slows the client of a person who drives from another page.

For each attack of `benchmarks/pages/floods.py`, `lavt drive` is started. An honest page in Python arms the car and
keeps it armed, and a process attacks the console with the right token. "none" and "busy processor" are the controls:
no attack, and a program that only uses a processor, which any program of this machine can do. The table has, for the
time of the attack: the time between two commands (20 ms without an attack) and between two statuses at the honest page
(50 ms), and the processor time that the client used for each second.

    python benchmarks/page_flood.py [--only pings --only fragments] [--seconds 5] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package `benchmarks`

from benchmarks.pages.floods import ATTACKS, flooding
from benchmarks.pages.python_page import PythonPage
from benchmarks.quiet import Quiet

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import Processes
from lavt.recording.record import read_record

HEAD = "| attack | commands: P99, max (ms) | statuses: P99, max (ms) | client's processor time |"
SETTINGS = ("vehicle.scenery=none", "camera.width_px=320", "camera.height_px=240")
SETTLE_NS = NS_PER_S


def main() -> None:
    """Measure each attack and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=ATTACKS)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    quiet, results = Quiet(), {}
    sys.stdout.write(
        "| attack | commands: P99, max (ms) | statuses: P99, max (ms) | client's processor time |\n|---|---|---|---|\n"
    )
    for attack in arguments.only or ATTACKS:
        result = results[attack] = measure(attack, arguments.seconds)
        cells = [f"{result[f'{name}_p99_ms']:.0f}, {result[f'{name}_max_ms']:.0f}" for name in ("command", "status")]
        sys.stdout.write(f"| {attack} | {' | '.join(cells)} | {result['processor_share']:.0%} |\n")
        sys.stdout.flush()
    sys.stdout.write(f"{quiet.sentence()}\n")
    if arguments.json:
        sys.stdout.write(json.dumps(results) + "\n")


def measure(attack: str, duration_s: float) -> dict[str, Any]:
    """Return the numbers of one attack."""
    clock = MachineClock()
    with tempfile.TemporaryDirectory() as directory, Processes(Path(directory)) as processes:
        out = Path(directory) / "out"
        settings = [word for setting in SETTINGS for word in ("--set", setting)]
        drive = processes.start("drive", "drive", "--no-browser", "--out", str(out), *settings)
        url = drive.wait_ready()["ready"]["console"]
        page = PythonPage(url)
        page.arm()
        pause(SETTLE_NS)
        with flooding(url, attack):
            pause(SETTLE_NS)  # its start
            since_ns, used_s = clock.now().mono_ns, processor_time_s(drive.popen.pid)
            pause(round(duration_s * NS_PER_S))
            until_ns, used_s = clock.now().mono_ns, processor_time_s(drive.popen.pid) - used_s
        safety = page.status.get("safety")
        page.close()
        drive.end()
        record = read_record(out / "client" / "client.mcap")
    counts = {name: max(value or 0 for value in values) for name, values in counted(record.table("counts")).items()}
    commands_ns = record.table("control").mono_ns
    return {
        **gaps("command", np.asarray(commands_ns), since_ns, until_ns),
        **gaps("status", np.asarray(page.arrivals_ns), since_ns, until_ns),
        "processor_share": used_s / duration_s,
        "safety": safety,
        "counts": counts,
    }


def processor_time_s(pid: int) -> float:
    """Return the processor time that a process has used in all its threads (proc(5))."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def gaps(name: str, times_ns: Any, since_ns: int, until_ns: int) -> dict[str, float]:
    """Return the 99th percentile and the maximum of the times between events in an interval, its ends included."""
    inside = times_ns[(times_ns > since_ns) & (times_ns < until_ns)]
    gaps_ms = np.diff(np.concatenate([[since_ns], inside, [until_ns]])) / NS_PER_MS
    return {f"{name}_p99_ms": float(np.percentile(gaps_ms, 99)), f"{name}_max_ms": float(gaps_ms.max())}


def counted(table: Any) -> dict[str, list[Any]]:
    """Return the counts of the console in a record."""
    names = ("connections_", "page_messages_", "pages_", "inputs_")
    return {name: table.objects(name) for name in table.columns if name.startswith(names)}


if __name__ == "__main__":
    main()
