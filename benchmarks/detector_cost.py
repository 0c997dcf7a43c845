"""Compare the CPU time of the lane detector in two versions of LAVT, alternately in one run.

    python -m benchmarks.detector_cost OTHER/src [--rounds 8]

OTHER is a working tree of the other version, such as `git worktree add OTHER COMMIT` makes. Each version has a process
of its own. In each round both get the same rendered pictures one by one, in turn: each picture first to search, then to
follow. Prints the medians, and the ratios of this version to the other one.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time  # noqa: TID251 (costs are CPU time, which clock.py does not give)
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from lavt.domain import CameraModel, FloatArray, Picture
from lavt.errors import UserError
from lavt.perception.lane_detector import LaneDetector

REPOSITORY = Path(__file__).parents[1]
FOLLOWED = 6
"""How often a picture is followed after it was searched."""
LABELS = ("searching", "following")


def rendered_pictures(count: int) -> list[Picture]:
    """Return `count` pictures of an unchanged road."""
    from benchmarks.degraded import cases  # noqa: PLC0415 (the worker of the other version does not need it)

    found = cases(count)
    return [next(found).picture for _ in range(count)]


def work(file: Path) -> None:
    """Detect the lane in one picture for each number that is read; print the seconds of searching and following."""
    cv2.setNumThreads(1)
    pictures = np.load(file)
    detector = LaneDetector(CameraModel())
    for line in sys.stdin:
        picture = pictures[int(line)]
        detector.forget()
        times_s = []
        for _ in range(1 + FOLLOWED):
            begin_s = time.process_time()
            detector.detect(picture)
            times_s.append(time.process_time() - begin_s)
        print(times_s[0], float(np.median(times_s[1:])), flush=True)


def compare(sources: Sequence[Path], pictures: Sequence[Picture], rounds: int) -> FloatArray:
    """Return CPU times in milliseconds, (versions, 2, pictures * rounds): searching and following.

    Raises `UserError` if a source directory has no LAVT.
    """
    for source in sources:
        if not (source / "lavt").is_dir():
            raise UserError(f"{source} has no package lavt: give the directory src of a working tree")
    with tempfile.TemporaryDirectory() as directory:
        file = Path(directory, "pictures.npy")
        np.save(file, np.array(pictures))
        command = [sys.executable, "-m", "benchmarks.detector_cost", "--worker", str(file)]
        workers = [
            subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                cwd=REPOSITORY,
                env=os.environ | {"PYTHONPATH": str(source.resolve())},
            )
            for source in sources
        ]
        times_ms: list[list[list[float]]] = [[] for _ in workers]
        for turn in range(rounds):
            for number in range(len(pictures)):
                # who begins alternates
                for version in sorted(range(len(workers)), reverse=bool((turn + number) % 2)):
                    worker = workers[version]
                    assert worker.stdin is not None
                    assert worker.stdout is not None
                    print(number, file=worker.stdin, flush=True)
                    times_ms[version].append([1e3 * float(part) for part in worker.stdout.readline().split()])
        for worker in workers:
            worker.communicate()
    return np.array(times_ms).transpose(0, 2, 1)


def main() -> None:
    """Print the table of both versions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, nargs="?", help="the directory src of the other version")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--pictures", type=int, default=20)
    parser.add_argument("--worker", type=Path, default=None, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker is not None:
        work(arguments.worker)
        return
    if arguments.other is None:
        parser.error("name the directory src of the other version")
    this = REPOSITORY / "src"
    times_ms = compare((this, arguments.other), rendered_pictures(arguments.pictures), arguments.rounds)
    for label, (own, other) in zip(LABELS, times_ms.transpose(1, 0, 2), strict=True):
        ratio = float(np.median(own / other))
        print(f"{label}: {np.median(own):.2f} ms, other {np.median(other):.2f} ms, ratio {ratio:.2f} (median of pairs)")


if __name__ == "__main__":
    main()
