"""Print the tables of docs/perception.md: how reliable the detected confidence is, and the CPU time of a picture.

    python -m benchmarks.perception_sheet [--count 25] [--picture docs/pictures/perception.jpg]

The pictures are degraded (`benchmarks/degraded.py`). One table has a row for each kind of picture. Two more tables, one
for each detector, have a row for each range of confidence. Each picture is shown to two detectors: to a searching one,
which has seen no picture before, and to a tracking one, which has seen the unchanged road from the same place.
With `--picture` the program also draws the steps of the detection.
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
from benchmarks.degraded import AHEAD_M, AT_10_M, MODEL, NO_LANE, DegradedCase, cases

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.domain import FloatArray, Lane, Picture
from lavt.perception.calibration import calibrated_pinhole_camera
from lavt.perception.lane_detector import LaneDetector
from lavt.perception.panel import draw_panel

ERROR_LIMIT_M = 0.5
"""A lane is wrong if its centre is off by more than this at 10 m."""
CONFIDENCE_BINS = (0.0, 0.05, 0.2, 0.3, 0.4, 0.6, 0.8, 1.001)
UNDECIDED = "yellow diversion"
"""The kind of picture whose true lane is ambiguous; it is excluded from the table by confidence."""
TILE_PX = (400, 300)
"""Size of a step on the drawn sheet."""
PICTURED_KINDS = ("as it is", "h264 200 kbit/s", "tree shadows", "old yellow line", "glare", "coarse blocks")
"""The kinds of pictures on the drawn sheet."""


@dataclass(frozen=True, slots=True)
class LaneVerdict:
    """The comparison of a detected lane with the truth."""

    kind: str
    confidence: float
    error_m: FloatArray
    """Errors of the lane's centre at the distances `AHEAD_M`; infinite if the picture has no lane."""

    @property
    def wrong(self) -> bool:
        """Whether the lane's centre is too far off."""
        return bool(self.error_m[AT_10_M] > ERROR_LIMIT_M)

    @property
    def accepted(self) -> bool:
        """Whether the controller would follow the lane."""
        return self.confidence >= LANE_CONFIDENCE


def check_lane(case: DegradedCase, lane: Lane) -> LaneVerdict:
    """Compare a lane with the truth."""
    if case.centre_m is None:
        return LaneVerdict(case.kind, lane.confidence, np.full(len(AHEAD_M), np.inf))
    return LaneVerdict(case.kind, lane.confidence, np.abs(np.polyval(lane.centre[::-1], AHEAD_M) - case.centre_m))


def check_case(case: DegradedCase) -> tuple[LaneVerdict, LaneVerdict]:
    """Show a picture to two detectors, and return the verdicts on the searching one and on the tracking one."""
    searching, tracking = LaneDetector(MODEL), LaneDetector(MODEL)
    tracking.detect(case.before)
    return check_lane(case, searching.detect(case.picture)), check_lane(case, tracking.detect(case.picture))


def kinds_table(verdicts: Iterable[tuple[LaneVerdict, LaneVerdict]]) -> str:
    """Return the table by kind of picture: confidence, error, and how often the acceptance of a lane was a mistake.

    Each item of `verdicts` has the searching and the tracking detector's verdict on one picture.
    """
    by_kind = defaultdict(list)
    for searching, tracking in verdicts:
        by_kind[searching.kind].append((searching, tracking))
    lines = [
        "| picture | searching: confidence p5, median | searching: error at 10 m, p95 of accepted "
        "| searching: wrong and accepted | searching: right and not accepted | tracking: confidence p5, median "
        "| tracking: error at 10 m, p95 of accepted | tracking: wrong and accepted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind, pairs in by_kind.items():
        cells = [kind + (" (no lane there)" if kind in NO_LANE else "")]
        searching_verdicts, tracking_verdicts = zip(*pairs, strict=True)
        for detector_verdicts in (searching_verdicts, tracking_verdicts):
            confidences = [verdict.confidence for verdict in detector_verdicts]
            errors_m = [verdict.error_m[AT_10_M] for verdict in detector_verdicts if verdict.accepted]
            errors_m = [error_m for error_m in errors_m if np.isfinite(error_m)]
            cells.append(f"{np.percentile(confidences, 5):.2f}, {np.median(confidences):.2f}")
            cells.append(f"{np.percentile(errors_m, 95):.2f} m" if errors_m else "")
            cells.append(str(sum(verdict.wrong and verdict.accepted for verdict in detector_verdicts)))
            if detector_verdicts is searching_verdicts:
                cells.append(str(sum(not verdict.wrong and not verdict.accepted for verdict in detector_verdicts)))
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def reliability_table(verdicts: Iterable[LaneVerdict]) -> str:
    """Return the table by confidence: share of wrong lanes, and median and P95 of the error at each distance."""
    unambiguous = [verdict for verdict in verdicts if verdict.kind != UNDECIDED]
    heads = " | ".join(f"{ahead:.0f} m: median, p95" for ahead in AHEAD_M)
    lines = [f"| confidence | pictures | wrong | {heads} |", "|---|---|---|" + "---|" * len(AHEAD_M)]
    for low, high in pairwise(CONFIDENCE_BINS):
        in_bin = [verdict for verdict in unambiguous if low <= verdict.confidence < high]
        if not in_bin:
            continue
        errors_m = np.array([verdict.error_m for verdict in in_bin])
        cells = []
        for errors_at_distance_m in errors_m.T:
            median_m = np.median(errors_at_distance_m)
            p95_m = np.percentile(errors_at_distance_m, 95, method="nearest")
            cells.append(", ".join(f"{m:.2f} m" if np.isfinite(m) else "no lane there" for m in (median_m, p95_m)))
        wrong = sum(verdict.wrong for verdict in in_bin)
        label = f"{low:.2f} to {min(high, 1):.2f}"
        lines.append(f"| {label} | {len(in_bin)} | {100 * wrong / len(in_bin):.1f} % | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def cost_ms(pictures: Iterable[Picture]) -> tuple[float, float]:
    """Return the median CPU times of a picture in milliseconds: of the tracking and of the searching detector."""
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
    """Draw the steps of the detection in each picture, one picture below the other, with titles."""
    parts = []
    for case in sheet_cases:
        detector = LaneDetector(MODEL)
        lane = detector.detect(case.picture)
        drawn = draw_panel(calibrated_pinhole_camera(MODEL), detector, case.picture, lane, TILE_PX)
        title = np.full((34, drawn.shape[1], 3), 90, dtype=np.uint8)
        cv2.putText(title, case.kind, (10, 25), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2, cv2.LINE_AA)
        parts += [title, drawn]
    return np.vstack(parts)


def main() -> None:
    """Measure, print the tables, and draw the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=25, help="pictures of each kind")
    parser.add_argument("--routes", nargs="+", default=["a_key"])
    parser.add_argument("--picture", type=Path, default=None, help="file for the drawn steps of the detection")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    verdicts, undegraded = [], []
    first_cases: dict[str, DegradedCase] = {}
    for case in cases(arguments.count, routes=tuple(arguments.routes)):
        verdicts.append(check_case(case))
        first_cases.setdefault(case.kind, case)
        if case.kind in {"as it is", "solid lines"}:
            undegraded.append(case.picture)
    print(kinds_table(verdicts))
    for detector, detector_verdicts in zip(("searching", "tracking"), zip(*verdicts, strict=True), strict=True):
        unambiguous = [verdict for verdict in detector_verdicts if verdict.kind != UNDECIDED]
        harmful = sum(verdict.wrong and verdict.accepted for verdict in unambiguous)
        print(f"\n{detector}: in {harmful} of {len(unambiguous)} pictures the lane is wrong and accepted")
        print(f"\n{reliability_table(detector_verdicts)}")
    tracking_ms, searching_ms = cost_ms(undegraded)
    print(f"\ncost of a picture: tracking {tracking_ms:.2f} ms, searching {searching_ms:.2f} ms of CPU time (medians)")
    if arguments.picture is not None:
        arguments.picture.parent.mkdir(parents=True, exist_ok=True)
        drawn = draw_sheet(first_cases[kind] for kind in PICTURED_KINDS)
        reduced = cv2.resize(drawn, None, fx=0.7, fy=0.7, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(arguments.picture), reduced, [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
