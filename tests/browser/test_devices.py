"""Gamepads, wheels and touch. The devices are fakes in the page, so these tests are about the page's logic only."""

from __future__ import annotations

import json
from typing import Any

from tests.browser.chromium import Tab, wait_until
from tests.browser.conftest import (
    PersonDrive,
    commands_acceleration_to_the_left,
    drive_until,
    field,
    wait_until_open,
)

GAMEPAD = {"id": "pad", "mapping": "standard", "axes": [0, 0, 0, 0], "buttons": [0] * 17}
WHEEL = {"id": "wheel", "mapping": "", "axes": [0, 0, 0], "buttons": [0] * 4}
RB, RT, B = 5, 7, 1


def plug(tab: Tab, device: dict[str, Any] | None) -> None:
    """Connect a device, change its values, or unplug it, and let the page read it before anything else changes."""
    fake = "null"
    if device is not None:
        buttons = [{"value": value, "pressed": value > 0.5} for value in device["buttons"]]
        fake = json.dumps({**device, "buttons": buttons, "connected": True, "index": 0})
    tab.evaluate(f"navigator.getGamepads = () => [null, {fake}]; 0")
    let_time_pass(tab, 100)


def moved(device: dict[str, Any], *, axes: dict[int, float] | None = None, buttons: tuple[int, ...] = ()) -> Any:
    """Return a device with these axes and pressed buttons."""
    changed_axes = [(axes or {}).get(index, value) for index, value in enumerate(device["axes"])]
    return {
        **device,
        "axes": changed_axes,
        "buttons": [float(index in buttons) for index in range(len(device["buttons"]))],
    }


def let_time_pass(tab: Tab, duration_ms: int) -> None:
    """Let the page's own timer of 20 ms read the devices, however busy the machine is."""
    tab.evaluate(f"new Promise((resolve) => setTimeout(resolve, {duration_ms}))")


def hint(tab: Tab) -> str:
    """Return what the page asks the person to do."""
    return str(tab.evaluate("document.querySelector('#hint').textContent"))


def arm(tab: Tab, held: dict[str, Any]) -> None:
    """Hold the dead-man control of a device until the vehicle is driving."""
    drive_until(tab, lambda: plug(tab, held), lambda: plug(tab, GAMEPAD), lambda: field(tab, "safety") == "driving")


def test_a_gamepad_drives_until_it_is_unplugged(person_drive: PersonDrive) -> None:
    """A known gamepad drives without calibration; if it is unplugged, the car stops, and only a fresh press counts."""
    tab = person_drive.open()
    held = moved(GAMEPAD, buttons=(RB,))

    def accelerates_to_the_left() -> bool:
        if field(tab, "safety") == "driving":
            plug(tab, moved(GAMEPAD, axes={0: -1.0}, buttons=(RB, RT)))
        return commands_acceleration_to_the_left(tab)

    plug(tab, GAMEPAD)
    drive_until(tab, lambda: plug(tab, held), lambda: plug(tab, GAMEPAD), accelerates_to_the_left)
    plug(tab, None)
    wait_until("the car stops", lambda: field(tab, "safety") == "safe_stop")
    plug(tab, held)
    wait_until("the car is stationary", lambda: field(tab, "phase") == "arming")
    wait_until_open(tab)
    plug(tab, GAMEPAD)
    arm(tab, held)


def test_the_button_of_a_gamepad_stops(person_drive: PersonDrive) -> None:
    """The gamepad's button makes an emergency stop, which the vehicle confirms."""
    tab = person_drive.open()
    plug(tab, moved(GAMEPAD, buttons=(B,)))
    wait_until("the stop is confirmed", lambda: field(tab, "emergency_stop") == "confirmed")


def test_a_wheel_drives_after_its_calibration(person_drive: PersonDrive) -> None:
    """An unknown wheel does nothing until its calibration ends; then inverted pedals at any rest position work."""
    tab = person_drive.open()
    rest = moved(WHEEL, axes={1: 1.0, 2: -1.0})  # the throttle is inverted
    plug(tab, moved(rest, axes={0: 1.0}))
    wait_until(
        "the page offers the calibration", lambda: not tab.evaluate("document.querySelector('#calibrate').hidden")
    )
    assert tab.evaluate("document.querySelector('#steering').value") == 0
    plug(tab, rest)
    tab.evaluate("document.querySelector('#calibrate').click()")
    wait_until("the first question", lambda: "left" in hint(tab))
    answers = [{"axes": {0: -1.0}}, {"axes": {0: 1.0}}, {"axes": {1: -1.0}}, {"axes": {2: 1.0}}]
    for answer in [*answers, {"buttons": (0,)}, {"buttons": (3,)}]:
        question = hint(tab)
        plug(tab, moved(rest, **answer))  # type: ignore[arg-type]
        wait_until("the next question", lambda asked=question: hint(tab) != asked)  # type: ignore[misc]
        plug(tab, rest)
    wait_until("the calibration is saved", lambda: tab.evaluate("localStorage.length") == 1)
    plug(tab, moved(rest, axes={0: -1.0, 1: 0.0}, buttons=(0,)))
    wait_until("it steers to the left", lambda: tab.evaluate("document.querySelector('#steering').value") == -1)
    assert 0.4 < tab.evaluate("document.querySelector('#throttle').value") < 0.55
    assert field(tab, "emergency_stop") == "none"
    plug(tab, moved(rest, buttons=(3,)))
    wait_until("the stop is confirmed", lambda: field(tab, "emergency_stop") == "confirmed")
    tab.evaluate("localStorage.clear()")


def test_touch_holds_and_steers(person_drive: PersonDrive) -> None:
    """A finger on the left field is the dead-man control and steers; lifting it stops the vehicle."""
    tab = person_drive.open()
    tab.call("Emulation.setTouchEmulationEnabled", enabled=True)
    wait_until(
        "the fields are shown",
        lambda: tab.evaluate("getComputedStyle(document.querySelector('#touch_steering')).display") == "grid",
    )
    x, y = tab.evaluate(
        "(({x, y, width, height}) => [x + width / 2, y + height / 2])"
        "(document.querySelector('#touch_steering').getBoundingClientRect())"
    )

    def touch(kind: str, *points: dict[str, float]) -> None:
        tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=list(points))

    def steers_to_the_left() -> bool:
        if field(tab, "safety") == "driving":
            touch("touchMove", {"x": x - 100, "y": y})
        return bool((field(tab, "command") or [0])[0] > 0.1)

    drive_until(tab, lambda: touch("touchStart", {"x": x, "y": y}), lambda: touch("touchEnd"), steers_to_the_left)
    touch("touchEnd")
    wait_until("the car stops", lambda: field(tab, "safety") == "safe_stop")
