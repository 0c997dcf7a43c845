"""Sends video over loopback for minutes and tells whether anything grows: memory, threads, latency.

Both processes are those of ours in `video_vs_gstreamer.py`. Memory is what each has in RAM, twice a second; its growth
is the slope of a line through what it was after the first quarter.

    python benchmarks/endurance.py [--minutes 2]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a program it finds only what is beside it

from benchmarks.video.clean import SIZES, clean_run
from benchmarks.video.pictures import render_loop
from benchmarks.video.run import RATE_HZ
from benchmarks.video.sides import Process, measure

from lavt.runtime import process_priority

SAMPLE_S = 0.5
STRETCH_S = 10
GROWN_KB_PER_MINUTE = 100.0
"""Less is what an allocator moves to and fro; 30 minutes of more would show."""
GROWN_MS = 0.5
"""Beyond this, and beyond a quarter of itself, latency has grown and is not only another run of luck."""


@dataclass(frozen=True)
class Sample:
    """What a process took at a time after its start."""

    at_s: float
    memory_kb: int
    threads: int


def sample(process_id: int, at_s: float) -> Sample:
    """Look at a process."""
    lines = Path(f"/proc/{process_id}/status").read_text().splitlines()
    found = dict(line.split(":", 1) for line in lines if ":" in line)
    return Sample(at_s, int(found["VmRSS"].split()[0]), int(found["Threads"]))


def later(samples: Sequence[Sample]) -> Sequence[Sample]:
    """Leave the first quarter out, in which buffers find their size."""
    return samples[len(samples) // 4 :]


def growth_kb_per_minute(samples: Sequence[Sample]) -> float:
    """Slope of the straight line through memory over time."""
    slope_kb_per_s, _ = np.polyfit([each.at_s for each in samples], [each.memory_kb for each in samples], 1)
    return float(slope_kb_per_s) * 60


def medians_ms(latency_ms: NDArray[np.float64]) -> list[float]:
    """Medians of stretches of 10 s; a rest is left out, unless it is all there is."""
    frames = min(STRETCH_S * RATE_HZ, len(latency_ms))
    return [float(np.median(latency_ms[at : at + frames])) for at in range(0, len(latency_ms) - frames + 1, frames)]


def grown_ms(latency_ms: NDArray[np.float64]) -> tuple[float, float]:
    """Medians of the first and the last quarter."""
    quarter = max(1, len(latency_ms) // 4)
    return float(np.median(latency_ms[:quarter])), float(np.median(latency_ms[-quarter:]))


class Sampler:
    """Looks at both processes of a run, from a thread of its own, for as long as the run lasts."""

    def __init__(self, seconds: float) -> None:
        self.samples: dict[str, list[Sample]] = {}
        self._looks = max(2, int(seconds / SAMPLE_S))
        self._pause = threading.Event()

    def watch(self, processes: Sequence[Process]) -> None:
        """Begin to look."""
        threading.Thread(target=self._look, args=(list(processes),), daemon=True).start()

    def _look(self, processes: list[Process]) -> None:
        for number in range(self._looks):
            self._pause.wait(SAMPLE_S)
            for each in processes:
                self.samples.setdefault(each.name, []).append(sample(each.process_id, number * SAMPLE_S))


def verdicts(samples: Mapping[str, Sequence[Sample]], latency_ms: NDArray[np.float64]) -> list[str]:
    """Say in sentences what has grown; empty: nothing has."""
    found = []
    for name, all_samples in samples.items():
        kept = later(all_samples)
        if (slope := growth_kb_per_minute(kept)) > GROWN_KB_PER_MINUTE:
            found.append(f"the memory of {name} grew by {slope:.0f} kB a minute")
        if kept[-1].threads > kept[0].threads:
            found.append(f"the threads of {name} grew from {kept[0].threads} to {kept[-1].threads}")
    first_ms, last_ms = grown_ms(latency_ms)
    if last_ms - first_ms > max(GROWN_MS, first_ms / 4):
        found.append(f"latency grew from {first_ms:.2f} to {last_ms:.2f} ms")
    return found


def main() -> int:
    """Measure, print a table, and say whether anything grew: 1 if so."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=2.0)
    requested = parser.parse_args()
    if not 0 < requested.minutes <= 60:
        parser.error("--minutes must be above zero and at most 60")
    process_priority.raise_priority()  # as the server and the client do
    sampler = Sampler(requested.minutes * 60)  # the run has a warm-up besides
    with tempfile.TemporaryDirectory() as name:
        run = clean_run(Path(name), SIZES[0], requested.minutes * 60)
        render_loop(run.loop, run.width_px, run.height_px)
        outcome = measure("ours", run, when_started=sampler.watch)
    print("| process | memory MB, begin | end | kB a minute | threads, begin | end |\n|---|---|---|---|---|---|")
    for name, samples in sampler.samples.items():
        kept = later(samples)
        print(
            f"| {name} | {kept[0].memory_kb / 1000:.1f} | {kept[-1].memory_kb / 1000:.1f} "
            f"| {growth_kb_per_minute(kept):.1f} | {kept[0].threads} | {kept[-1].threads} |"
        )
    first_ms, last_ms = grown_ms(outcome.latency_ms)
    medians = ", ".join(f"{each:.2f}" for each in medians_ms(outcome.latency_ms))
    print(
        f"\nLatency, median of each 10 s: {medians} ms; of the first quarter {first_ms:.2f}, the last {last_ms:.2f} ms."
    )
    print(f"Frames shown: {len(outcome.latency_ms)} of {outcome.sent}.")
    found = verdicts(sampler.samples, outcome.latency_ms)
    print(f"Something grew: {'; '.join(found)}." if found else "Nothing grew.")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
