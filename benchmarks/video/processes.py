"""Start the processes of a run and evaluate its results."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time  # noqa: TID251 (the benchmark waits for a run's end)
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from benchmarks.video.run import RATE_HZ, Run, create_table, to_json
from numpy.typing import NDArray

import lavt
from lavt.domain import NS_PER_MS
from lavt.errors import WorkError

Program = Literal["ours", "gstreamer"]
"""The program that sends and receives in a run: LAVT or GStreamer."""

WARM_UP_FRAMES = 3 * RATE_HZ
"""Frames that are sent first and not counted."""
DRAIN_S = 0.5
"""Time for the last packets to arrive."""
FOLDER = Path(__file__).parents[2]


class BenchmarkProcess:
    """A process of a run, which is controlled by lines on its stdin and prints lines of JSON."""

    def __init__(self, name: str, run: Run, *more: str) -> None:
        paths = os.pathsep.join([str(FOLDER), str(Path(lavt.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
        self.name = name
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"benchmarks.video.{name}", to_json(run), *more],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=FOLDER,
            env={**os.environ, "PYTHONPATH": paths},
        )

    @property
    def process_id(self) -> int:
        """The process id."""
        return self._process.pid

    def read_line(self) -> dict[str, Any]:
        """Wait for the process's next line of JSON; raise `WorkError` if it ends without one."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise WorkError(f"the process {self.name} of the benchmark ended early; see above")
        entries: dict[str, Any] = json.loads(line)
        return entries

    def send_line(self) -> None:
        """Send a line, which tells the process to begin or to end."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def close(self) -> None:
        """Wait for the end of the process; kill it after 5 s."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@dataclass(frozen=True)
class RunOutcome:
    """The results of a run for the frames after the warm-up."""

    sent: int
    latency_ms: NDArray[np.float64]
    """Latency of each frame whose picture was shown with its stamp."""
    sender_cpu_ms: float
    """CPU time per frame."""
    receiver_cpu_ms: float
    """CPU time per frame."""
    errors: dict[int, float]
    """Mean squared error of each shown picture by its row in the table; -1 if errors were not requested."""
    relayed: dict[str, Any]
    """The counters of the relay; empty without a relay."""
    counts: dict[str, int]
    """The counters of LAVT's receiving nodes; empty for GStreamer."""

    @property
    def shown(self) -> float:
        """Share of frames whose picture was shown with its stamp."""
        return len(self.latency_ms) / self.sent

    @property
    def median_ms(self) -> float:
        """Median latency."""
        return float(np.median(self.latency_ms)) if len(self.latency_ms) else float("nan")

    @property
    def p95_ms(self) -> float:
        """95th percentile of the latency."""
        return float(np.percentile(self.latency_ms, 95)) if len(self.latency_ms) else float("nan")

    @property
    def cpu_ms(self) -> float:
        """CPU time of both processes for a frame."""
        return self.sender_cpu_ms + self.receiver_cpu_ms


def measure(
    program: Program,
    run: Run,
    relay: Sequence[str] = (),
    *,
    when_started: Callable[[Sequence[BenchmarkProcess]], None] = lambda _processes: None,
) -> RunOutcome:
    """Run a program; `relay` are the arguments of the relay, if there is one. `when_started` gets the processes."""
    create_table(Path(run.folder))
    order = {"ours": ("our_sender", "our_receiver"), "gstreamer": ("gstreamer_receiver", "gstreamer_sender")}[program]
    processes: list[BenchmarkProcess] = []

    def start(name: str, port: int, *more: str) -> dict[str, Any]:
        processes.append(BenchmarkProcess(name, replace(run, port=port), *more))
        return processes[-1].read_line()

    try:
        port = start(order[0], 0)["port"]
        if relay:
            port = start("relay", port, program, *relay)["port"]
        start(order[1], port)
        sender, receiver = (processes[0], processes[-1]) if program == "ours" else (processes[-1], processes[0])
        when_started(processes)
        sender.send_line()
        sent = sender.read_line()
        time.sleep(DRAIN_S)
        receiver.send_line()
        received = receiver.read_line()
        relayed = {}
        if relay:
            processes[1].send_line()
            relayed = processes[1].read_line()
    finally:
        for process in processes:
            process.close()
    return _evaluate(run, sent["cpu_ns"], received["counts"], relayed)


def _evaluate(run: Run, sender_cpu_ns: list[int], counts: dict[str, int], relayed: dict[str, Any]) -> RunOutcome:
    stamps = run.table()[WARM_UP_FRAMES : run.frames, 0].tolist()
    rows = {stamp_ns: row for row, stamp_ns in enumerate(stamps, WARM_UP_FRAMES)}
    latency_ms, errors, cpu_ns = [], {}, []
    with np.load(Path(run.folder) / "read.npz") as log:
        for (stamp_ns, read_ns, at_cpu_ns), error in zip(log["rows"].tolist(), log["errors"].tolist(), strict=True):
            row = rows.pop(stamp_ns, None)
            if row is not None:
                latency_ms.append((read_ns - stamp_ns) / NS_PER_MS)
                cpu_ns.append(at_cpu_ns)
                errors[row] = error
    counted_cpu_ns = sender_cpu_ns[WARM_UP_FRAMES:]  # after each frame
    return RunOutcome(
        len(stamps),
        np.array(latency_ms),
        (counted_cpu_ns[-1] - counted_cpu_ns[0]) / (len(counted_cpu_ns) - 1) / NS_PER_MS,
        (cpu_ns[-1] - cpu_ns[0]) / (len(cpu_ns) - 1) / NS_PER_MS if len(cpu_ns) > 1 else float("nan"),
        errors,
        relayed,
        counts,
    )


def measure_floor_ms(run: Run) -> float:
    """Measure the median time of encoding and decoding alone."""
    process = BenchmarkProcess("floor", run)
    try:
        took_ns = process.read_line()["took_ns"]
    finally:
        process.close()
    return float(np.median(took_ns[RATE_HZ:])) / NS_PER_MS


def frames_of(seconds: float) -> int:
    """Return the number of frames of a run of `seconds`, including the warm-up."""
    return WARM_UP_FRAMES + max(2, round(seconds * RATE_HZ))
