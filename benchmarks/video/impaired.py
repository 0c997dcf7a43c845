"""The parts on an impaired link, which delays, reorders or loses packets: shares of shown and of undamaged frames."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import av
import numpy as np
from benchmarks.video.clean import SIZES
from benchmarks.video.floor import open_decoder
from benchmarks.video.pictures import memory_map_pictures, picture_of, squared_error
from benchmarks.video.processes import WARM_UP_FRAMES, Program, RunOutcome, measure
from benchmarks.video.relay import LinkCase
from benchmarks.video.run import NUMBER_COLUMN, Run, load_units

from lavt.errors import WorkError

CASES = (
    LinkCase("reorder", jitter_ms=8),
    LinkCase("loss1", loss=0.01),
    LinkCase("loss5", loss=0.05),
    LinkCase("burst1", loss=0.01, burst_packets=3),
    LinkCase("burst5", loss=0.05, burst_packets=3),
)
IMPAIRED_SIZE = SIZES[0]
GSTREAMER_JITTER_BUFFERS_MS = {"reorder": (30,), "loss1": (0, 30), "loss5": (0, 30), "burst1": (30,), "burst5": (30,)}
"""The lengths of GStreamer's jitter buffer with which each case is measured. The line of JSON has the best result."""
DAMAGED_DB = 2.0
"""A picture is damaged if its PSNR is lower than that of the loss-free picture by more than this."""


@dataclass(frozen=True)
class AssessedRun:
    """A run with the quality of its pictures."""

    outcome: RunOutcome
    undamaged: float
    """Share of the frames that were shown undamaged."""

    @property
    def overhead(self) -> float:
        """Bytes of repair packets divided by bytes of media packets."""
        relayed = self.outcome.relayed
        return float(relayed.get("repair_bytes", 0) / relayed["media_bytes"])

    @property
    def lost(self) -> float:
        """Share of packets that the link lost."""
        relayed = self.outcome.relayed
        sent = relayed["media_packets"] + relayed.get("repair_packets", 0)
        return float((relayed["media_lost"] + relayed.get("repair_lost", 0)) / sent)


def psnr_db(mean_squared_error: float) -> float:
    """Return the peak signal-to-noise ratio of 8-bit luma."""
    return math.inf if mean_squared_error <= 0 else 10 * math.log10(255**2 / mean_squared_error)


def loss_free_errors(run: Run) -> list[float]:
    """Decode the stream as it was sent; return the mean squared error of each frame's luma to the source picture."""
    decoder, source = open_decoder(), memory_map_pictures(run.pictures_stem)
    numbers = run.map_sent_table()[:, NUMBER_COLUMN]
    errors = []
    for index, unit in enumerate(load_units(run)):
        frames = decoder.decode(av.Packet(unit))
        if len(frames) != 1:
            raise WorkError(f"access unit {index} of a run gave {len(frames)} pictures, not one: cannot assess the run")
        plane = frames[0].planes[0]
        luma = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)  # type: ignore[call-overload]
        errors.append(squared_error(luma[: run.height_px, : run.width_px], picture_of(source, int(numbers[index]))))
    if len(errors) != run.frames:
        raise WorkError(f"a run of {run.frames} frames has {len(errors)} access units: cannot assess it")
    return errors


def undamaged_share(received: dict[int, float], loss_free: Sequence[float]) -> float:
    """Return which share of the frames after the warm-up was received undamaged.

    The arguments are the mean squared errors by frame: of the shown pictures, and of the pictures without loss.
    """
    good = sum(
        frame in received and psnr_db(received[frame]) >= psnr_db(loss_free[frame]) - DAMAGED_DB
        for frame in range(WARM_UP_FRAMES, len(loss_free))
    )
    return good / (len(loss_free) - WARM_UP_FRAMES)


def run_impaired_part(folder: Path, case: LinkCase, *, frames: int) -> dict[str, float]:
    """Measure a case, print its table, and return its values for the line of JSON (none for bursts)."""
    size = IMPAIRED_SIZE
    run = Run(
        str(folder),
        size.width_px,
        size.height_px,
        size.bit_rate_bps,
        WARM_UP_FRAMES + frames,
        saves_units_and_picture_errors=True,
    )
    impairment = f"loss {case.loss:.0%}" if case.loss else f"U(0, {case.jitter_ms:g}) ms, reordering"
    bursts = f", bursts of {case.burst_packets:g} packets" if case.burst_packets else ""
    print(f"\n## {case.name}: {size.name}, 20 ms each way, {impairment}{bursts}, {frames} frames\n")
    print("| run | median ms | p95 ms | shown | undamaged | overhead | lost | relay late by, p99 / longest ms |")
    print("|---|---|---|---|---|---|---|---|")
    ours = _measure_quality("ours", run, case)
    _print_row("LAVT", ours)
    gstreamer = []
    for jitter_buffer_ms in GSTREAMER_JITTER_BUFFERS_MS[case.name]:
        gstreamer.append(_measure_quality("gstreamer", replace(run, jitter_buffer_ms=jitter_buffer_ms), case))
        _print_row(f"GStreamer, jitter buffer {jitter_buffer_ms} ms", gstreamer[-1])
    if not case.loss:
        return {"shown": round(ours.outcome.shown, 4)}
    if case.burst_packets:
        return {}
    return {
        "undamaged": round(ours.undamaged, 4),
        "overhead": round(ours.overhead, 4),
        "gstreamer_undamaged": round(max(assessed.undamaged for assessed in gstreamer), 4),
    }


def _measure_quality(program: Program, run: Run, case: LinkCase) -> AssessedRun:
    outcome = measure(program, run, (case.to_json(),))
    print(f"  {case.name}: {program} done, {outcome.counts}", file=sys.stderr)
    return AssessedRun(outcome, undamaged_share(outcome.errors, loss_free_errors(run)))


def _print_row(name: str, assessed: AssessedRun) -> None:
    outcome = assessed.outcome
    late = f"{outcome.relayed['late_p99_ms']:.1f} / {outcome.relayed['late_max_ms']:.1f}"
    print(
        f"| {name} | {outcome.median_ms:.1f} | {outcome.p95_ms:.1f} | {outcome.shown:.2%} | {assessed.undamaged:.2%} "
        f"| {assessed.overhead:.1%} | {assessed.lost:.2%} | {late} |",
        flush=True,
    )
