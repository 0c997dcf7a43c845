"""Compare LAVT's video with GStreamer's: latency and CPU time on a clean link, undamaged frames on an impaired link.

The two programs, LAVT ("ours") and GStreamer, take turns. Each sends the same pictures with stamps from one process to
another. Latency is the time between writing the stamp, just before encoding, and reading the stamp from the decoded
luma. GStreamer is measured with its best settings and, in one run for each picture size, with its usual settings.
Prints tables during the measurement, and finally one line of JSON.

    python benchmarks/video_vs_gstreamer.py [--pairs 5] [--seconds 15] [--frames 1800] [--quick] [--only 480p]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package `benchmarks`

from benchmarks.video.clean import SIZES, Size, run_clean_part
from benchmarks.video.gstreamer import load_gstreamer
from benchmarks.video.impaired import CASES, IMPAIRED_SIZE, run_impaired_part
from benchmarks.video.pictures import render_pictures

from lavt.errors import LavtError, UserError
from lavt.runtime import process_priority

QUICK = {"pairs": 1, "seconds": 1.0, "frames": 30}


def parts(requested: argparse.Namespace, folder: Path) -> dict[str, Callable[[], dict[str, float]]]:
    """Return the parts of the benchmark as functions, by their names in the line of JSON."""
    clean: dict[str, Callable[[], dict[str, float]]] = {
        size.name: partial(run_clean_part, folder, size, pairs=requested.pairs, seconds=requested.seconds)
        for size in SIZES
    }
    return clean | {case.name: partial(run_impaired_part, folder, case, frames=requested.frames) for case in CASES}


def needed_sizes(requested_parts: Sequence[str]) -> list[Size]:
    """Return the picture sizes that the parts use; parts on an impaired link use `IMPAIRED_SIZE`."""
    names = {IMPAIRED_SIZE.name if part in {case.name for case in CASES} else part for part in requested_parts}
    return [size for size in SIZES if size.name in names]


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pairs", type=int, default=5, help="runs of each program on the clean link")
    parser.add_argument("--seconds", type=float, default=15.0, help="length of each run, after a warm-up of 3 s")
    parser.add_argument("--frames", type=int, default=1800, help="frames of each run on the impaired link")
    parser.add_argument("--only", action="append", help="name of a part in the line of JSON; repeatable")
    parser.add_argument("--quick", action="store_true", help="make everything as short as possible, for a trial")
    requested = parser.parse_args(arguments)
    if requested.quick:
        for name, value in QUICK.items():
            setattr(requested, name, value)
    if requested.pairs < 1 or requested.seconds <= 0 or requested.frames < 1:
        parser.error("--pairs, --seconds and --frames must be above zero")
    return requested


def main() -> int:
    """Measure the requested parts; return 2 for a user error, for example without GStreamer, 1 for another error."""
    requested = parse_arguments()
    process_priority.raise_priority()  # as server and client do; the child processes inherit the priority
    try:
        load_gstreamer()
        with tempfile.TemporaryDirectory() as folder:
            all_parts = parts(requested, Path(folder))
            unknown = set(requested.only or ()) - all_parts.keys()
            if unknown:
                raise UserError(f"unknown part {', '.join(sorted(unknown))}: choose from {', '.join(all_parts)}")
            requested_parts = requested.only or list(all_parts)
            for size in needed_sizes(requested_parts):
                print(f"rendering the pictures of {size.name}", file=sys.stderr)
                render_pictures(Path(folder) / f"{size.width_px}x{size.height_px}", size.width_px, size.height_px)
            results = {part: measure() for part, measure in all_parts.items() if part in requested_parts}
    except LavtError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    print(json.dumps({part: values for part, values in results.items() if values}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
