"""Keys whose release the browser does not deliver, in a real window: a menu or the window manager has grabbed them."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from tests.browser.chromium import ProtocolError, Tab, running_browser, wait_until

from lavt.clock import MachineClock
from lavt.transport.console.console_link import ConsoleLink

IN_PAGE = ("mousemove", "500", "450")
RIGHT, PRESS = ("click", "3"), ("mousedown", "1")
GRABS = {
    "nothing": (),
    "right click": (IN_PAGE, RIGHT),
    "right click on the tabs": (("mousemove", "700", "60"), RIGHT),
    "menu of the browser": (("mousemove", "1032", "100"), ("click", "1")),
    "window is moved": (("mousemove", "700", "36"), PRESS, ("mousemove", "720", "46")),
    "text is dragged": (("mousemove", "300", "500"), PRESS, ("mousemove", "400", "520"), ("mousemove", "450", "560")),
    "menu key": (("key", "Menu"),),
    "F10": (("key", "F10"),),
    "Alt and F": (("key", "alt+f"),),
}


class Window:
    """A browser's window on a display of its own, with the console's page, and a person's mouse and keys."""

    def __init__(self, display: str, tab: Tab, link: ConsoleLink) -> None:
        self._display = display
        self.tab = tab
        self.close_link = link.close

    def text(self, name: str) -> str:
        """Return the text of an element."""
        return str(self.tab.evaluate(f"document.querySelector('#{name}').textContent"))

    def act(self, *action: str) -> None:
        """Let xdotool make an input."""
        subprocess.run(["xdotool", *action], env=os.environ | {"DISPLAY": self._display}, check=True)
        self.tab.evaluate("new Promise((resolve) => setTimeout(resolve, 150))")

    def has_focus(self) -> bool:
        """Click the page, and return whether it has the pointer and the focus."""
        self.act(*IN_PAGE, "click", "1")
        return bool(self.tab.evaluate("lavtConsole.keyboard.isPointed && document.hasFocus()"))

    def wait_for_hold(self, *, is_held: bool) -> None:
        """Wait until the page takes the dead-man control for held, or not."""
        wait_until(f"held: {is_held}", lambda: bool(self.tab.evaluate("lavtConsole.keyboard.holds")) == is_held, 5)


def is_loaded(tab: Tab) -> bool:
    """Return whether the page's modules have been executed."""
    try:
        return bool(tab.evaluate("'lavtConsole' in globalThis"))
    except ProtocolError:
        return False


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Window]:
    out = tmp_path_factory.mktemp("window")
    link = ConsoleLink(MachineClock(), "0123456789abcdef")
    with ExitStack() as stack:
        link.start(lambda *_: None)
        stack.callback(link.close)
        number = out / "display"
        with number.open("w") as file:
            server = subprocess.Popen(
                ["Xvfb", "-displayfd", str(file.fileno()), "-screen", "0", "1200x900x24"],
                pass_fds=[file.fileno()],
                stderr=subprocess.DEVNULL,
            )
        stack.callback(server.wait)
        stack.callback(server.kill)
        wait_until("there is a display", lambda: number.read_text().endswith("\n"))
        display = f":{number.read_text().strip()}"
        manager = subprocess.Popen(["openbox"], env=os.environ | {"DISPLAY": display}, stderr=subprocess.DEVNULL)
        stack.callback(manager.wait)
        stack.callback(manager.kill)
        browser = stack.enter_context(running_browser(out / "profile", display))
        tab = browser.open(link.url)
        wait_until("the page is loaded", lambda: is_loaded(tab))
        window = Window(display, tab, link)
        wait_until("the window takes clicks and keys", window.has_focus)
        yield window


@pytest.mark.parametrize("grab", GRABS)
def test_a_released_key_is_not_held(window: Window, grab: str) -> None:
    """Whatever grabs the keys while the space bar is held, the page does not take it for held after its release."""
    wait_until("the page has the focus", window.has_focus)
    window.act("keydown", "space")
    window.wait_for_hold(is_held=True)
    try:
        for action in GRABS[grab]:
            window.act(*action)
        window.act("keyup", "space")
        window.wait_for_hold(is_held=False)
    finally:
        window.act("keyup", "space", "mouseup", "1")
        window.act("key", "Escape")


def test_keys_count_only_under_the_pointer(window: Window) -> None:
    """Without the pointer over the page, the space bar does not count; a press that follows its return does."""
    wait_until("the page has the focus", window.has_focus)
    window.act("mousemove", "700", "60")
    window.act("keydown", "space")
    window.wait_for_hold(is_held=False)
    window.act(*IN_PAGE)
    window.wait_for_hold(is_held=False)
    window.act("keyup", "space")
    window.act("keydown", "space")
    window.wait_for_hold(is_held=True)
    window.act("keyup", "space")


def test_a_finger_counts_only_once_it_is_put_down_again(window: Window) -> None:
    """After the page has lost the focus, a finger that stays on the field and moves does not hold."""

    def finger(kind: str, x: int) -> bool:
        event = f"new PointerEvent('{kind}', {{pointerId: 1, clientX: {x}, clientY: 10, cancelable: true}})"
        window.tab.evaluate(f"document.querySelector('#touch_steering').dispatchEvent({event}); 0")
        return bool(window.tab.evaluate("lavtConsole.touch.holds"))

    window.tab.evaluate("Element.prototype.setPointerCapture = () => {}; 0")
    assert finger("pointerdown", 100)
    window.tab.evaluate("dispatchEvent(new Event('blur')); 0")
    assert not finger("pointermove", 101)
    assert not finger("pointerup", 101)
    assert finger("pointerdown", 100)
    assert not finger("pointerup", 100)


def test_another_gamepad_of_the_same_kind_is_another_device(window: Window) -> None:
    """If one of two equal gamepads is unplugged, or unplugged and plugged in again, its hold does not continue."""

    def plug(index: int, *, is_held: bool) -> None:
        values = json.dumps([float(is_held and button == 5) for button in range(17)])
        window.tab.evaluate(
            f"globalThis.pad = {{id: 'pad', mapping: 'standard', axes: [0, 0, 0, 0], connected: true, index: {index},"
            f" buttons: {values}.map((value) => ({{value}}))}}; navigator.getGamepads = () => [pad];"
            "new Promise((resolve) => setTimeout(resolve, 200))"
        )

    def holds() -> bool:
        return bool(window.tab.evaluate("lavtConsole.gamepads.holds"))

    for is_replugged in (False, True):
        plug(0, is_held=False)
        plug(0, is_held=True)
        assert holds()
        if is_replugged:
            event = "Object.assign(new Event('gamepaddisconnected'), {gamepad: pad})"
            window.tab.evaluate(f"dispatchEvent({event}); new Promise((resolve) => setTimeout(resolve, 200))")
        else:
            plug(1, is_held=True)
        assert not holds()


VIDEO = """(async () => {
  const {Video} = await import("/video.js");
  const real = globalThis.VideoDecoder;
  globalThis.VideoDecoder = class {
    constructor({output}) { this.output = output; }
    configure() {}
    close() {}
    decode({timestamp}) { this.output({timestamp, displayWidth: 1, displayHeight: 1, close() {}}); }
  };
  const calls = [];
  const canvas = {getContext: () => ({drawImage() { throw new Error("no picture"); }})};
  const video = new Video(canvas, () => calls.push("acknowledged"), () => calls.push("lost"), () => {});
  video.push({data: new Uint8Array(%s), unit: 1, isKeyframe: true});
  globalThis.VideoDecoder = real;
  return [calls.join(), video.errors];
})()"""


@pytest.mark.parametrize("data", ["[0, 0, 1, 0x67, 66, 192, 30, 0]", "[0, 0, 1, 0x65, 0, 0, 0, 0]"])
def test_a_picture_that_cannot_be_drawn_is_lost(window: Window, data: str) -> None:
    """A keyframe whose picture cannot be drawn, or that has no parameters for a decoder, is reported as lost."""
    assert window.tab.evaluate(VIDEO % data) == ["lost", 1]


def test_a_stop_without_a_connection_says_so(window: Window) -> None:
    """When the connection has ended, no state is shown any more, and an emergency stop is shown as not sent."""
    window.close_link()
    wait_until("the page is not connected", lambda: window.text("connection") == "not connected")
    assert window.text("safety") == "no state"
    window.tab.evaluate("document.querySelector('#stop').click()")
    assert "NOT sent" in window.text("hint")
    window.tab.evaluate("new Promise((resolve) => setTimeout(resolve, 1500))")
    assert "NOT sent" in window.text("hint")
