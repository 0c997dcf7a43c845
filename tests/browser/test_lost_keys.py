"""Keys whose release the browser does not deliver, in a real window: a menu or the window manager has grabbed them."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from tests.browser.chromium import Tab, running_browser, wait_until
from tests.browser.conftest import plug_gamepad, unplug_gamepads
from tests.browser.fake_client import FakeClient, wait_until_loaded
from tests.browser.x_keyboard import grabbed_keyboard, without_repeats

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

KEEP_HINTS = """(() => {
  globalThis.hints = [];
  const hint = document.querySelector("#hint");
  new MutationObserver(() => hints.push(hint.textContent)).observe(hint, {childList: true});
})()"""
"""Keeps every text that the page shows as its hint from now on, however short."""

STANDS_STILL = 1.0
"""The target speed with which the client tells the page that the display server hangs."""
RELEASE_LATER = """(() => {
  let frame_ms = performance.now();
  const note = () => { frame_ms = performance.now(); requestAnimationFrame(note); };
  note();
  const timer = setInterval(() => {
    if (lavtConsole.status?.target_mps !== 1 || performance.now() - frame_ms < 1000) return;
    clearInterval(timer);
    lavtConsole.send({type: "delay", video_ms: 0, control_ms: 0});
    setTimeout(() => { pad.buttons[5].value = 0; }, 1000);
  }, 20);
})()"""
"""Once the display server hangs, and no picture of the screen was made for a second, sends a mark, which arrives after
all inputs so far, and releases the gamepad a second later."""

ATTEMPTS = 4
"""On a busy machine, repeats of keys are late at times."""


class Window:
    """A browser's window on a display of its own, with the console's page, and a person's mouse and keys."""

    def __init__(self, display: str, server: subprocess.Popen[bytes], tab: Tab, client: FakeClient) -> None:
        self.display = display
        self.server = server
        self.tab = tab
        self.client = client

    def text(self, name: str) -> str:
        """Return the text of an element."""
        return str(self.tab.evaluate(f"document.querySelector('#{name}').textContent"))

    def act(self, *action: str) -> None:
        """Let xdotool make an input."""
        subprocess.run(["xdotool", *action], env=os.environ | {"DISPLAY": self.display}, check=True)
        self.tab.evaluate("new Promise((resolve) => setTimeout(resolve, 150))")

    def pass_time(self, duration_s: float) -> None:
        """Let the page go on for a while."""
        self.tab.evaluate(f"new Promise((resolve) => setTimeout(resolve, {duration_s * 1000}))")

    def has_focus(self) -> bool:
        """Click the page, and return whether it has the pointer and the focus."""
        self.act(*IN_PAGE, "click", "1")
        return bool(self.tab.evaluate("lavtConsole.keyboard.isPointed && document.hasFocus()"))

    def wait_for_hold(self, *, is_held: bool) -> None:
        """Wait until the page takes the dead-man control for held, or not."""
        self.client.wait_for_input(f"held: {is_held}", held=is_held)


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Window]:
    out = tmp_path_factory.mktemp("window")
    with ExitStack() as stack:
        client = FakeClient()
        client.confirms_stops = True
        stack.callback(client.close)
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
        tab = browser.open(client.url)
        wait_until_loaded(tab, client)
        window = Window(display, server, tab, client)
        wait_until("the window takes clicks and keys", window.has_focus)
        yield window


@pytest.fixture(autouse=True)
def _released_keys(window: Window) -> Iterator[None]:
    yield
    window.act(*(word for key in ("space", "Up", "Left", "Right", "3") for word in ("keyup", key)))


def reload(window: Window) -> None:
    """Load the page again, and wait until the new one, and no longer the old one, sends inputs."""
    window.tab.evaluate("delete globalThis.lavtConsole; location.reload(); 0")
    wait_until_loaded(window.tab, window.client)
    window.client.wait_for_sent(window.tab)
    window.client.inputs.clear()
    wait_until_loaded(window.tab, window.client)


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


@pytest.mark.parametrize("grab_s", [0.2, 3.0])
def test_a_key_released_during_a_grab_is_not_held(window: Window, grab_s: float) -> None:
    """If another client takes the keyboard without any event, the page sees the end of the repeats."""
    wait_until("the page has the focus", window.has_focus)
    window.act("keydown", "space", "keydown", "Up")
    window.wait_for_hold(is_held=True)
    with grabbed_keyboard(window.display):
        window.act("keyup", "Up", "keyup", "space")
        window.pass_time(grab_s)
    window.wait_for_hold(is_held=False)


def holds_all_the_time(window: Window) -> bool:
    """Hold the space bar while other keys are tapped and held; return whether the page has held all the time."""
    window.act("keydown", "space")
    window.wait_for_hold(is_held=True)
    begin = len(window.client.inputs)
    window.pass_time(3)
    for key in ("Left", "3", "Right"):
        window.act("keydown", key)
        window.pass_time(2)
        window.act("keyup", key)
        window.pass_time(0.5)
    window.act("keydown", "Up")
    window.pass_time(3)
    has_held = all(each.held for each in window.client.inputs[begin:])
    window.act("keyup", "Up", "keyup", "space")
    window.wait_for_hold(is_held=False)
    return has_held


def test_a_held_key_holds_as_long_as_it_repeats(window: Window) -> None:
    """A space bar that is held, and a later key that is, hold without end; other keys may be tapped in between."""
    wait_until("the page has the focus", window.has_focus)
    assert any(holds_all_the_time(window) for _ in range(ATTEMPTS))


def test_when_no_key_repeats_one_must_be_pressed(window: Window) -> None:
    """After the release of the key that repeats, nothing repeats: the page asks for a key, then releases all."""
    wait_until("the page has the focus", window.has_focus)
    window.act("keydown", "space")
    window.wait_for_hold(is_held=True)
    window.tab.evaluate(KEEP_HINTS)  # the first of the two is shown for a second only
    window.act("key", "Left")
    wait_until("the page asks for a key", lambda: "press an arrow key again" in window.tab.evaluate("hints.join()"))
    window.wait_for_hold(is_held=False)
    wait_until("the page says why", lambda: "no key events" in window.text("hint"))
    window.act("keyup", "space")


def test_a_keyboard_without_repeats_does_not_hold(window: Window) -> None:
    """If the system repeats no key, a lost release would not be noticed: the page does not hold, and says so."""
    with without_repeats(window.display):
        reload(window)
        wait_until("the page has the focus", window.has_focus)
        window.act("keydown", "space")
        wait_until("the page says why", lambda: "repeats no key" in window.text("hint"))
        assert not any(each.held for each in window.client.inputs)
        window.act("keyup", "space")


def test_a_screen_that_stands_still_drives_no_more(window: Window) -> None:
    """If the display server hangs, the page sends no input that holds, although it has the focus; a release is sent.

    The browser may hang, too, and answer no question about the page.
    """
    plug_gamepad(window.tab, is_held=False)
    plug_gamepad(window.tab, is_held=True)
    window.wait_for_hold(is_held=True)
    window.tab.evaluate(RELEASE_LATER)
    window.server.send_signal(signal.SIGSTOP)
    try:
        marks = window.client.marks
        window.client.changes = {"target_mps": STANDS_STILL}
        wait_until("the page has seen no picture of the screen for a while", lambda: window.client.marks > marks)
        sent = len(window.client.inputs)
        wait_until("the release arrives", lambda: len(window.client.inputs) > sent)
        assert not any(each.held for each in window.client.inputs[sent:])
    finally:
        window.server.send_signal(signal.SIGCONT)
        window.client.changes = {}
        unplug_gamepads(window.tab)


def test_a_finger_counts_only_once_it_is_put_down_again(window: Window) -> None:
    """After the page has lost the focus, a finger that stays on the field and moves does not hold."""

    def finger(kind: str, x: int) -> bool:
        event = f"new PointerEvent('{kind}', {{pointerId: 1, buttons: 1, clientX: {x}, clientY: 10, cancelable: true}})"
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

    def holds() -> bool:
        return bool(window.tab.evaluate("lavtConsole.gamepads.holds"))

    for is_replugged in (False, True):
        plug_gamepad(window.tab, is_held=False)
        plug_gamepad(window.tab, is_held=True)
        assert holds()
        if is_replugged:
            event = "Object.assign(new Event('gamepaddisconnected'), {gamepad: pad})"
            window.tab.evaluate(f"dispatchEvent({event}); new Promise((resolve) => setTimeout(resolve, 200))")
        else:
            plug_gamepad(window.tab, is_held=True, index=1)
        assert not holds()
    unplug_gamepads(window.tab)


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
  await new Promise((resolve) => setTimeout(resolve)); // a picture is drawn after those before it
  return [calls.join(), video.errors];
})()"""


@pytest.mark.parametrize("data", ["[0, 0, 1, 0x67, 66, 192, 30, 0]", "[0, 0, 1, 0x65, 0, 0, 0, 0]"])
def test_a_picture_that_cannot_be_drawn_is_lost(window: Window, data: str) -> None:
    """A keyframe whose picture cannot be drawn, or that has no parameters for a decoder, is reported as lost."""
    assert window.tab.evaluate(VIDEO % data) == ["lost", 1]
