"""Measures the video path beside GStreamer's: latency and CPU time on a clean link, pictures on an impaired one.

Both sides send the same pictures with the same stamp from one process to another, in turns. Latency is from the writing
of the stamp, just before encoding, to its having been read from the decoded luma. GStreamer has its best settings, and
once its usual ones. Prints tables as it goes and, last, one line of JSON.

    python benchmarks/video_vs_gstreamer.py [--pairs 5] [--seconds 15] [--frames 1800] [--quick] [--only 480p]
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a program it finds only what is beside it

from benchmarks.video.clean import SIZES, clean_part
from benchmarks.video.gstreamer import gstreamer
from benchmarks.video.impaired import CASES, impaired_part
from benchmarks.video.pictures import render_loop

from lavt.errors import LavtError, UserError
from lavt.runtime import process_priority

QUICK = {"pairs": 1, "seconds": 4.0, "frames": 120}


def parts(requested: argparse.Namespace, folder: Path) -> dict[str, Callable[[], dict[str, float]]]:
    """Give what is measured, by its name in the last line."""
    clean: dict[str, Callable[[], dict[str, float]]] = {
        size.name: partial(clean_part, folder, size, pairs=requested.pairs, seconds=requested.seconds) for size in SIZES
    }
    return clean | {case.name: partial(impaired_part, folder, case, frames=requested.frames) for case in CASES}


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pairs", type=int, default=5, help="runs of each side on the clean link")
    parser.add_argument("--seconds", type=float, default=15.0, help="length of each of these, after a warm-up of 3 s")
    parser.add_argument("--frames", type=int, default=1800, help="of each run on the impaired link")
    parser.add_argument("--only", action="append", help="a part by its name in the last line; may be given again")
    parser.add_argument("--quick", action="store_true", help="for trying: everything as short as can be")
    requested = parser.parse_args(words)
    if requested.quick:
        for name, value in QUICK.items():
            setattr(requested, name, value)
    if requested.pairs < 1 or requested.seconds <= 0 or requested.frames < 1:
        parser.error("--pairs, --seconds and --frames must be above zero")
    return requested


def main() -> int:
    """Measure what is asked for; 2 where GStreamer is missing."""
    requested = arguments()
    process_priority.raise_priority()  # as server and client do; the processes of both sides and the relay inherit it
    try:
        gstreamer()
        with tempfile.TemporaryDirectory() as name:
            all_parts = parts(requested, Path(name))
            unknown = set(requested.only or ()) - all_parts.keys()
            if unknown:
                raise UserError(f"there is no part {', '.join(sorted(unknown))}: choose of {', '.join(all_parts)}")
            for size in SIZES:
                print(f"rendering the pictures of {size.name}", file=sys.stderr)
                render_loop(Path(name) / f"{size.width_px}x{size.height_px}", size.width_px, size.height_px)
            found = {part: measure() for part, measure in all_parts.items() if part in (requested.only or all_parts)}
    except LavtError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, UserError) else 1
    print(json.dumps({part: shares for part, shares in found.items() if shares}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
