"""What perception's confidence is worth, what it costs, and how its steps look: the figures of docs/perception.md.

    python -m benchmarks.perception_sheet [--count 25] [--picture docs/pictures/perception.jpg]

Prints two tables over degraded pictures (`benchmarks/degraded.py`), by kind of picture and by confidence, each with
the detector searching (the picture is its first) and following (it saw the road as it is before).
Then the cost of a picture.
"""

from __future__ import annotations

import argparse
import time  # noqa: TID251 (costs are CPU time, which clock.py does not give)
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from benchmarks.degraded import AHEAD_M, MODEL, NO_LANE, Case, cases

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.domain import FloatArray, Lane, Picture
from lavt.perception.calibration import calibrated
from lavt.perception.lane_detector import LaneDetector
from lavt.perception.panel import panel

WRONG_M = 0.5
"""A lane whose centre is farther off 10 m ahead is wrong."""
BINS = (0.0, 0.05, 0.2, 0.3, 0.4, 0.6, 0.8, 1.001)
UNDECIDED = "yellow diversion"
"""Its truth is a matter of opinion, so it is not in the table by confidence."""
SHOWN = ("as it is", "h264 200 kbit/s", "tree shadows", "old yellow line", "glare", "coarse blocks")


@dataclass(frozen=True, slots=True)
class Judged:
    """One lane given for one picture."""

    kind: str
    confidence: float
    error_m: FloatArray
    """Of the centre at `AHEAD_M`; infinite where there is no lane to be seen."""

    @property
    def wrong(self) -> bool:
        """Whether nobody should drive by it."""
        return bool(self.error_m[1] > WRONG_M)

    @property
    def believed(self) -> bool:
        """Whether the car would be driven by it."""
        return self.confidence >= LANE_CONFIDENCE


def judge(case: Case, lane: Lane) -> Judged:
    """Compare a lane with the truth."""
    if case.centre_m is None:
        return Judged(case.kind, lane.confidence, np.full(len(AHEAD_M), np.inf))
    return Judged(case.kind, lane.confidence, np.abs(np.polyval(lane.centre[::-1], AHEAD_M) - case.centre_m))


def look(case: Case) -> tuple[Judged, Judged]:
    """Give what a search makes of a picture, and what following the lane seen before makes of it."""
    searching, following = LaneDetector(MODEL), LaneDetector(MODEL)
    following.detect(case.before)
    return judge(case, searching.detect(case.picture)), judge(case, following.detect(case.picture))


def kinds_table(found: Iterable[tuple[Judged, Judged]]) -> str:
    """Write the table by kind: confidence, error, and how often it is wrong and believed, or right and not."""
    by_kind = defaultdict(list)
    for pair in found:
        by_kind[pair[0].kind].append(pair)
    lines = [
        "| picture | searching: confidence p5, median | error at 10 m, p95 of believed | wrong and believed "
        "| right and not believed | following: confidence p5, median | error | wrong and believed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind, pairs in by_kind.items():
        cells = [kind + (" (no lane there)" if kind in NO_LANE else "")]
        for number, side in enumerate(zip(*pairs, strict=True)):
            share = [judged.confidence for judged in side]
            believed = [judged.error_m[1] for judged in side if judged.believed and np.isfinite(judged.error_m[1])]
            cells.append(f"{np.percentile(share, 5):.2f}, {np.median(share):.2f}")
            cells.append(f"{np.percentile(believed, 95):.2f} m" if believed else "")
            cells.append(str(sum(judged.wrong and judged.believed for judged in side)))
            if number == 0:
                cells.append(str(sum(not judged.wrong and not judged.believed for judged in side)))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def reliability_table(found: Iterable[Judged]) -> str:
    """Write the table by confidence: share that is wrong, and median and p95 of the error at each distance."""
    kept = [judged for judged in found if judged.kind != UNDECIDED]
    heads = " | ".join(f"{ahead:.0f} m: median, p95" for ahead in AHEAD_M)
    lines = [f"| confidence | pictures | wrong | {heads} |", "|---|---|---|" + "---|" * len(AHEAD_M)]
    for low, high in pairwise(BINS):
        within = [judged for judged in kept if low <= judged.confidence < high]
        if not within:
            continue
        errors = np.array([judged.error_m for judged in within])
        cells = []
        for column in errors.T:
            median, p95 = np.median(column), np.percentile(column, 95, method="nearest")
            cells.append(", ".join(f"{each:.2f} m" if np.isfinite(each) else "no lane there" for each in (median, p95)))
        wrong = sum(judged.wrong for judged in within)
        label = f"{low:.2f} to {min(high, 1):.2f}"
        lines.append(f"| {label} | {len(within)} | {100 * wrong / len(within):.1f} % | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def cost_ms(pictures: Iterable[Picture]) -> tuple[float, float]:
    """Give median CPU time of a picture, following and searching, in milliseconds."""
    detector = LaneDetector(MODEL)
    spent: tuple[list[float], list[float]] = ([], [])
    for picture in pictures:
        detector.forget()
        for number in range(10):
            begin_s = time.process_time()
            detector.detect(picture)
            spent[number == 0].append(time.process_time() - begin_s)
    return 1e3 * float(np.median(spent[0])), 1e3 * float(np.median(spent[1]))


def sheet(chosen: Iterable[Case]) -> Picture:
    """Draw all steps of a picture of each kind below one another, with the kind's name above."""
    rows = []
    for case in chosen:
        detector = LaneDetector(MODEL)
        drawn = panel(calibrated(MODEL), detector, case.picture)
        title = np.full((34, drawn.shape[1], 3), 90, dtype=np.uint8)
        cv2.putText(title, case.kind, (10, 25), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2, cv2.LINE_AA)
        rows += [title, drawn]
    return np.vstack(rows)


def main() -> None:
    """Measure, print, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=25, help="pictures of each kind")
    parser.add_argument("--routes", nargs="+", default=["a_key"])
    parser.add_argument("--picture", type=Path, default=None)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    found, plain = [], []
    first: dict[str, Case] = {}
    for case in cases(arguments.count, routes=tuple(arguments.routes)):
        found.append(look(case))
        first.setdefault(case.kind, case)
        if case.kind in {"as it is", "solid lines"}:
            plain.append(case.picture)
    print(kinds_table(found))
    for name, number in (("searching", 0), ("following", 1)):
        each = [pair[number] for pair in found]
        counted = [judged for judged in each if judged.kind != UNDECIDED]
        lies = sum(judged.wrong and judged.believed for judged in counted)
        print(f"\n{name}: {lies} of {len(counted)} pictures are wrong and believed\n\n{reliability_table(each)}")
    following_ms, searching_ms = cost_ms(plain)
    print(
        f"\ncost of a picture: following {following_ms:.2f} ms, searching {searching_ms:.2f} ms of CPU time (medians)"
    )
    if arguments.picture is not None:
        arguments.picture.parent.mkdir(parents=True, exist_ok=True)
        drawn = sheet(first[kind] for kind in SHOWN)
        half = cv2.resize(drawn, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(arguments.picture), half, [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
