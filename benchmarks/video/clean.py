"""Benchmarks without impairments: LAVT and GStreamer on the loopback, and the floor (the codec alone)."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from benchmarks.video.processes import Program, RunOutcome, frames_of, measure, measure_floor_ms
from benchmarks.video.run import Run

MAX_FLOOR_RUN_S = 6.0
"""The longest measurement of the codec's floor, in seconds of video; the runs beside it can be longer."""
USUAL_JITTER_BUFFER_MS = 200


@dataclass(frozen=True)
class Size:
    """A picture size with its bit rate."""

    name: str
    width_px: int
    height_px: int
    bit_rate_bps: int


SIZES = (Size("480p", 640, 480, 2_000_000), Size("720p", 1280, 720, 4_000_000))


@dataclass(frozen=True)
class ComparisonPair:
    """A run of LAVT, a run of tuned GStreamer, and between the two a measurement of the codec's floor."""

    ours: RunOutcome
    tuned: RunOutcome
    floor_ms: float
    """The latency of encoding and decoding alone."""

    @property
    def median_ratio(self) -> float:
        """Our median latency divided by GStreamer's."""
        return self.ours.median_ms / self.tuned.median_ms

    @property
    def p95_ratio(self) -> float:
        """Our 95th percentile of latency divided by GStreamer's."""
        return self.ours.p95_ms / self.tuned.p95_ms

    @property
    def cpu_ratio(self) -> float:
        """Our CPU time per frame divided by GStreamer's."""
        return self.ours.cpu_ms / self.tuned.cpu_ms

    @property
    def over_floor_ms(self) -> float:
        """Our median latency minus the codec's floor."""
        return self.ours.median_ms - self.floor_ms


def describe_clean_run(folder: Path, size: Size, seconds: float) -> Run:
    """Return the description of a run that lasts `seconds` after the warm-up."""
    return Run(str(folder), size.width_px, size.height_px, size.bit_rate_bps, frames_of(seconds))


def measure_pairs(run: Run, pairs: int) -> Iterator[ComparisonPair]:
    """Measure and yield `pairs` pairs; every second pair begins with GStreamer."""
    for number in range(pairs):
        order: tuple[Program, Program] = ("ours", "gstreamer") if number % 2 == 0 else ("gstreamer", "ours")
        first, floor_ms, second = measure(order[0], run), _measure_floor_ms(run), measure(order[1], run)
        ours, tuned = (first, second) if order[0] == "ours" else (second, first)
        pair = ComparisonPair(ours, tuned, floor_ms)
        print(
            f"  pair {number + 1}: LAVT {ours.median_ms:.2f}, GStreamer {tuned.median_ms:.2f}, floor {floor_ms:.2f} ms",
            file=sys.stderr,
        )
        yield pair


def _measure_floor_ms(run: Run) -> float:
    return measure_floor_ms(replace(run, frames=min(run.frames, frames_of(MAX_FLOOR_RUN_S))))


def measure_usual(run: Run) -> RunOutcome:
    """Measure GStreamer with its usual settings: with a jitter buffer, and showing each picture when it is due."""
    return measure("gstreamer", replace(run, jitter_buffer_ms=USUAL_JITTER_BUFFER_MS, synchronous=True))


def format_row(name: str, outcome: RunOutcome) -> str:
    """Return a row of the table."""
    return (
        f"| {name} | {outcome.median_ms:.2f} | {outcome.p95_ms:.2f} | {outcome.sender_cpu_ms:.2f} "
        f"| {outcome.receiver_cpu_ms:.2f} | {len(outcome.latency_ms)} of {outcome.sent} |"
    )


def run_clean_part(folder: Path, size: Size, *, pairs: int, seconds: float) -> dict[str, float]:
    """Measure a picture size, print its table, and return its values for the line of JSON."""
    run = describe_clean_run(folder, size, seconds)
    print(f"\n## {size.name}, {size.bit_rate_bps / 1e6:g} Mb/s, {pairs} pairs of {seconds:g} s\n")
    print("| run | median ms | p95 ms | CPU sender ms/frame | CPU receiver ms/frame | frames shown |")
    print("|---|---|---|---|---|---|")
    measured_pairs = []
    for pair in measure_pairs(run, pairs):
        measured_pairs.append(pair)
        print(format_row(f"LAVT {len(measured_pairs)}", pair.ours))
        print(format_row(f"GStreamer, tuned {len(measured_pairs)}", pair.tuned))
        print(f"| floor {len(measured_pairs)} | {pair.floor_ms:.2f} | | | | |", flush=True)
    print(format_row("GStreamer, usual settings", measure_usual(run)))
    ratios = {
        "median_ratio": median(pair.median_ratio for pair in measured_pairs),
        "cpu_ratio": median(pair.cpu_ratio for pair in measured_pairs),
        "over_floor_ms": median(pair.over_floor_ms for pair in measured_pairs),
    }
    p95 = median(pair.p95_ratio for pair in measured_pairs)
    print(
        f"\nLAVT / tuned GStreamer, median over pairs: median {ratios['median_ratio']:.2f}, p95 {p95:.2f}, "
        f"CPU {ratios['cpu_ratio']:.2f}; LAVT is {ratios['over_floor_ms']:.2f} ms above the codec's floor.",
        flush=True,
    )
    return {name: round(value, 3) for name, value in ratios.items()}
