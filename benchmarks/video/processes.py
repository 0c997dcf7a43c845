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
from benchmarks.video.run import RATE_HZ, STAMP_COLUMN, Run, create_table, to_json
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
REPOSITORY = Path(__file__).parents[2]


class BenchmarkProcess:
    """A process of a run, which is controlled by lines on its stdin and prints lines of JSON."""

    def __init__(self, module: str, run: Run, *arguments: str) -> None:
        paths = os.pathsep.join(
            [str(REPOSITORY), str(Path(lavt.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        )
        self.name = module
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"benchmarks.video.{module}", to_json(run), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=REPOSITORY,
            env={**os.environ, "PYTHONPATH": paths},
        )

    @property
    def process_id(self) -> int:
        """The process id."""
        return self._process.pid

    def read_line(self) -> dict[str, Any]:
        """Wait for the process's next line of JSON; raise `WorkError` if the process ends first."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise WorkError(f"the process {self.name} of the benchmark ended early; see above")
        entries: dict[str, Any] = json.loads(line)
        return entries

    def send_line(self) -> None:
        """Send a line, with which the process begins or ends its work."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def close(self) -> None:
        """Close the process's stdin and wait for its end; kill the process after 5 s."""
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
    """Number of frames."""
    latency_ms: NDArray[np.float64]
    """Latency of each shown frame: a frame is shown if its picture was decoded and the stamp that was read is right."""
    sender_cpu_ms: float
    """CPU time of the sending process per sent frame."""
    receiver_cpu_ms: float
    """CPU time of the receiving process per shown frame."""
    errors: dict[int, float]
    """Mean squared error of each shown picture by row of the table of sent frames; -1 if errors were not requested."""
    relayed: dict[str, Any]
    """The counters of the relay; empty without a relay."""
    counts: dict[str, int]
    """The counters of LAVT's receiving nodes; empty for GStreamer."""

    @property
    def shown(self) -> float:
        """Share of frames that were shown."""
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
        """CPU time of both processes per frame."""
        return self.sender_cpu_ms + self.receiver_cpu_ms


def measure(
    program: Program,
    run: Run,
    relay: Sequence[str] = (),
    *,
    when_started: Callable[[Sequence[BenchmarkProcess]], None] = lambda _processes: None,
) -> RunOutcome:
    """Measure a program in a run.

    `relay` has the arguments of the relay; without arguments there is no relay. `when_started` is called with the
    processes before the first frame is sent.
    """
    create_table(Path(run.folder))
    first, last = {"ours": ("our_sender", "our_receiver"), "gstreamer": ("gstreamer_receiver", "gstreamer_sender")}[
        program
    ]
    processes: list[BenchmarkProcess] = []

    def start(module: str, port: int, *arguments: str) -> dict[str, Any]:
        processes.append(BenchmarkProcess(module, replace(run, port=port), *arguments))
        return processes[-1].read_line()

    try:
        port = start(first, 0)["port"]
        if relay:
            port = start("relay", port, program, *relay)["port"]
        start(last, port)
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


def _evaluate(run: Run, sent_cpu_ns: list[int], counts: dict[str, int], relayed: dict[str, Any]) -> RunOutcome:
    """Match the log of received pictures with the table of sent frames; `sent_cpu_ns` is the CPU time after each."""
    sent_stamps_ns = run.map_sent_table()[WARM_UP_FRAMES : run.frames, STAMP_COLUMN].tolist()
    row_by_stamp = {stamp_ns: row for row, stamp_ns in enumerate(sent_stamps_ns, WARM_UP_FRAMES)}
    latency_ms, errors, shown_cpu_ns = [], {}, []
    with np.load(Path(run.folder) / "read.npz") as log:
        for (stamp_ns, read_ns, cpu_ns), error in zip(log["rows"].tolist(), log["errors"].tolist(), strict=True):
            row = row_by_stamp.pop(stamp_ns, None)
            if row is not None:
                latency_ms.append((read_ns - stamp_ns) / NS_PER_MS)
                shown_cpu_ns.append(cpu_ns)
                errors[row] = error
    return RunOutcome(
        len(sent_stamps_ns),
        np.array(latency_ms),
        _cpu_ms_per_frame(sent_cpu_ns[WARM_UP_FRAMES:]),
        _cpu_ms_per_frame(shown_cpu_ns),
        errors,
        relayed,
        counts,
    )


def _cpu_ms_per_frame(cpu_after_each_frame_ns: list[int]) -> float:
    """Return the mean CPU time of a frame from a process's CPU time after each frame; nan for fewer than two."""
    if len(cpu_after_each_frame_ns) < 2:
        return float("nan")
    return (cpu_after_each_frame_ns[-1] - cpu_after_each_frame_ns[0]) / (len(cpu_after_each_frame_ns) - 1) / NS_PER_MS


def measure_floor_ms(run: Run) -> float:
    """Return the median time of encoding and decoding alone."""
    process = BenchmarkProcess("floor", run)
    try:
        took_ns = process.read_line()["took_ns"]
    finally:
        process.close()
    return float(np.median(took_ns[RATE_HZ:])) / NS_PER_MS


def frames_of(seconds: float) -> int:
    """Return the number of frames of a run that lasts `seconds` after the warm-up, including the warm-up's frames."""
    return WARM_UP_FRAMES + max(2, round(seconds * RATE_HZ))
