"""A whole drive by the keys of the page: one script drives in both browsers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tests.browser import firefox
from tests.browser.chromium import wait_until
from tests.browser.conftest import SETTINGS, AnyTab, PersonDrive, field, repeat_keys, status
from tests.browser.firefox import running_firefox
from tests.browser.keyboard_driver import KeyboardDriver
from tests.require import need
from tests.support.stalls import BUSY_BELOW, LONG_STALL_MS, HostStalled, Stalls

from lavt.clock import MachineClock
from lavt.experiment.analysis.metrics import measure
from lavt.recording.record import read_record

DRIVE_LIMIT_S = 240.0
LOADED_LIMIT_S = 60.0
DELAYS = {"L0": ("Digit0", [0, 0]), "L3": ("Digit3", [225, 0])}
"""For each condition, the key that chooses it, and its delays of video and control in ms."""

pytestmark = pytest.mark.timeout(600)


@contextmanager
def excusing_load(stalls: Stalls) -> Iterator[None]:
    """Excuse a drive that was interrupted on a busy machine, where a browser pauses and the page loses the hand."""
    try:
        yield
    except AssertionError as failure:
        if stalls.idle_share() > BUSY_BELOW:
            raise
        raise HostStalled(f"the machine is busy: {failure}") from None


def drive_to_the_goal(tab: AnyTab, drive: PersonDrive, condition: str, stalls: Stalls) -> None:
    """Drive the route from a page, and check that the car has reached its end in its own lane."""
    key, delays = DELAYS[condition]
    tab.point()
    tab.key(key, down=True)
    tab.key(key, down=False)
    wait_until("the delay is chosen", lambda: field(tab, "delay") == delays)
    driver, since_ns = KeyboardDriver(tab, SETTINGS), MachineClock().now().mono_ns
    with stalls.excusing_failures(since_ns, stall_ms=LONG_STALL_MS), excusing_load(stalls):
        driver.drive(DRIVE_LIMIT_S)
    drive.process.end()
    assert drive.process.popen.returncode == 0
    server, client = (read_record(drive.out / side / f"{side}.mcap") for side in ("server", "client"))
    entry = measure(server, client).entry
    with stalls.excusing_failures(since_ns, stall_ms=LONG_STALL_MS):
        assert entry["lane_invasions"] == 0
        with excusing_load(stalls):
            assert entry["ending"] == "completed", f"the page lost the hand {driver.stops} times"


def test_a_person_drives_a_route_in_chromium(person_drive: PersonDrive, stalls: Stalls) -> None:
    """From a page in Chromium, key events drive the car at L3 along the key section of route A to its end."""
    drive_to_the_goal(person_drive.open(), person_drive, "L3", stalls)


def test_a_person_drives_a_route_in_firefox(person_drive: PersonDrive, tmp_path: Path, stalls: Stalls) -> None:
    """The same script drives the same route from a page in Firefox, at L0."""
    if firefox.is_missing():
        need("firefox", f"needs Firefox: apt-get install {' '.join(firefox.PACKAGES)}")
    with running_firefox(tmp_path / "firefox") as tab:
        tab.navigate(person_drive.url)
        wait_until("the page has a status", lambda: (status(tab) or {}).get("safety") not in (None, ""), LOADED_LIMIT_S)
        repeat_keys(tab)
        drive_to_the_goal(tab, person_drive, "L0", stalls)
