from __future__ import annotations

import os
import signal
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel
from tests.browser.chromium import Browser, Tab, running_browser, wait_until
from tests.browser.conftest import (
    PersonDrive,
    arm,
    drive_off,
    drive_until,
    field,
    pictures,
    press,
    release,
    status,
    watch_pictures,
)

from lavt.config import RunConfig
from lavt.config_file import build_config
from lavt.experiment.analysis.metrics import measure
from lavt.experiment.runs.processes import Process, Processes
from lavt.experiment.runs.side_configs import client_config, embedded_router, server_config
from lavt.recording.record import read_record


def wait_for_standstill(tab: Tab) -> None:
    def is_stationary() -> bool:
        newest = status(tab) or {}
        return newest.get("safety") == "safe_stop" and abs(newest["speed_mps"]) < 0.05

    wait_until("the car is stationary", is_stationary)


def test_a_person_arms_drives_and_stops(person_drive: PersonDrive) -> None:
    """Holding the space bar arms, the arrow key accelerates, its release stops; the video is shown; all is timed."""
    tab = person_drive.open()
    assert field(tab, "role") == "drives"
    watch_pictures(tab)
    drive_off(tab)
    reported = pictures(tab, "reported")
    wait_until("pictures are shown", lambda: pictures(tab, "reported") > reported + 20)
    assert tab.evaluate("lavtConsole.video.errors") == 0
    wait_until("losses are measured", lambda: field(tab, "lost_share") is not None)
    assert tab.evaluate("document.querySelector('#picture').width") == 320
    tab.key("Space", down=False)
    wait_for_standstill(tab)
    person_drive.process.end()
    assert person_drive.process.popen.returncode == 0
    record = read_record(person_drive.out / "client" / "client.mcap")
    hands = set(record.table("human_input").texts("hand"))
    assert {"open", "held"} <= hands
    entry = measure(read_record(person_drive.out / "server" / "server.mcap"), record).entry
    decoded, shown = entry["page_decoded_ms"], entry["page_shown_ms"]
    assert 20 < decoded["n"] == shown["n"] <= entry["frames_sent"]
    assert decoded["p50"] + decoded["bound"] > 0
    assert decoded["p50"] <= shown["p50"] <= shown["max"]


def test_the_page_reads_every_stamp(person_drive: PersonDrive) -> None:
    """The page reads the stamps that the client reads, and the times at which it had the pictures are in order."""
    tab = person_drive.open()
    watch_pictures(tab)
    wait_until("pictures are reported", lambda: pictures(tab, "reported") > 60)
    person_drive.process.end()
    record = read_record(person_drive.out / "client" / "client.mcap")
    counts = record.table("counts")
    assert max(value or 0 for value in counts.objects("page_stamps_true")) > 30
    assert not any(counts.objects("page_stamps_false"))
    rows = record.table("page_picture")
    names = ("stamp_ns", "arrived_wall_ns", "decoded_wall_ns", "drawn_wall_ns", "shown_wall_ns")
    times = [rows.ints(name) for name in names]
    bound = rows.ints("bound_ns")
    assert (times[1] >= times[0] - bound).all()
    for before, after in pairwise(times[1:]):
        assert (after >= before).all()


def test_a_picture_that_never_appeared_has_no_times(person_drive: PersonDrive) -> None:
    """A picture over which a newer one is drawn before the browser's next picture of the screen is not recorded."""
    tab = person_drive.open()
    watch_pictures(tab)
    wait_until("pictures are reported", lambda: pictures(tab, "reported") > 0)
    tab.evaluate(
        "const next = requestAnimationFrame;"
        "window.requestAnimationFrame = (show) => setTimeout(() => next(show), 500); undefined"
    )
    drawn = pictures(tab, "drawn")
    wait_until("pictures are drawn", lambda: pictures(tab, "drawn") > drawn + 40)
    person_drive.process.end()
    assert pictures(tab, "overdrawn") == 0
    recorded = len(read_record(person_drive.out / "client" / "client.mcap").table("page_picture"))
    assert recorded > 0


def test_after_a_stop_the_person_drives_again(person_drive: PersonDrive) -> None:
    """After a safe stop, a fresh press arms the vehicle again; a key that is still held does not."""
    tab = person_drive.open()
    drive_off(tab)
    tab.key("ArrowUp", down=False)
    tab.key("Space", down=False)
    wait_for_standstill(tab)
    arm(tab)


def test_the_keys_choose_the_delay(person_drive: PersonDrive) -> None:
    """The key 3 chooses the delays of L3 while driving, and the page measures them; 0 removes them."""
    tab = person_drive.open()

    def drive_with(key: str, other: str, delay: list[int], is_measured: Callable[[float], bool]) -> None:
        """Choose a delay while driving, and drive until it is measured; a car that stops before has the other again."""

        def drives_with_delay() -> bool:
            newest = status(tab) or {}
            if newest.get("safety") != "driving":
                return False
            if newest["delay"] != delay:
                press(tab, key)  # and hold it: a key must repeat
                return False
            return newest["video_ms"] is not None and is_measured(newest["video_ms"])

        def stop() -> None:
            release(tab, key, "Space")
            press(tab, other)
            release(tab, other)

        drive_until(tab, lambda: press(tab, "Space"), stop, drives_with_delay)
        release(tab, key, "Space")
        wait_for_standstill(tab)

    drive_with("Digit3", "Digit0", [225, 0], lambda video_ms: video_ms > 225)
    drive_with("Digit0", "Digit3", [0, 0], lambda video_ms: video_ms < 200)


def test_a_hidden_page_drives_no_more(person_drive: PersonDrive, browser: Browser) -> None:
    """When another tab hides the page, the vehicle stops by itself; when it is back, only a fresh press counts."""
    tab = person_drive.open()
    drive_off(tab)
    other = browser.open("about:blank")
    wait_until("the car stops", lambda: field(tab, "safety") == "safe_stop")
    assert "newer picture" in field(tab, "reason")
    browser.close_tab(other)
    tab.to_front()
    wait_for_standstill(tab)
    wait_until("the hand is seen open", lambda: field(tab, "hand") == "open")
    arm(tab)


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_a_renderer_that_ends_or_stops_drives_no_more(
    person_drive: PersonDrive, tmp_path: Path, number: signal.Signals
) -> None:
    """When the page's process is stopped or killed, the vehicle stops by itself; another page sees it."""
    with running_browser(tmp_path / "other") as other:
        tab = person_drive.open(other)
        watching = person_drive.open()
        drive_off(tab)
        for renderer in other.renderers():
            os.kill(renderer, number)
        wait_until("the car stops", lambda: field(watching, "safety") == "safe_stop")
        assert "newer picture" in field(watching, "reason")
    wait_until("no page drives any more", lambda: bool(field(watching, "can_drive")))


def test_a_lost_canvas_drives_no_more(person_drive: PersonDrive) -> None:
    """If the canvas is lost, as after a crash of the graphics processor's process, the vehicle stops by itself."""
    tab = person_drive.open()
    drive_off(tab)
    tab.evaluate("CanvasRenderingContext2D.prototype.isContextLost = () => true; 0")
    wait_until("the car stops", lambda: field(tab, "safety") == "safe_stop")


def test_a_drive_without_a_vehicle_ends(person_drive: PersonDrive) -> None:
    """If the process of the vehicle's side is killed, `lavt drive` ends with exit code 1."""
    tab = person_drive.open()
    children = Path(f"/proc/{person_drive.process.popen.pid}/task/{person_drive.process.popen.pid}/children")
    (server,) = [int(pid) for pid in children.read_text().split()]
    os.kill(server, signal.SIGKILL)
    assert person_drive.process.popen.wait(30) == 1
    assert "vehicle's side has ended" in person_drive.process.last_message()
    wait_until("the page is not connected", lambda: tab.evaluate("lavtConsole.status") is None)


def test_a_second_page_watches_and_can_stop(person_drive: PersonDrive) -> None:
    """A second page shows the video and does not drive; its emergency stop is confirmed."""
    tab = person_drive.open()
    arm(tab)
    second = person_drive.open()
    assert field(second, "role") == "watches"
    wait_until("the second page shows the video", lambda: second.evaluate("lavtConsole.video.shown") > 0)
    second.key("Escape", down=True)
    wait_until("the stop is confirmed", lambda: field(second, "emergency_stop") == "confirmed")
    wait_until("the vehicle is in an emergency stop", lambda: field(second, "safety") == "emergency_stop")


def test_a_person_drives_the_vehicle_of_a_server(browser: Browser, tmp_path: Path) -> None:
    """`lavt client --human` drives a vehicle of a separate `lavt server`, which stops if the client is killed."""

    def start(name: str, config: BaseModel, *options: str) -> Process:
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump(config.model_dump(mode="json")))
        return processes.start(name, name, str(path), "--out", str(tmp_path / name), *options)

    run = build_config(RunConfig, {}, ["vehicle.scenery=none", "camera.width_px=320", "camera.height_px=240"], "test")
    with Processes(tmp_path) as processes:
        server = start("server", server_config(run, 0))
        ready = server.wait_ready()["ready"]
        ports = {key: ready[key] for key in ("video_port", "probe_port")}
        router = embedded_router(dialled=[next(each for each in ready["locators"] if each.startswith("udp/"))])
        client = start("client", client_config(run, run.seed, zenoh=router, **ports), "--human")
        drive = PersonDrive(client, client.wait_ready()["ready"]["console"], browser, tmp_path)
        try:
            tab = drive.open()
            assert field(tab, "delay") is None
            drive_off(tab)
            client.popen.kill()
            wait_until("the car stops", lambda: server.latest["status"]["safety"] == "safe_stop")
        finally:
            drive.close()
