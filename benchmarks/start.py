"""How long commands take to start, and how much memory they need, compared with another source tree.

    git worktree add ../before COMMIT && python benchmarks/start.py --before ../before/src --rounds 7

Both trees run in turns, in random order within each round. For each command the program prints the median of the
processor time, of the time on the clock and of the peak of the resident memory until the command is done or ready, and
the median over the rounds of the ratio to the other tree.

`run` is ready when its drive begins, that is when it has created the record of the server; `server` when it reports
that it is ready. These two are stopped then.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.streams import stream

OWN = Path(__file__).parents[1] / "src"
POLL_NS = 5 * NS_PER_MS
LIMIT_S = 300
LOOPBACK_SERVER = (
    *("server", "configs/server.yaml", "--json", "--set", "video.port=0", "--set", "clock.probe_port=0"),
    *("--set", "zenoh={router_settings: {listen: {endpoints: ['tcp/127.0.0.1:0']}}}"),
)


class Start(NamedTuple):
    """The cost of one start."""

    cpu_s: float
    wall_s: float
    peak_mb: float


def status_kb(pid: int, key: str) -> int:
    """Return a value of /proc/PID/status in kB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1])
    return 0


def cpu_s(pid: int) -> float:
    """Return the processor time of a process and its finished children, in s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def start_to_end(tree: Path, arguments: tuple[str, ...]) -> Start:
    """Run a command to its end."""
    clock = MachineClock()
    begin_ns = clock.now().mono_ns
    process = launch(tree, arguments, subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    wall_s = (clock.now().mono_ns - begin_ns) / NS_PER_S
    if process.returncode != 0:
        raise SystemExit(f"lavt {' '.join(arguments)} of {tree} failed with exit code {process.returncode}")
    return Start(usage.ru_utime + usage.ru_stime, wall_s, usage.ru_maxrss / 1024)


def start_until(tree: Path, arguments: tuple[str, ...], out: Path, is_ready: Callable[[Path], bool]) -> Start:
    """Run a command until `is_ready`, given the file of its output, then stop it."""
    clock = MachineClock()
    output = out / "output.txt"
    with output.open("wb") as file:
        begin_ns = clock.now().mono_ns
        process = launch(tree, arguments, file.fileno())
        while not is_ready(output):
            if process.poll() is not None or clock.now().mono_ns - begin_ns > LIMIT_S * NS_PER_S:
                process.kill()
                raise SystemExit(f"lavt {' '.join(arguments)} of {tree} did not become ready")
            pause(POLL_NS)
        wall_s = (clock.now().mono_ns - begin_ns) / NS_PER_S
        start = Start(cpu_s(process.pid), wall_s, status_kb(process.pid, "VmHWM") / 1024)
        process.send_signal(signal.SIGINT)
        process.wait(LIMIT_S)
    return start


def launch(tree: Path, arguments: tuple[str, ...], stdout: int) -> subprocess.Popen[bytes]:
    """Start `lavt` from a source tree."""
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    command = [sys.executable, "-m", "lavt", *arguments]
    return subprocess.Popen(command, stdout=stdout, stderr=subprocess.DEVNULL, env=environment, cwd=tree.parent)


def start_run(tree: Path) -> Start:
    """Start a run in virtual time, until its drive begins."""
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        arguments = ("run", "configs/demo.yaml", "--set", "vehicle.scenery=none", "--out", str(out / "run"))
        return start_until(tree, arguments, out, lambda _: (out / "run" / "server.mcap").exists())


def start_server(tree: Path) -> Start:
    """Start a server, until it is ready."""
    with tempfile.TemporaryDirectory() as name:
        return start_until(tree, LOOPBACK_SERVER, Path(name), lambda output: b'"ready"' in output.read_bytes())


COMMANDS: Mapping[str, Callable[[Path], Start]] = {
    "lavt --help": lambda tree: start_to_end(tree, ("--help",)),
    "lavt --version": lambda tree: start_to_end(tree, ("--version",)),
    "lavt stop --help": lambda tree: start_to_end(tree, ("stop", "--help")),
    "lavt run, drive begins": start_run,
    "lavt server, ready": start_server,
}


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, help="the directory src of another source tree; default: this one only")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--only", default="", help="measure only commands whose name contains this")
    options = parser.parse_args()
    trees = [OWN] if options.before is None else [OWN, options.before.resolve()]
    random = stream(1, "start")
    print(f"{'command':<24}{'CPU':>9}{'ratio':>7}{'time':>9}{'ratio':>7}{'peak memory':>13}{'ratio':>7}")
    for name, measure in COMMANDS.items():
        if options.only not in name:
            continue
        starts: dict[Path, list[Start]] = {tree: [] for tree in trees}
        for tree in trees:
            measure(tree)  # writes the compiled modules and fills the page cache
        for _ in range(options.rounds):
            for index in random.permutation(len(trees)):
                starts[trees[index]].append(measure(trees[index]))
        cells = ""
        for column, unit, digits in ((0, "s", 2), (1, "s", 2), (2, "MB", 0)):
            own = [start[column] for start in starts[OWN]]
            ratios = [mine / other[column] for mine, other in zip(own, starts[trees[-1]], strict=True)]
            ratio = "" if len(trees) == 1 else f"{statistics.median(ratios):.2f}"
            value = f"{statistics.median(own):.{digits}f} {unit}"
            cells += f"{value:>{13 if column == 2 else 9}}{ratio:>7}"
        print(f"{name:<24}{cells}", flush=True)


if __name__ == "__main__":
    main()
