"""Compare the controllers of a sweep such as `configs/compensation.yaml`: completion, tracking and ride comfort.

    python -m benchmarks.compare_controllers OUT [OUT ...]

The program reads the runs of one or more sweeps with the axis `controller.kind`, and prints rows in Markdown for each
condition, and for each value of a further axis. A drive counts as completed if it was completed in its own lane.
The last column is the p value of McNemar's exact test of paired drives, against the baseline that completes the most
drives; with equal numbers, against the one with the smallest median error. All p values of the output are corrected
together by Holm's method.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lavt.domain import NS_PER_S
from lavt.experiment.statistics.contrasts import mcnemar
from lavt.experiment.statistics.intervals import exact_interval, holm
from lavt.recording.record import read_record

BASELINES = ("lane_keeper", "scheduled_lookahead", "constant_delay", "smith", "slow_down")
FURTHER_AXIS = re.compile(r"[._](\w+)=(-?[0-9.]+)")
"""A further axis with numbers in the name of a run."""


class Drive(NamedTuple):
    """What is compared of one drive."""

    key: tuple[Any, ...]
    """Equal in the drives of a pair."""
    completed: bool
    p95_m: float
    jerk_mps3: float
    steering_rate_radps: float
    mean_speed_mps: float


def lateral_jerk_mps3(run: Path) -> float:
    """Return the RMS, weighted by time, of the change of the lateral acceleration (speed x yaw rate), at 10 Hz."""
    truth = read_record(run / "server.mcap").table("truth")
    times_s = np.asarray(truth.ints("mono_ns")) / NS_PER_S
    at_s = np.arange(times_s[0], times_s[-1], 0.1)
    heading_rad = np.interp(at_s, times_s, np.unwrap(truth.floats("heading_rad")))
    speed_mps = np.interp(at_s, times_s, truth.floats("speed_mps"))
    lateral_mps2 = speed_mps[1:] * np.diff(heading_rad) / 0.1
    return float(np.sqrt(np.mean((np.diff(lateral_mps2) / 0.1) ** 2)))


def read_drives(sweeps: Iterable[Path]) -> dict[tuple[str, str], dict[str, list[Drive]]]:
    """Return the valid drives by condition and further axes, and by controller."""
    drives: dict[tuple[str, str], dict[str, list[Drive]]] = defaultdict(lambda: defaultdict(list))
    for path in sorted(run for sweep in sweeps for run in sweep.rglob("result.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        if not result["valid"]:
            continue
        axis = FURTHER_AXIS.search(path.parent.name)
        drives[result["condition"], "" if axis is None else f"{axis[1]} {axis[2]}"][result["controller"]].append(
            Drive(
                (result["route"], result["repetition"], result["seed"]),
                bool(result["completed_in_own_lane"]),
                result["p95_m"],
                lateral_jerk_mps3(path.parent),
                result["steering_rate_rms_radps"],
                result["distance_m"] / result["duration_s"],
            )
        )
    return drives


def best_baseline(by_kind: Mapping[str, Sequence[Drive]]) -> str:
    """Return the baseline with the most completed drives, and of these the one with the smallest median error."""

    def rank(kind: str) -> tuple[int, float]:
        drives = by_kind[kind]
        return -sum(drive.completed for drive in drives), float(np.median([drive.p95_m for drive in drives]))

    return min((kind for kind in BASELINES if kind in by_kind), key=rank)


def paired_p(drives: Sequence[Drive], others: Sequence[Drive]) -> float:
    """Return McNemar's exact p value of the completion of paired drives."""
    other = {drive.key: drive.completed for drive in others}
    pairs = [(drive.completed, other[drive.key]) for drive in drives if drive.key in other]
    return mcnemar(pairs.count((True, False)), pairs.count((False, True)))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweeps", type=Path, nargs="+")
    drives = read_drives(parser.parse_args().sweeps)
    tests = {
        place: (best, paired_p(by_kind["predictive"], by_kind[best]))
        for place, by_kind in drives.items()
        if "predictive" in by_kind and any(kind in by_kind for kind in BASELINES)
        for best in [best_baseline(by_kind)]
    }
    corrected = dict(zip(tests, holm([p for _, p in tests.values()]), strict=True))
    print("| condition | controller | completed in own lane (95 %) | P95 | lateral jerk | steering rate | speed | p |")
    print("|---|---|---|---|---|---|---|---|")
    for (condition, axes), by_kind in drives.items():
        for kind in sorted(by_kind, key=lambda kind: (kind != "predictive", kind)):
            of_kind, place = by_kind[kind], (condition, axes)
            completed = sum(drive.completed for drive in of_kind)
            low, high = exact_interval(completed, len(of_kind)) or (0.0, 1.0)
            p95_m, jerk_mps3, rate_radps, speed_mps = np.median([drive[2:] for drive in of_kind], axis=0)
            test = (
                f"{corrected[place]:.2g} against {tests[place][0]}" if kind == "predictive" and place in tests else ""
            )
            cells = (
                f"{condition} {axes}",
                f"`{kind}`",
                f"{completed}/{len(of_kind)} ({100 * low:.0f} to {100 * high:.0f} %)",
                f"{p95_m:.2f} m",
                f"{jerk_mps3:.2f} m/s3",
                f"{1000 * rate_radps:.0f} mrad/s",
                f"{3.6 * speed_mps:.0f} km/h",
                test,
            )
            print("|", " | ".join(cells), "|")


if __name__ == "__main__":
    main()
