"""Starting a run's processes, and what comes of it."""

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
from benchmarks.video.run import RATE_HZ, Run, new_table, told
from numpy.typing import NDArray

import lavt
from lavt.domain import NS_PER_MS
from lavt.errors import WorkError

Side = Literal["ours", "gstreamer"]

WARM_UP_FRAMES = 3 * RATE_HZ
"""Sent first, and not counted."""
DRAIN_S = 0.5
"""What is on its way at the end has so long to arrive."""
FOLDER = Path(__file__).parents[2]


class Process:
    """A process of a run: begins when told to, and tells things by lines of JSON."""

    def __init__(self, name: str, run: Run, *more: str) -> None:
        paths = os.pathsep.join([str(FOLDER), str(Path(lavt.__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
        self.name = name
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"benchmarks.video.{name}", told(run), *more],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=FOLDER,
            env={**os.environ, "PYTHONPATH": paths},
        )  # fmt: skip

    @property
    def process_id(self) -> int:
        """Its number in the system."""
        return self._process.pid

    def heard(self) -> dict[str, Any]:
        """Wait for its next line; raises `WorkError` when it ends without one."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise WorkError(f"the process {self.name} of the benchmark ended before its time; see above")
        entries: dict[str, Any] = json.loads(line)
        return entries

    def tell(self) -> None:
        """Say that it may begin, or that it shall end."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def close(self) -> None:
        """Wait for its end, or bring it about."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@dataclass(frozen=True)
class Outcome:
    """What a run gave, of the frames after the warm-up."""

    sent: int
    latency_ms: NDArray[np.float64]
    """Of each frame whose picture came out with its stamp."""
    sender_cpu_ms: float
    """For a frame, like the next."""
    receiver_cpu_ms: float
    errors: dict[int, float]
    """Mean squared error of each picture that came out, by its place in the table; empty where nothing was kept."""
    relayed: dict[str, Any]
    counts: dict[str, int]

    @property
    def shown(self) -> float:
        """Share of the frames whose picture came out with its stamp."""
        return len(self.latency_ms) / self.sent

    @property
    def median_ms(self) -> float:
        """Median latency."""
        return float(np.median(self.latency_ms)) if len(self.latency_ms) else float("nan")

    @property
    def p95_ms(self) -> float:
        """What 95 % of the frames kept to."""
        return float(np.percentile(self.latency_ms, 95)) if len(self.latency_ms) else float("nan")

    @property
    def cpu_ms(self) -> float:
        """CPU time for a frame, of both processes."""
        return self.sender_cpu_ms + self.receiver_cpu_ms


def measure(
    side: Side,
    run: Run,
    relay: Sequence[str] = (),
    *,
    when_started: Callable[[Sequence[Process]], None] = lambda _processes: None,
) -> Outcome:
    """Do a run; `relay` is what the relay is told, if there is one. `when_started` gets the processes."""
    new_table(Path(run.folder))
    order = {"ours": ("our_sender", "our_receiver"), "gstreamer": ("gstreamer_receiver", "gstreamer_sender")}[side]
    processes: list[Process] = []

    def start(name: str, port: int, *more: str) -> dict[str, Any]:
        processes.append(Process(name, replace(run, port=port), *more))
        return processes[-1].heard()

    try:
        port = start(order[0], 0)["port"]
        if relay:
            port = start("relay", port, side, *relay)["port"]
        start(order[1], port)
        sender, receiver = (processes[0], processes[-1]) if side == "ours" else (processes[-1], processes[0])
        when_started(processes)
        sender.tell()
        sent = sender.heard()
        time.sleep(DRAIN_S)
        receiver.tell()
        received = receiver.heard()
        relayed = {}
        if relay:
            processes[1].tell()
            relayed = processes[1].heard()
    finally:
        for each in processes:
            each.close()
    return _outcome(run, sent["cpu_ns"], received["counts"], relayed)


def _outcome(run: Run, sender_cpu_ns: list[int], counts: dict[str, int], relayed: dict[str, Any]) -> Outcome:
    stamps = run.table()[WARM_UP_FRAMES : run.frames, 0].tolist()
    places = {stamp_ns: WARM_UP_FRAMES + place for place, stamp_ns in enumerate(stamps)}
    latency_ms, errors, cpu_ns = [], {}, []
    with np.load(Path(run.folder) / "read.npz") as read:
        for (stamp_ns, read_ns, at_cpu_ns), error in zip(read["rows"].tolist(), read["errors"].tolist(), strict=True):
            place = places.pop(stamp_ns, None)
            if place is not None:
                latency_ms.append((read_ns - stamp_ns) / NS_PER_MS)
                cpu_ns.append(at_cpu_ns)
                errors[place] = error
    steps = sender_cpu_ns[WARM_UP_FRAMES:]
    return Outcome(
        len(stamps),
        np.array(latency_ms),
        (steps[-1] - steps[0]) / (len(steps) - 1) / NS_PER_MS,
        (cpu_ns[-1] - cpu_ns[0]) / (len(cpu_ns) - 1) / NS_PER_MS if len(cpu_ns) > 1 else float("nan"),
        errors,
        relayed,
        counts,
    )


def floor_ms(run: Run) -> float:
    """Measure the median of encoding and decoding alone."""
    process = Process("floor", run)
    try:
        took_ns = process.heard()["took_ns"]
    finally:
        process.close()
    return float(np.median(took_ns[RATE_HZ:])) / NS_PER_MS


def frames_of(seconds: float) -> int:
    """How many frames a run of so many seconds sends, the warm-up among them."""
    return WARM_UP_FRAMES + max(2, round(seconds * RATE_HZ))
