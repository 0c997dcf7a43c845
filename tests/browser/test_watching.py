"""A page that watches the lane keeper drive: what it shows, that it commands nothing, and that it delays nothing."""

from __future__ import annotations

import json
import os
import re
import signal
import statistics
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml
from pydantic import BaseModel
from tests.browser.chromium import Browser, Tab, running_browser, wait_until
from tests.browser.conftest import field, press, release
from tests.support.stalls import BUSY_SHARE, Stalls
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin

from lavt.clock import MachineClock, pause
from lavt.config import RunConfig
from lavt.config_file import build_config
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.runs.processes import LAVT, Process, Processes
from lavt.experiment.runs.side_configs import client_config, embedded_router, server_config
from lavt.recording.record import Record, read_record
from lavt.transport.console.page_messages import PAGE_VERSION
from lavt.transport.console.site import WRONG_TOKEN

SETTINGS = ("vehicle.route=a", "vehicle.scenery=none", "camera.width_px=320", "camera.height_px=240")
COMMANDS = (
    {"type": "input", "seen_us": 0, "held": True, "live": True, "steering": 1.0, "throttle": 1.0, "brake": 0.0},
    {"type": "stop"},
    {"type": "drive"},
    {"type": "release"},
    {"type": "delay", "video_ms": 500.0, "control_ms": 500.0},
)
LANE_PIXELS = """(() => {
  const {data} = document.querySelector('#picture').getContext('2d').getImageData(0, 0, 320, 240);
  let green = 0;
  for (let i = 0; i < data.length; i += 4) green += data[i + 1] > data[i] + 60 && data[i + 1] > data[i + 2] + 40;
  return green;
})()"""
"""The number of pixels on the canvas that have the colour of the drawn lines; the road, without scenery, has none."""


@dataclass
class WatchedDrive:
    """A lane keeper that drives, with the address of the page that watches it."""

    server: Process
    client: Process
    url: str
    out: Path

    def end(self) -> tuple[Record, Record]:
        """End both sides, and return the records of server and client."""
        self.client.end()
        self.server.end()
        return tuple(read_record(self.out / side / f"{side}.mcap") for side in ("server", "client"))  # type: ignore[return-value]


@pytest.fixture
def watched_drive(tmp_path: Path) -> Iterator[WatchedDrive]:
    def start(name: str, config: BaseModel, *options: str) -> Process:
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump(config.model_dump(mode="json")))
        return processes.start(name, name, str(path), "--out", str(tmp_path / name), *options)

    run = build_config(RunConfig, {}, SETTINGS, "test")
    with Processes(tmp_path) as processes:
        server = start("server", server_config(run, 0))
        ready = server.wait_ready()["ready"]
        ports = {key: ready[key] for key in ("video_port", "probe_port")}
        router = embedded_router(dialled=[next(each for each in ready["locators"] if each.startswith("udp/"))])
        client = start("client", client_config(run, run.seed, zenoh=router, **ports), "--watch")
        yield WatchedDrive(server, client, client.wait_ready()["ready"]["console"], tmp_path)


def open_page(browser: Browser, url: str) -> Tab:
    """Open the page, and wait until it shows that the car drives."""
    tab = browser.open(url)
    wait_until("the page shows that the car drives", lambda: field(tab, "safety") == "driving", 60)
    return tab


def shown(tab: Tab, element: str) -> str:
    """Return the text of an element of the page."""
    return str(tab.evaluate(f"document.querySelector('#{element}').textContent"))


def is_hidden(tab: Tab, element: str) -> bool:
    """Return whether an element of the page is not displayed."""
    return bool(tab.evaluate(f"getComputedStyle(document.querySelector('#{element}')).display === 'none'"))


def counts_of(record: Record, name: str) -> int:
    """Return a counter of the client's nodes."""
    return max((int(value or 0) for value in record.table("counts").objects(name)), default=0)


def test_a_page_watches_the_lane_keeper(browser: Browser, watched_drive: WatchedDrive) -> None:
    """The page shows the video, the lane that was detected in each picture, and the state of the vehicle."""
    tab = open_page(browser, watched_drive.url)
    try:
        wait_until("lanes are drawn", lambda: tab.evaluate("lavtConsole.video.lanesDrawn") > 90)
        assert tab.evaluate("lavtConsole.video.errors") == 0  # also counts lanes that are drawn over other pictures
        assert tab.evaluate("lavtConsole.video.lanesDrawn / lavtConsole.video.shown") > 0.5
        wait_until("the lines are on the canvas", lambda: tab.evaluate(LANE_PIXELS) > 200)
        assert (field(tab, "role"), field(tab, "controller"), field(tab, "can_drive")) == (
            "watches",
            "lane_keeper",
            False,
        )
        assert (shown(tab, "connection"), shown(tab, "safety")) == ("this page watches lane_keeper", "driving")
        assert all(is_hidden(tab, element) for element in ("stop", "take", "release", "calibrate", "network"))
        wait_until(
            "latencies are shown", lambda: all("ms" in shown(tab, f"{name}_ms") for name in ("age", "round_trip"))
        )
    finally:
        browser.close_tab(tab)
    assert watched_drive.client.running


def test_a_watching_page_commands_nothing(browser: Browser, watched_drive: WatchedDrive) -> None:
    """Keys in the page, and all messages of a page on its own or a stranger's socket, change no command."""
    tab = open_page(browser, watched_drive.url)
    address = urlsplit(watched_drive.url)
    origin = Origin(f"http://{address.netloc}")
    hello = {"type": "hello", "version": PAGE_VERSION, "token": address.fragment}
    try:
        press(tab, "Escape", "Space", "ArrowUp", "ArrowLeft", "Digit3")
        tab.evaluate(f"for (const message of {json.dumps(COMMANDS)}) lavtConsole.send(message)")
        with connect(f"ws://{address.netloc}/socket", origin=origin, compression=None, proxy=None) as stranger:
            stranger.send(json.dumps(hello))
            for _ in range(50):
                for message in COMMANDS:
                    stranger.send(json.dumps(message))
                stranger.recv(timeout=10)
        with connect(f"ws://{address.netloc}/socket", origin=origin, compression=None, proxy=None) as guesser:
            guesser.send(json.dumps({**hello, "token": "0" * 32}))
            with pytest.raises(ConnectionClosed) as closed:
                guesser.recv(timeout=10)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == WRONG_TOKEN.code
        release(tab, "Escape", "Space", "ArrowUp", "ArrowLeft", "Digit3")
        shown_before = tab.evaluate("lavtConsole.video.shown")
        wait_until("pictures are shown", lambda: tab.evaluate("lavtConsole.video.shown") > shown_before + 30)
        assert (field(tab, "safety"), field(tab, "emergency_stop")) == ("driving", "none")
        assert shown(tab, "hint") == ""
    finally:
        browser.close_tab(tab)
    _, record = watched_drive.end()
    assert counts_of(record, "page_commands_dropped") == len(COMMANDS) * 51
    commands = record.table("control")
    assert set(commands.texts("mode")) == {"arm", "drive"}
    assert not commands.ints("emergency_stop").any()
    assert set(record.table("session").texts("operation")) == {"acquire", "release"}
    assert abs(commands.floats("steering_rad")).max() < 0.4  # the page demanded 1.0 of the full angle


def loop_ms(server: Record, since_ns: int, until_ns: int) -> list[float]:
    """Return the loop latencies of the frames whose first command the server applied in an interval."""
    admissions, frames = server.table("admission"), server.table("frame")
    stamped = dict(zip(frames.ints("stamp_ns").tolist(), frames.ints("stamped_mono_ns").tolist(), strict=True))
    found: dict[int, float] = {}
    for stamp_ns, applied_ns in zip(
        admissions.ints("stamp_ns").tolist(), admissions.ints("applied_mono_ns").tolist(), strict=True
    ):
        if stamp_ns in stamped and stamp_ns not in found and since_ns <= applied_ns <= until_ns:
            found[stamp_ns] = (applied_ns - stamped[stamp_ns]) / NS_PER_MS
    return list(found.values())


def test_a_stopped_page_does_not_delay_the_lane_keeper(
    watched_drive: WatchedDrive, tmp_path: Path, stalls: Stalls
) -> None:
    """When the page's process is stopped, the loop latency of the lane keeper stays the same, and no frame is lost."""
    clock, interval_ns = MachineClock(), 5 * NS_PER_S
    with running_browser(tmp_path / "other") as other:
        tab = open_page(other, watched_drive.url)
        wait_until("lanes are drawn", lambda: tab.evaluate("lavtConsole.video.lanesDrawn") > 30)
        began_ns = clock.now().mono_ns
        pause(interval_ns)
        shown_before = tab.evaluate("lavtConsole.video.shown")
        renderers = other.renderers()
        for renderer in renderers:
            os.kill(renderer, signal.SIGSTOP)
        stopped_ns = clock.now().mono_ns
        pause(interval_ns)
        ended_ns = clock.now().mono_ns
        for renderer in renderers:
            os.kill(renderer, signal.SIGCONT)
        wait_until("pictures are shown again", lambda: tab.evaluate("lavtConsole.video.shown") > shown_before + 30)
        assert field(tab, "safety") == "driving"
    server, client = watched_drive.end()
    assert counts_of(client, "page_units_skipped") > 100
    before, after = (
        loop_ms(server, since_ns, until_ns) for since_ns, until_ns in ((began_ns, stopped_ns), (stopped_ns, ended_ns))
    )
    with stalls.excusing_failures(began_ns, ended_ns, share=BUSY_SHARE):
        assert min(len(before), len(after)) > 0.9 * 30 * interval_ns / NS_PER_S
        assert statistics.median(after) < 1.2 * statistics.median(before) + 2


def test_a_run_can_be_watched(browser: Browser, tmp_path: Path) -> None:
    """`lavt run --watch` prints the address of the page, which shows the run."""
    arguments = [arg for setting in (*SETTINGS, "time=real") for arg in ("--set", setting)]
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, *LAVT, "run", "configs/demo.yaml", "--watch", "--no-browser", "--out", str(out), *arguments],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert process.stderr is not None
        lines: Any = iter(process.stderr.readline, "")
        url = next(match[1] for line in lines if (match := re.search(r"watch at (http://\S+)", line)))
        tab = open_page(browser, url)
        wait_until("lanes are drawn", lambda: tab.evaluate("lavtConsole.video.lanesDrawn") > 30)
        browser.close_tab(tab)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 1
    finally:
        process.kill()
        process.communicate()
