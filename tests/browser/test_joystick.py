"""A joystick that a real Chromium finds and reads: axes, unplugging and plugging again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.browser.chromium import Tab, running_browser, wait_until
from tests.browser.conftest import (
    PersonDrive,
    commands_acceleration_to_the_left,
    drive_until,
    field,
    wait_until_open,
)
from tests.browser.joystick import FULL, PACKAGES, Joystick, is_missing, joystick
from tests.require import need

STEERING, UNUSED, THROTTLE, DEAD_MAN = 0, 1, 5, 5
"""Numbers of Linux: three axes, and a button."""


@pytest.fixture
def pad() -> Iterator[Joystick]:
    if is_missing():
        need("umockdev", f"needs umockdev: apt-get install {' '.join(PACKAGES)}")
    with joystick() as pad:
        yield pad


def gamepads(tab: Tab) -> list[Any]:
    """Return what the browser knows of each gamepad: the mapping, the left stick's axis and the dead-man button."""
    found: list[Any] = tab.evaluate(
        "navigator.getGamepads().filter((pad) => pad !== null)"
        ".map(({mapping, axes, buttons}) => [mapping, axes[0], buttons[5].value])"
    )
    return found


def let_time_pass(tab: Tab) -> None:
    """Let the page's own timer of 20 ms read the devices, however busy the machine is."""
    tab.evaluate("new Promise((resolve) => setTimeout(resolve, 300))")


def wait_for_events(tab: Tab, pad: Joystick) -> None:
    """Wait until the page has read all events so far, by those of an axis that follow them."""
    for value in (FULL, 0):
        pad.axis(UNUSED, value)
        read = f"navigator.getGamepads().some((pad) => pad?.axes[1] === {value // FULL})"
        wait_until("the browser has the events", lambda read=read: tab.evaluate(read))  # type: ignore[misc]
    let_time_pass(tab)


def test_a_real_joystick_drives_until_it_is_unplugged(pad: Joystick, person_drive: PersonDrive, tmp_path: Path) -> None:
    """A joystick arms and steers; unplugged, the car stops; plugged while held, only a fresh press counts."""

    def hold() -> None:
        pad.button(DEAD_MAN, down=True)

    def let_go() -> None:
        pad.axis(THROTTLE, -FULL)
        pad.button(DEAD_MAN, down=False)
        wait_for_events(tab, pad)

    def is_read_when_pressed() -> bool:
        for down in (False, True):  # the browser hides a press that it finds when it opens the device
            pad.button(DEAD_MAN, down=down)
            let_time_pass(tab)
        return gamepads(tab) == [["standard", 0, 1]]

    def accelerates_to_the_left() -> bool:
        if field(tab, "safety") == "driving":
            pad.axis(STEERING, -FULL)
            pad.axis(THROTTLE, FULL)
        return commands_acceleration_to_the_left(tab)

    with running_browser(tmp_path / "chromium", environment=pad.environment) as browser:
        tab = person_drive.open(browser)
        assert gamepads(tab) == []
        pad.plug()
        wait_until("the browser reads the button", is_read_when_pressed)  # it shows no gamepad before its first event
        let_go()
        drive_until(tab, hold, let_go, accelerates_to_the_left)
        assert gamepads(tab) == [["standard", -1, 1]]
        pad.unplug()
        wait_until("the car stops", lambda: field(tab, "safety") == "safe_stop")
        wait_until("the browser shows no gamepad", lambda: gamepads(tab) == [])
        wait_until("the car is stationary", lambda: field(tab, "phase") == "arming")
        pad.axis(THROTTLE, -FULL)
        pad.plug()  # the button is still pressed, which the browser hides until it has been released
        wait_until("the browser has found the gamepad", lambda: gamepads(tab) != [])
        wait_until_open(tab)
        let_go()
        drive_until(tab, hold, let_go, lambda: bool(field(tab, "safety") == "driving"))
