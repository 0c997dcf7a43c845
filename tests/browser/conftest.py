"""Tests of the console's page in a real Chromium, with the real programs behind it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.browser.chromium import PACKAGES, Browser, ProtocolError, Tab, is_missing, running_browser, wait_until
from tests.require import need

from lavt.experiment.runs.processes import Process, Processes

HERE = Path(__file__).parent
TIMEOUT_S = 300


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

    def open(self) -> Tab:
        """Open a page in a new tab, and wait until it shows a state of the vehicle."""
        tab = self._browser.open(self.url)
        self._tabs.append(tab)
        wait_until("the page has a status", lambda: (status(tab) or {}).get("safety") not in (None, ""))
        return tab

    def close(self) -> None:
        """Close all pages."""
        for tab in self._tabs:
            self._browser.close_tab(tab)


@pytest.fixture
def person_drive(browser: Browser, tmp_path: Path) -> Iterator[PersonDrive]:
    with Processes(tmp_path) as processes:
        settings = ("--set", "vehicle.scenery=none", "--set", "camera.width_px=320", "--set", "camera.height_px=240")
        process = processes.start("drive", "drive", "--no-browser", "--out", str(tmp_path / "out"), *settings)
        drive = PersonDrive(process, process.wait_ready()["ready"]["console"], browser, tmp_path / "out")
        try:
            yield drive
        finally:
            drive.close()


def status(tab: Tab) -> dict[str, Any] | None:
    """Return the newest status that the page has received; None while it is not loaded or not connected."""
    try:
        result: dict[str, Any] | None = tab.evaluate("globalThis.lavtConsole?.status ?? null")
    except ProtocolError:
        return None
    return result


def field(tab: Tab, name: str) -> Any:
    """Return one value of the page's newest status; None while it is not connected."""
    return (status(tab) or {}).get(name)


def arm(tab: Tab) -> None:
    """Hold the space bar until the vehicle is driving."""
    wait_until("the vehicle can be armed", lambda: field(tab, "hand") == "open" and field(tab, "phase") == "arming")
    tab.key("Space", down=True)
    wait_until("the vehicle is armed", lambda: field(tab, "safety") == "driving")


def drive_off(tab: Tab) -> None:
    """Arm, and accelerate to 2 m/s."""
    arm(tab)
    tab.key("ArrowUp", down=True)
    wait_until("the car drives", lambda: (field(tab, "speed_mps") or 0) > 2)
