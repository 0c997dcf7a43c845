"""Measure the glass latency of the console: from a frame's stamp until it is in the frame buffer of the screen.

`lavt drive` runs with a display of Xvfb. Its page in Chromium and a floor, a minimal client in Python
(`benchmarks/pages/window_page.py`), show the same access units side by side on the same screen. This program reads both
places of the frame buffer every 0.5 ms, and notes when the stamp of each frame first appears there. All clocks are that
of this machine. The goal is a median of at most 1.15 times that of the floor.

    python benchmarks/glass_latency.py [--seconds 30] [--rounds 3] [--fit]

Both show the pictures in the same size: that of the page in its window or, with `--fit`, that of the video, so that
nothing is scaled. Prints the median and P95 (ms) of each round, and the ratios of the medians.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the packages `benchmarks` and `tests`

from benchmarks.pages.frame_buffer import FrameBuffer, Place, running_xvfb
from benchmarks.quiet import Quiet
from tests.browser.chromium import ProtocolError, Tab, running_browser, wait_until

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S, NS_PER_US
from lavt.errors import WorkError
from lavt.experiment.runs.processes import Processes
from lavt.recording.record import read_record

REPOSITORY = Path(__file__).parents[1]
GOAL = 1.15
SCREEN_PX = (1800, 900)
FLOOR_AT_PX = (1100, 30)
VIDEO_PX = (640, 480)
POLL_NS = 500 * NS_PER_US
SETTLE_NS = NS_PER_S
MAX_AGE_NS = 2 * NS_PER_S
FIT = """(() => {
  const style = "position: fixed; left: 0; top: 0; width: 640px; height: 480px; z-index: 9";
  document.querySelector("#picture").style = style;
})()"""
PLACE = """(() => {
  const canvas = document.querySelector("#picture");
  const box = canvas.getBoundingClientRect();
  const scale = Math.min(box.width / canvas.width, box.height / canvas.height);
  const left = screenX + (outerWidth - innerWidth) / 2 + box.left + (box.width - scale * canvas.width) / 2;
  const top = screenY + outerHeight - innerHeight + box.top + (box.height - scale * canvas.height) / 2;
  return [left, top, scale];
})()"""


def main() -> None:
    """Measure, and print the table and the ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--set", action="append", default=["vehicle.scenery=none"], dest="settings")
    arguments = parser.parse_args()
    quiet, ratios = Quiet(), []
    sys.stdout.write("| round | page: median, P95 (ms) | floor: median, P95 (ms) | ratio of medians | pairs |\n")
    sys.stdout.write("|---|---|---|---|---|\n")
    for number in range(arguments.rounds):
        page_ms, floor_ms = measure(arguments.settings, arguments.seconds, fits=arguments.fit)
        ratios.append(float(np.median(page_ms) / np.median(floor_ms)))
        cells = [f"{np.median(values):.1f}, {np.percentile(values, 95):.1f}" for values in (page_ms, floor_ms)]
        sys.stdout.write(f"| {number + 1} | {' | '.join(cells)} | {ratios[-1]:.2f} | {len(page_ms)} |\n")
        sys.stdout.flush()
    ratio = float(np.median(ratios))
    verdict = "met" if ratio <= GOAL else "missed"
    sys.stdout.write(f"median of the ratios {ratio:.2f}, goal {GOAL} {verdict}; {quiet.sentence()}\n")
    sys.stdout.write(json.dumps({"ratios": ratios, "ratio": ratio}) + "\n")


def measure(settings: list[str], duration_s: float, *, fits: bool) -> tuple[Any, Any]:
    """Return the latencies (ms) of the frames that both have shown: those of the page and those of the floor."""
    with tempfile.TemporaryDirectory() as name, Processes(Path(name)) as processes:
        directory = Path(name)
        options = [option for setting in settings for option in ("--set", setting)]
        drive = processes.start("drive", "drive", "--no-browser", "--out", str(directory / "out"), *options)
        url = drive.wait_ready()["ready"]["console"]
        with (
            running_xvfb(directory, *SCREEN_PX) as screen,
            running_browser(directory / "profile", screen.display) as browser,
        ):
            tab = browser.open(url)
            wait_until("the page shows the video", lambda: shown(tab) > 0)
            if fits:
                tab.evaluate(FIT)
            place = Place(*tab.evaluate(PLACE))
            places = {"page": place, "floor": Place(*FLOOR_AT_PX, place.scale)}
            with running_floor(url, screen.display, place.scale):
                wait_until("the floor shows the video", lambda: bool(screen.read_stamp(places["floor"])))
                pause(SETTLE_NS)
                seen = watch(screen, places, duration_s)
        drive.end()
        stamps = set(read_record(directory / "out" / "server" / "server.mcap").table("frame").ints("stamp_ns").tolist())
    if not seen["page"] or not seen["floor"]:
        raise WorkError("the stamps could not be read from the screen")
    both = sorted(stamps & seen["page"].keys() & seen["floor"].keys())
    page, floor = (np.array([seen[name][stamp] - stamp for stamp in both]) / NS_PER_MS for name in ("page", "floor"))
    return page, floor


def shown(tab: Tab) -> int:
    """Return how many pictures the page has shown."""
    try:
        return int(tab.evaluate("globalThis.lavtConsole?.video.shown ?? 0"))
    except ProtocolError:
        return 0


@contextmanager
def running_floor(url: str, display: str, scale: float) -> Iterator[None]:
    """Run the minimal client during the `with` block; `scale` is the size of the video's pixels on the screen."""
    size_px = [round(scale * length) for length in VIDEO_PX]
    floor = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.pages.window_page", url, *map(str, [*FLOOR_AT_PX, *size_px])],
        cwd=REPOSITORY,
        env={**os.environ, "DISPLAY": display, "PYTHONPATH": f"{REPOSITORY / 'src'}{os.pathsep}{REPOSITORY}"},
    )
    try:
        yield
    finally:
        floor.kill()
        floor.wait()


def watch(screen: FrameBuffer, places: Mapping[str, Place], duration_s: float) -> dict[str, dict[int, int]]:
    """Return, for each place and each stamp that was read there, when it was first seen (wall clock, ns)."""
    clock = MachineClock()
    seen: dict[str, dict[int, int]] = {name: {} for name in places}
    limit_ns = clock.now().mono_ns + round(duration_s * NS_PER_S)
    while clock.now().mono_ns < limit_ns:
        for name, place in places.items():
            stamp, now_ns = screen.read_stamp(place), clock.now().wall_ns
            if stamp is not None and 0 < now_ns - stamp < MAX_AGE_NS:
                seen[name].setdefault(stamp, now_ns)
        pause(POLL_NS)
    return seen


if __name__ == "__main__":
    main()
