"""Tests of the console's page in a real Chromium, with the real programs behind it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.browser.chromium import PACKAGES, Browser, ProtocolError, Tab, is_missing, running_browser, wait_until
from tests.browser.firefox import FirefoxTab
from tests.require import need

from lavt.experiment.runs.processes import Process, Processes

AnyTab = Tab | FirefoxTab
HERE = Path(__file__).parent
TIMEOUT_S = 300
SETTINGS = ("vehicle.scenery=none", "camera.width_px=320", "camera.height_px=240")
"""Settings of a drive that leave processor time for a browser."""
ATTEMPTS = 8
NEW_INPUT_US = 300_000
"""A hand that the client sees this long after a time is of an input since then: an older one counts for 200 ms."""
REPEAT_KEYS = """(() => {
  const {keyboard} = lavtConsole;
  const advance = keyboard.advance;
  let newest = null;
  addEventListener("keydown", ({isTrusted, code}) => { if (isTrusted) newest = code; }, true);
  addEventListener("keyup", ({code}) => { if (code === newest) newest = null; }, true);
  keyboard.advance = (step_s) => {
    if (newest !== null) dispatchEvent(new KeyboardEvent("keydown", {code: newest, repeat: true, cancelable: true}));
    advance.call(keyboard, step_s);
  };
})()"""
"""Repeats the key that was pressed last, as a display server does, and the protocol of Chromium does not.

It does so before the page looks whether keys repeat: a page that was stopped has the repeats that came meanwhile."""


WATCH_PICTURES = """(() => {
  globalThis.pictures = {drawn: 0, reported: 0, overdrawn: 0};
  const drawn_us = [];
  const send = WebSocket.prototype.send;
  WebSocket.prototype.send = function (data) {
    const message = JSON.parse(data);
    if (message.type === "ack") {
      pictures.drawn += 1;
      drawn_us.push(Math.round((performance.timeOrigin + performance.now()) * 1000));
    }
    if (message.type === "shown") {
      pictures.reported += 1;
      pictures.overdrawn += drawn_us.some((newer_us) => message.drawn_us < newer_us && newer_us < message.shown_us);
    }
    send.call(this, data);
  };
})()"""
"""Counts the pictures that the page draws, those that it reports as shown, and those of them that were drawn over."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.timeout(TIMEOUT_S))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    if is_missing():
        need("chromium", f"needs Chromium: apt-get install {' '.join(PACKAGES)}")


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with running_browser(tmp_path_factory.mktemp("chromium")) as browser:
        yield browser


class PersonDrive:
    """A running `lavt drive`, with the pages that a test opens."""

    def __init__(self, process: Process, url: str, browser: Browser, out: Path) -> None:
        self.process = process
        self.url = url
        self.out = out
        self._browser = browser
        self._tabs: list[Tab] = []

    def open(self, browser: Browser | None = None) -> Tab:
        """Open a page in a new tab, also of another browser, and wait until it shows a state of the vehicle."""
        tab = (browser or self._browser).open(self.url)
        if browser is None:
            self._tabs.append(tab)
        wait_until("the page has a status", lambda: (status(tab) or {}).get("safety") not in (None, ""))
        repeat_keys(tab)
        return tab

    def close(self) -> None:
        """Close all pages."""
        while self._tabs:
            self._browser.close_tab(self._tabs.pop())


@pytest.fixture
def person_drive(browser: Browser, tmp_path: Path) -> Iterator[PersonDrive]:
    with Processes(tmp_path) as processes:
        settings = [option for setting in SETTINGS for option in ("--set", setting)]
        process = processes.start("drive", "drive", "--no-browser", "--out", str(tmp_path / "out"), *settings)
        drive = PersonDrive(process, process.wait_ready()["ready"]["console"], browser, tmp_path / "out")
        try:
            yield drive
        finally:
            drive.close()


def repeat_keys(tab: AnyTab) -> None:
    """Let the page get repeats of the key that was pressed last."""
    tab.evaluate(REPEAT_KEYS)


def plug_gamepad(tab: Tab, *, is_held: bool, index: int = 0) -> None:
    """Connect a fake gamepad that the browser knows, and let the page read it; its dead-man button is held or not."""
    values = [float(is_held and button == 5) for button in range(17)]
    tab.evaluate(
        f"globalThis.pad = {{id: 'pad', mapping: 'standard', axes: [0, 0, 0, 0], connected: true, index: {index},"
        f" buttons: {values}.map((value) => ({{value}}))}}; navigator.getGamepads = () => [pad];"
        "new Promise((resolve) => setTimeout(resolve, 200))"
    )


def unplug_gamepads(tab: Tab) -> None:
    """Disconnect all gamepads, and let the page see it."""
    tab.evaluate("navigator.getGamepads = () => []; new Promise((resolve) => setTimeout(resolve, 200))")


def status(tab: AnyTab) -> dict[str, Any] | None:
    """Return the newest status that the page has received; None while it is not loaded or not connected."""
    try:
        result: dict[str, Any] | None = tab.evaluate("globalThis.lavtConsole?.status ?? null")
    except ProtocolError:
        return None
    return result


def field(tab: AnyTab, name: str) -> Any:
    """Return one value of the page's newest status; None while it is not connected."""
    return (status(tab) or {}).get(name)


def watch_pictures(tab: AnyTab) -> None:
    """Let the page count from now on what becomes of its pictures, for `pictures`."""
    tab.evaluate(WATCH_PICTURES)


def pictures(tab: AnyTab, name: str) -> int:
    """Return how many pictures the page has "drawn", "reported" as shown, or reported although "overdrawn" before."""
    return int(tab.evaluate(f"pictures.{name}"))


def drive_until(
    tab: AnyTab, hold: Callable[[], None], release_all: Callable[[], None], condition: Callable[[], bool]
) -> None:
    """Arm by `hold` and wait until `condition()`; if the vehicle stops before, release and try again.

    On a busy machine the browser pauses for longer than the latch of the dead-man control allows.
    """
    for _ in range(ATTEMPTS):
        wait_until("the vehicle can be armed", lambda: field(tab, "hand") == "open" and field(tab, "phase") == "arming")
        hold()
        wait_until("the hand holds, or is lost", lambda: field(tab, "hand") != "open")
        wait_until("the car drives, or has stopped", lambda: condition() or field(tab, "hand") != "held")
        if condition():
            return
        release_all()
    pytest.fail(f"the car did not drive in {ATTEMPTS} attempts")


def commands_acceleration_to_the_left(tab: Tab) -> bool:
    """Return whether the last command has much throttle, and steers to the left."""
    steering_rad, throttle, _ = field(tab, "command") or (0, 0, 0)
    return bool(steering_rad > 0.1 and throttle > 0.9)


def wait_until_open(tab: Tab) -> None:
    """Wait until the client sees an open hand in inputs that the page sends from now on; fail if the hand holds.

    If the page or the client pauses, the client sees no input for a moment.
    """
    since_us = field(tab, "sent_us")

    def is_open() -> bool:
        newest = status(tab) or {}
        assert newest.get("hand") != "held"
        return newest.get("hand") == "open" and newest["sent_us"] > since_us + NEW_INPUT_US

    wait_until("the hand is seen open", is_open)
    assert field(tab, "safety") == "safe_stop"


def press(tab: AnyTab, *codes: str) -> None:
    """Press keys, with the pointer over the page."""
    tab.point()
    for code in codes:
        tab.key(code, down=True)


def release(tab: AnyTab, *codes: str) -> None:
    """Release keys."""
    for code in codes:
        tab.key(code, down=False)


def arm(tab: AnyTab) -> None:
    """Hold the space bar until the vehicle is driving."""
    drive_until(
        tab, lambda: press(tab, "Space"), lambda: release(tab, "Space"), lambda: field(tab, "safety") == "driving"
    )


def drive_off(tab: AnyTab, *, until: Callable[[], bool] = lambda: True) -> None:
    """Arm, accelerate to 2 m/s, and drive until a condition is true."""

    def accelerates() -> bool:
        if field(tab, "safety") == "driving":
            press(tab, "ArrowUp")
        return (field(tab, "speed_mps") or 0) > 2 and until()

    drive_until(tab, lambda: press(tab, "Space"), lambda: release(tab, "ArrowUp", "Space"), accelerates)
