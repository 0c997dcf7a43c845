"""Measure how reliable perception's confidence is and what a picture costs: the figures of docs/perception.md.

    python -m benchmarks.perception_sheet [--count 25] [--picture docs/pictures/perception.jpg]

The output has two tables over degraded pictures (`benchmarks/degraded.py`), one by kind of picture and one by
confidence, and then the cost of a picture. Each picture is shown to two detectors: to a searching one, which has seen
no picture before, and to a tracking one, which has seen the unchanged road from the same place before.
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
from benchmarks.degraded import AHEAD_M, MODEL, NO_LANE, DegradedCase, cases

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.domain import FloatArray, Lane, Picture
from lavt.perception.calibration import calibrated
from lavt.perception.lane_detector import LaneDetector
from lavt.perception.panel import draw_panel

ERROR_LIMIT_M = 0.5
"""A lane is wrong if its centre is off by more than this at 10 m."""
CONFIDENCE_BINS = (0.0, 0.05, 0.2, 0.3, 0.4, 0.6, 0.8, 1.001)
UNDECIDED = "yellow diversion"
"""The kind of picture whose true lane is ambiguous; it is excluded from the table by confidence."""
PICTURED_KINDS = ("as it is", "h264 200 kbit/s", "tree shadows", "old yellow line", "glare", "coarse blocks")


@dataclass(frozen=True, slots=True)
class LaneVerdict:
    """The comparison of a detected lane with the truth."""

    kind: str
    confidence: float
    error_m: FloatArray
    """Errors of the centre at `AHEAD_M`; infinite if no lane is visible."""

    @property
    def wrong(self) -> bool:
        """Whether the lane is too far off to be followed."""
        return bool(self.error_m[1] > ERROR_LIMIT_M)

    @property
    def believed(self) -> bool:
        """Whether the controller would accept the lane and follow it."""
        return self.confidence >= LANE_CONFIDENCE


def check_lane(case: DegradedCase, lane: Lane) -> LaneVerdict:
    """Compare a lane with the truth."""
    if case.centre_m is None:
        return LaneVerdict(case.kind, lane.confidence, np.full(len(AHEAD_M), np.inf))
    return LaneVerdict(case.kind, lane.confidence, np.abs(np.polyval(lane.centre[::-1], AHEAD_M) - case.centre_m))


def check_case(case: DegradedCase) -> tuple[LaneVerdict, LaneVerdict]:
    """Return the verdicts on a picture for a searching and a tracking detector."""
    searching, tracking = LaneDetector(MODEL), LaneDetector(MODEL)
    tracking.detect(case.before)
    return check_lane(case, searching.detect(case.picture)), check_lane(case, tracking.detect(case.picture))


def kinds_table(verdicts: Iterable[tuple[LaneVerdict, LaneVerdict]]) -> str:
    """Return the table by kind: confidence, error, and the numbers of wrong accepted and right rejected lanes."""
    by_kind = defaultdict(list)
    for pair in verdicts:
        by_kind[pair[0].kind].append(pair)
    lines = [
        "| picture | searching: confidence p5, median | searching: error at 10 m, p95 of accepted "
        "| searching: wrong and accepted | searching: right and not accepted | tracking: confidence p5, median "
        "| tracking: error at 10 m, p95 of accepted | tracking: wrong and accepted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind, pairs in by_kind.items():
        cells = [kind + (" (no lane there)" if kind in NO_LANE else "")]
        for is_tracking, of_detector in enumerate(zip(*pairs, strict=True)):
            confidences = [verdict.confidence for verdict in of_detector]
            errors_m = [verdict.error_m[1] for verdict in of_detector if verdict.believed]
            errors_m = [error_m for error_m in errors_m if np.isfinite(error_m)]
            cells.append(f"{np.percentile(confidences, 5):.2f}, {np.median(confidences):.2f}")
            cells.append(f"{np.percentile(errors_m, 95):.2f} m" if errors_m else "")
            cells.append(str(sum(verdict.wrong and verdict.believed for verdict in of_detector)))
            if not is_tracking:
                cells.append(str(sum(not verdict.wrong and not verdict.believed for verdict in of_detector)))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def reliability_table(verdicts: Iterable[LaneVerdict]) -> str:
    """Return the table by confidence: share of wrong lanes, and median and P95 of the error at each distance."""
    decided = [verdict for verdict in verdicts if verdict.kind != UNDECIDED]
    heads = " | ".join(f"{ahead:.0f} m: median, p95" for ahead in AHEAD_M)
    lines = [f"| confidence | pictures | wrong | {heads} |", "|---|---|---|" + "---|" * len(AHEAD_M)]
    for low, high in pairwise(CONFIDENCE_BINS):
        within = [verdict for verdict in decided if low <= verdict.confidence < high]
        if not within:
            continue
        errors = np.array([verdict.error_m for verdict in within])
        cells = []
        for column in errors.T:
            median, p95 = np.median(column), np.percentile(column, 95, method="nearest")
            cells.append(", ".join(f"{m:.2f} m" if np.isfinite(m) else "no lane there" for m in (median, p95)))
        wrong = sum(verdict.wrong for verdict in within)
        label = f"{low:.2f} to {min(high, 1):.2f}"
        lines.append(f"| {label} | {len(within)} | {100 * wrong / len(within):.1f} % | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def cost_ms(pictures: Iterable[Picture]) -> tuple[float, float]:
    """Return the median CPU time of a picture in milliseconds, for tracking and for searching."""
    detector = LaneDetector(MODEL)
    tracking_s: list[float] = []
    searching_s: list[float] = []
    for picture in pictures:
        detector.forget()
        for number in range(10):
            begin_s = time.process_time()
            detector.detect(picture)
            (tracking_s if number else searching_s).append(time.process_time() - begin_s)
    return 1e3 * float(np.median(tracking_s)), 1e3 * float(np.median(searching_s))


def draw_sheet(sheet_cases: Iterable[DegradedCase]) -> Picture:
    """Draw the steps of the detection in a picture of each kind, one below the other with titles."""
    rows = []
    for case in sheet_cases:
        detector = LaneDetector(MODEL)
        drawn = draw_panel(calibrated(MODEL), detector, case.picture)
        title = np.full((34, drawn.shape[1], 3), 90, dtype=np.uint8)
        cv2.putText(title, case.kind, (10, 25), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2, cv2.LINE_AA)
        rows += [title, drawn]
    return np.vstack(rows)


def main() -> None:
    """Measure, print the tables, and draw the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=25, help="pictures of each kind")
    parser.add_argument("--routes", nargs="+", default=["a_key"])
    parser.add_argument("--picture", type=Path, default=None)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    verdicts, undamaged = [], []
    first_cases: dict[str, DegradedCase] = {}
    for case in cases(arguments.count, routes=tuple(arguments.routes)):
        verdicts.append(check_case(case))
        first_cases.setdefault(case.kind, case)
        if case.kind in {"as it is", "solid lines"}:
            undamaged.append(case.picture)
    print(kinds_table(verdicts))
    for name, number in (("searching", 0), ("tracking", 1)):
        of_detector = [pair[number] for pair in verdicts]
        decided_verdicts = [verdict for verdict in of_detector if verdict.kind != UNDECIDED]
        harmful = sum(verdict.wrong and verdict.believed for verdict in decided_verdicts)
        print(f"\n{name}: {harmful} of {len(decided_verdicts)} pictures are wrong and accepted")
        print(f"\n{reliability_table(of_detector)}")
    tracking_ms, searching_ms = cost_ms(undamaged)
    print(f"\ncost of a picture: tracking {tracking_ms:.2f} ms, searching {searching_ms:.2f} ms of CPU time (medians)")
    if arguments.picture is not None:
        arguments.picture.parent.mkdir(parents=True, exist_ok=True)
        drawn = draw_sheet(first_cases[kind] for kind in PICTURED_KINDS)
        reduced = cv2.resize(drawn, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(arguments.picture), reduced, [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
