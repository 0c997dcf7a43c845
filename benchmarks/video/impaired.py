"""The impaired part: which frames are shown and which are damaged, on a link that delays, reorders and loses."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import av
import numpy as np
from benchmarks.video.clean import SIZES
from benchmarks.video.floor import plain_decoder
from benchmarks.video.pictures import picture_of, planes_loop, squared_error
from benchmarks.video.relay import Case
from benchmarks.video.run import Run, load_units
from benchmarks.video.sides import WARM_UP_FRAMES, Outcome, measure

from lavt.errors import WorkError

CASES = (
    Case("reorder", jitter_ms=8),
    Case("loss1", loss=0.01),
    Case("loss5", loss=0.05),
    Case("burst1", loss=0.01, burst_packets=3),
    Case("burst5", loss=0.05, burst_packets=3),
)
GSTREAMER_JITTER_MS = {"reorder": (30,), "loss1": (0, 30), "loss5": (0, 30), "burst1": (30,), "burst5": (30,)}
"""Its jitter buffers; the best result counts."""
DAMAGED_DB = 2.0
"""A picture so far below the loss-free one is damaged."""


@dataclass(frozen=True)
class Judged:
    """A run and what its pictures were worth."""

    outcome: Outcome
    undamaged: float
    """Share of the frames that were shown, and no more than 2 dB below the loss-free decode."""

    @property
    def overhead(self) -> float:
        """Bytes of repair packets as a share of those of the video."""
        relayed = self.outcome.relayed
        return float(relayed.get("repair_bytes", 0) / relayed["media_bytes"])

    @property
    def lost(self) -> float:
        """Share of the packets that the link lost."""
        relayed = self.outcome.relayed
        sent = relayed["media_packets"] + relayed.get("repair_packets", 0)
        return float((relayed["media_lost"] + relayed.get("repair_lost", 0)) / sent)


def psnr_db(mean_squared_error: float) -> float:
    """Peak signal to noise ratio of 8-bit luma."""
    return math.inf if mean_squared_error <= 0 else 10 * math.log10(255**2 / mean_squared_error)


def loss_free_errors(run: Run) -> list[float]:
    """Decode the very stream that was sent, all of it, and give the error of each frame's luma to what was filmed."""
    decoder, filmed, numbers = plain_decoder(), planes_loop(run.loop), run.table()[:, 1]
    errors = []
    for place, unit in enumerate(load_units(run)):
        frames = decoder.decode(av.Packet(unit))
        if len(frames) != 1:
            raise WorkError(f"access unit {place} of a run gave {len(frames)} pictures: the benchmark cannot judge it")
        plane = frames[0].planes[0]
        luma = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)  # type: ignore[call-overload]
        errors.append(squared_error(luma[: run.height_px, : run.width_px], picture_of(filmed, int(numbers[place]))))
    if len(errors) != run.frames:
        raise WorkError(f"{len(errors)} access units of {run.frames} frames: the benchmark cannot judge them")
    return errors


def undamaged_share(received: dict[int, float], loss_free: Sequence[float]) -> float:
    """Share of the frames after the warm-up whose picture came, and came well; both are errors by place."""
    good = sum(
        place in received and psnr_db(received[place]) >= psnr_db(loss_free[place]) - DAMAGED_DB
        for place in range(WARM_UP_FRAMES, len(loss_free))
    )
    return good / (len(loss_free) - WARM_UP_FRAMES)


def impaired_part(folder: Path, case: Case, *, frames: int) -> dict[str, float]:
    """Measure a case, print its rows, and give what the last line says of it: nothing of bursts."""
    size = SIZES[0]
    run = Run(str(folder), size.width_px, size.height_px, size.bit_rate_bps, WARM_UP_FRAMES + frames, keep=True)
    law = f"loss {case.loss:.0%}" if case.loss else f"U(0, {case.jitter_ms:g}) ms, reordering"
    bursts = f", bursts of {case.burst_packets:g} packets" if case.burst_packets else ""
    print(f"\n## {case.name}: {size.name}, 20 ms each way, {law}{bursts}, {frames} frames\n")
    print("| run | median ms | p95 ms | shown | undamaged | overhead | lost | link late by, p99 / longest ms |")
    print("|---|---|---|---|---|---|---|---|")
    ours = _judged("ours", run, case)
    _print_row("ours", ours)
    theirs = []
    for jitter_ms in GSTREAMER_JITTER_MS[case.name]:
        theirs.append(_judged("gstreamer", replace(run, jitter_ms=jitter_ms), case))
        _print_row(f"GStreamer, jitter buffer {jitter_ms} ms", theirs[-1])
    if not case.loss:
        return {"shown": round(ours.outcome.shown, 4)}
    if case.burst_packets:
        return {}
    return {
        "undamaged": round(ours.undamaged, 4),
        "overhead": round(ours.overhead, 4),
        "gstreamer_undamaged": round(max(each.undamaged for each in theirs), 4),
    }


def _judged(side: str, run: Run, case: Case) -> Judged:
    outcome = measure("ours" if side == "ours" else "gstreamer", run, (case.told(),))
    print(f"  {case.name}: {side} done, {outcome.counts}", file=sys.stderr)
    return Judged(outcome, undamaged_share(outcome.errors, loss_free_errors(run)))


def _print_row(name: str, judged: Judged) -> None:
    outcome = judged.outcome
    late = f"{outcome.relayed['late_p99_ms']:.1f} / {outcome.relayed['late_max_ms']:.1f}"
    print(
        f"| {name} | {outcome.median_ms:.1f} | {outcome.p95_ms:.1f} | {outcome.shown:.2%} | {judged.undamaged:.2%} "
        f"| {judged.overhead:.1%} | {judged.lost:.2%} | {late} |",
        flush=True,
    )
