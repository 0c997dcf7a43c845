"""Send video over loopback for minutes and check that memory, threads and latency do not grow.

LAVT's two processes of `video_vs_gstreamer.py` send and receive. Memory is the resident set of each process, sampled
twice a second. The growth of memory is the slope of a straight line through the samples after the first quarter.

With `--road-km`, drive a long road instead, in virtual time at 11 m/s with full scenery but without a codec, in one
process that has the nodes of both sides. It is sampled every second of virtual time.

    python benchmarks/endurance.py [--minutes 2]
    python benchmarks/endurance.py --road-km 5
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package `benchmarks`

from benchmarks.video.clean import SIZES, describe_clean_run
from benchmarks.video.pictures import render_pictures
from benchmarks.video.processes import BenchmarkProcess, measure
from benchmarks.video.run import RATE_HZ

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_S
from lavt.errors import WorkError
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import build_loop, drive
from lavt.runtime import process_priority

SAMPLE_PERIOD_S = 0.5
ROAD_SPEED_MPS = 11.0
MEDIAN_INTERVAL_S = 10
MAX_GROWTH_KB_PER_MINUTE = 100.0
"""Growth up to this limit is the normal variation of an allocator."""
MAX_ROAD_GROWTH_KB_PER_MINUTE = 1000.0
"""The limit on a long road. If no ground were removed from the cache, memory would grow by more than 50 000 kB/min."""
MAX_GROWTH_MS = 0.5
"""Latency has grown if it has increased by more than this limit and by more than a quarter."""


@dataclass(frozen=True)
class ResourceSample:
    """The resources of a process at a time after its start."""

    at_s: float
    memory_kb: int
    threads: int


def sample_process(process_id: int, at_s: float) -> ResourceSample:
    """Return the resources that a process uses now, with the given time."""
    lines = Path(f"/proc/{process_id}/status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines if ":" in line)
    return ResourceSample(at_s, int(status["VmRSS"].split()[0]), int(status["Threads"]))


def without_first_quarter(samples: Sequence[ResourceSample]) -> Sequence[ResourceSample]:
    """Return the samples without the first quarter, in which buffers reach their size."""
    return samples[len(samples) // 4 :]


def growth_kb_per_minute(samples: Sequence[ResourceSample]) -> float:
    """Return the slope of the straight line through memory over time."""
    slope_kb_per_s, _ = np.polyfit([sample.at_s for sample in samples], [sample.memory_kb for sample in samples], 1)
    return float(slope_kb_per_s) * 60


def medians_ms(latency_ms: NDArray[np.float64]) -> list[float]:
    """Return the median of each 10 s. A shorter rest at the end is ignored, unless the whole run is shorter."""
    frames = min(MEDIAN_INTERVAL_S * RATE_HZ, len(latency_ms))
    return [
        float(np.median(latency_ms[begin : begin + frames])) for begin in range(0, len(latency_ms) - frames + 1, frames)
    ]


def quarter_medians_ms(latency_ms: NDArray[np.float64]) -> tuple[float, float]:
    """Return the medians of the first and the last quarter."""
    quarter = max(1, len(latency_ms) // 4)
    return float(np.median(latency_ms[:quarter])), float(np.median(latency_ms[-quarter:]))


class ResourceSampler:
    """A thread that samples the resources of both processes of a run."""

    def __init__(self, seconds: float) -> None:
        self.samples: dict[str, list[ResourceSample]] = {}
        self._count = max(2, int(seconds / SAMPLE_PERIOD_S))
        self._pause = threading.Event()

    def start(self, processes: Sequence[BenchmarkProcess]) -> None:
        """Start the sampling thread."""
        threading.Thread(target=self._run, args=(list(processes),), daemon=True).start()

    def _run(self, processes: list[BenchmarkProcess]) -> None:
        for number in range(self._count):
            self._pause.wait(SAMPLE_PERIOD_S)
            for process in processes:
                sample = sample_process(process.process_id, number * SAMPLE_PERIOD_S)
                self.samples.setdefault(process.name, []).append(sample)


def describe_growth(samples: Mapping[str, Sequence[ResourceSample]], latency_ms: NDArray[np.float64]) -> list[str]:
    """Return a clause for each quantity that has grown."""
    clauses = []
    for name, all_samples in samples.items():
        later_samples = without_first_quarter(all_samples)
        if (slope := growth_kb_per_minute(later_samples)) > MAX_GROWTH_KB_PER_MINUTE:
            clauses.append(f"the memory of {name} grew by {slope:.0f} kB/min")
        if later_samples[-1].threads > later_samples[0].threads:
            clauses.append(f"the threads of {name} grew from {later_samples[0].threads} to {later_samples[-1].threads}")
    first_ms, last_ms = quarter_medians_ms(latency_ms)
    if last_ms - first_ms > max(MAX_GROWTH_MS, first_ms / 4):
        clauses.append(f"latency grew from {first_ms:.2f} to {last_ms:.2f} ms")
    return clauses


def long_road(length_km: float) -> str:
    """Return a road file of at least this length: straights, and curves of 200 m radius to either side."""
    segments: list[dict[str, float]] = []
    for kilometre in range(math.ceil(length_km)):
        bend_per_m = 0.005 * (-1) ** kilometre
        segments += (
            {"length_m": 500.0},
            {"length_m": 100.0, "end_curvature_per_m": bend_per_m},
            {"length_m": 300.0, "curvature_per_m": bend_per_m},
            {"length_m": 100.0, "curvature_per_m": bend_per_m, "end_curvature_per_m": 0.0},
        )
    while sum(segment["length_m"] for segment in segments[:-1]) >= length_km * 1000:
        segments.pop()
    rails = [{"offset_m": -3.5}, {"offset_m": 7.0}]
    return json.dumps(
        {"title": "long", "segments": segments, "lanes": {"widths_m": [3.5, 3.5], "driven": 1}, "rails": rails}
    )


def drive_long_road(length_km: float, folder: Path) -> list[ResourceSample]:
    """Drive in virtual time; return this process's resources at each second. Raise `WorkError` if the car departs."""
    road = folder / "long.yaml"
    road.write_text(long_road(length_km))
    changes = [f"vehicle.route={road}", "fidelity=pixels", f"controller.speed_mps={ROAD_SPEED_MPS}"]
    loop = build_loop(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes)), folder / "run")
    samples: list[ResourceSample] = []
    drive(loop, progress=lambda at_ns: samples.append(sample_process(os.getpid(), at_ns / NS_PER_S)))
    if loop.observer.ending != "completed":
        raise WorkError(f"the drive ended with {loop.observer.ending}")
    return samples


def check_long_road(length_km: float) -> int:
    """Drive a long road and print its memory of each minute; return 1 if it grew."""
    with tempfile.TemporaryDirectory() as folder:
        samples = drive_long_road(length_km, Path(folder))
    print("| minute | memory MB |")
    print("|---|---|")
    for sample in samples[::60]:
        print(f"| {sample.at_s / 60:.0f} | {sample.memory_kb / 1000:.1f} |")
    slope = growth_kb_per_minute(samples[len(samples) // 2 :])
    grew = slope > MAX_ROAD_GROWTH_KB_PER_MINUTE
    print(f"\nMemory grew by {slope:.0f} kB/min, at the end to {samples[-1].memory_kb / 1000:.1f} MB.")
    print("Memory grew too much." if grew else "Nothing grew.")
    return 1 if grew else 0


def main() -> int:
    """Measure and print a table; return 1 if anything grew."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=2.0, help="length of the run, after a warm-up of 3 s")
    parser.add_argument("--road-km", type=float, help="drive a road of this length in virtual time instead")
    options = parser.parse_args()
    if options.road_km is not None:
        if not 0 < options.road_km <= 100:
            parser.error("--road-km must be above zero and at most 100")
        return check_long_road(options.road_km)
    if not 0 < options.minutes <= 60:
        parser.error("--minutes must be above zero and at most 60")
    process_priority.raise_priority()  # as the server and the client do
    sampler = ResourceSampler(options.minutes * 60)  # the run takes longer, because of its warm-up
    with tempfile.TemporaryDirectory() as folder:
        run = describe_clean_run(Path(folder), SIZES[0], options.minutes * 60)
        render_pictures(run.pictures_stem, run.width_px, run.height_px)
        outcome = measure("ours", run, when_started=sampler.start)
    print("| process | memory MB: after a quarter | at the end | kB/min | threads: after a quarter | at the end |")
    print("|---|---|---|---|---|---|")
    for name, samples in sampler.samples.items():
        later_samples = without_first_quarter(samples)
        print(
            f"| {name} | {later_samples[0].memory_kb / 1000:.1f} | {later_samples[-1].memory_kb / 1000:.1f} "
            f"| {growth_kb_per_minute(later_samples):.1f} | {later_samples[0].threads} | {later_samples[-1].threads} |"
        )
    first_ms, last_ms = quarter_medians_ms(outcome.latency_ms)
    medians = ", ".join(f"{median_ms:.2f}" for median_ms in medians_ms(outcome.latency_ms))
    print(f"\nMedian latency of each 10 s: {medians} ms; first quarter {first_ms:.2f} ms, last {last_ms:.2f} ms.")
    print(f"Frames shown: {len(outcome.latency_ms)} of {outcome.sent}.")
    grown = describe_growth(sampler.samples, outcome.latency_ms)
    print(f"Something grew: {'; '.join(grown)}." if grown else "Nothing grew.")
    return 1 if grown else 0


if __name__ == "__main__":
    sys.exit(main())
