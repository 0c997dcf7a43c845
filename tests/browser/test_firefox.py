"""The console's page in a real Firefox: it decodes, sends inputs, or says that it cannot decode."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.browser.chromium import wait_until
from tests.browser.conftest import PersonDrive, field, pictures, press, release, repeat_keys, watch_pictures
from tests.browser.fake_client import FakeClient
from tests.browser.firefox import PACKAGES, PREFERENCES, FirefoxTab, is_missing, running_firefox
from tests.require import need

from lavt.recording.record import read_record

LIMIT_S = 60.0


@pytest.fixture(autouse=True)
def _needs_firefox() -> None:
    if is_missing():
        need("firefox", f"needs Firefox: apt-get install {' '.join(PACKAGES)}")


def shown(tab: FirefoxTab) -> int:
    """Return how many pictures the page has shown."""
    return int(tab.evaluate("globalThis.lavtConsole?.video.shown ?? 0"))


def test_firefox_decodes_and_reads_every_stamp(person_drive: PersonDrive, tmp_path: Path) -> None:
    """The page in Firefox shows the video, and the stamps that it reads are those that the client reads."""
    with running_firefox(tmp_path / "firefox") as tab:
        tab.navigate(person_drive.url)
        wait_until("pictures are shown", lambda: shown(tab) > 0, LIMIT_S)
        watch_pictures(tab)
        wait_until("pictures are reported", lambda: pictures(tab, "reported") > 30, LIMIT_S)
        assert field(tab, "role") == "drives"
    person_drive.process.end()
    counts = read_record(person_drive.out / "client" / "client.mcap").table("counts")
    assert max(value or 0 for value in counts.objects("page_stamps_true")) > 10
    assert not any(counts.objects("page_stamps_false"))


def test_keys_in_firefox_are_inputs(tmp_path: Path) -> None:
    """In Firefox, the space bar holds while the page has the focus, the arrow key is the throttle, and Escape stops."""
    client = FakeClient()
    try:
        with running_firefox(tmp_path / "firefox") as tab:
            tab.navigate(client.url)
            wait_until("the page sends inputs", lambda: client.inputs != [], LIMIT_S)
            client.wait_for_input("the page has the focus, and nothing is held", held=False, live=True, limit_s=LIMIT_S)
            repeat_keys(tab)
            press(tab, "Space", "ArrowUp")
            client.wait_for_input("the space bar holds", held=True, live=True, limit_s=LIMIT_S)
            wait_until("the throttle opens", lambda: client.inputs[-1].throttle > 0, LIMIT_S)
            release(tab, "ArrowUp", "Space")
            client.wait_for_input("the space bar is released", held=False, limit_s=LIMIT_S)
            press(tab, "Escape")
            wait_until("the stop arrives", lambda: client.stops > 0, LIMIT_S)
    finally:
        client.close()


def test_firefox_without_h264_says_so(person_drive: PersonDrive, tmp_path: Path) -> None:
    """A Firefox that has WebCodecs, but no decoder for the video, says so, and does not connect."""
    with running_firefox(tmp_path / "firefox", {**PREFERENCES, "media.ffmpeg.enabled": False}) as tab:
        tab.navigate(person_drive.url)
        assert tab.evaluate("'VideoDecoder' in globalThis")
        hint = "document.querySelector('#hint').textContent"
        wait_until("the page says it", lambda: "cannot decode H.264" in tab.evaluate(hint), LIMIT_S)
        assert tab.evaluate("lavtConsole.status") is None
