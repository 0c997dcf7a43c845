"""The page without a vehicle: what it sends, and what it shows when the connection is slow or has ended."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
from tests.browser.chromium import Browser, Tab, wait_until
from tests.browser.conftest import plug_gamepad, press, release, repeat_keys
from tests.browser.fake_client import CONFIRMED, FakeClient, wait_until_loaded
from tests.support.ports import free_port

from lavt.transport.console import console_link

SILENCE_S = 3.0


class ConnectedPage:
    """A page, and the client that it is connected to."""

    def __init__(self, tab: Tab, client: FakeClient) -> None:
        self.tab = tab
        self.client = client

    def text(self, name: str) -> str:
        """Return the text of an element."""
        return str(self.tab.evaluate(f"document.querySelector('#{name}').textContent"))

    def pass_time(self, duration_s: float) -> None:
        """Let the page go on for a while."""
        self.tab.evaluate(f"new Promise((resolve) => setTimeout(resolve, {duration_s * 1000}))")

    def stop(self) -> None:
        """Press and release the key of the emergency stop."""
        press(self.tab, "Escape")
        release(self.tab, "Escape")


@pytest.fixture
def page(browser: Browser) -> Iterator[ConnectedPage]:
    client = FakeClient(free_port(socket.SOCK_STREAM))  # which a later client of the page gets, too
    tab = browser.open(client.url)
    page = ConnectedPage(tab, client)
    try:
        wait_until_loaded(tab, client)
        repeat_keys(tab)
        yield page
    finally:
        browser.close_tab(tab)
        page.client.close()


def test_the_page_shows_bit_rate_and_lost_packets(page: ConnectedPage) -> None:
    """The page shows the client's bit rate and share of lost packets, and a dash if the share is unknown."""
    page.client.changes = {"bit_rate_bps": 2_540_000, "lost_share": 0.025}
    wait_until("the losses are shown", lambda: page.text("lost_share") == "2.5 %")
    assert page.text("bit_rate") == "2.5 Mb/s"
    page.client.changes = {}
    wait_until("a dash is shown", lambda: page.text("lost_share") == "–")


def test_the_page_shows_the_speed_limit_of_the_vehicle(page: ConnectedPage) -> None:
    """The page shows the speed limit, rounded down, with its reason if there is one; without a limit it shows none."""
    page.client.changes = {"speed_limit_mps": 5.8, "speed_limit_reason": "latency"}
    wait_until("the limit is shown", lambda: page.text("speed_limit") == "at most 20 km/h: latency")
    assert page.tab.evaluate("document.querySelector('#speed_limit').hidden") is False
    page.client.changes = {"speed_limit_mps": 0.0, "speed_limit_reason": ""}
    wait_until("the limit is shown", lambda: page.text("speed_limit") == "at most 0 km/h")
    page.client.changes = {}
    wait_until("it is hidden", lambda: page.tab.evaluate("document.querySelector('#speed_limit').hidden") is True)


def test_no_input_waits_behind_others(page: ConnectedPage) -> None:
    """While the client sends nothing, the page sends no inputs and shows no old state; a stop is sent."""
    page.client.is_silent = True
    page.pass_time(SILENCE_S)
    page.client.wait_for_sent(page.tab)
    sent = len(page.client.inputs)
    page.pass_time(SILENCE_S)
    page.client.wait_for_sent(page.tab)
    assert len(page.client.inputs) == sent
    assert "no status from lavt for" in page.text("hint")
    assert page.text("safety") == "no state"
    assert page.tab.evaluate("document.body.classList.contains('old')")
    page.stop()
    wait_until("the stop is sent", lambda: page.client.stops > 0)
    page.client.is_silent = False
    wait_until("inputs are sent again", lambda: len(page.client.inputs) > sent)
    wait_until("the state is shown", lambda: not page.tab.evaluate("document.body.classList.contains('old')"))


def test_no_input_is_sent_behind_unsent_bytes(page: ConnectedPage) -> None:
    """While the browser has not taken what the page has sent, the page sends no inputs."""
    page.tab.evaluate("Object.defineProperty(WebSocket.prototype, 'bufferedAmount', {value: 10000}); 0")
    page.client.wait_for_sent(page.tab)
    sent = len(page.client.inputs)
    page.pass_time(0.3)
    page.client.wait_for_sent(page.tab)
    assert len(page.client.inputs) == sent


def test_a_stop_is_repeated_until_it_is_confirmed(page: ConnectedPage) -> None:
    """A stop is sent again twice a second, and its warning stays, until the vehicle is in an emergency stop."""
    page.stop()
    wait_until("the stop is repeated", lambda: page.client.stops >= 2)
    wait_until("the warning is shown", lambda: "not confirmed" in page.text("hint"))
    page.client.changes = CONFIRMED
    wait_until("the confirmation is shown", lambda: "has confirmed" in page.text("hint"))
    page.client.wait_for_sent(page.tab)
    stops = page.client.stops
    page.pass_time(1.5)
    page.client.wait_for_sent(page.tab)
    assert page.client.stops == stops


def test_a_stop_without_a_connection_is_sent_later(page: ConnectedPage) -> None:
    """A stop without a connection is shown as not sent, then sent after the next hello, and shown until confirmed."""
    page.client.close()
    wait_until("the page is not connected", lambda: page.text("connection") == "not connected")
    assert page.text("safety") == "no state"
    page.stop()
    assert "NOT sent" in page.text("hint")
    page.pass_time(1.5)
    assert "NOT sent" in page.text("hint")
    page.client = FakeClient(page.client.port)
    wait_until("the stop is sent", lambda: page.client.stops > 0)
    wait_until("it is shown as not confirmed", lambda: "not confirmed" in page.text("hint"))
    page.pass_time(1.5)
    assert "not confirmed" in page.text("hint")


def test_a_page_without_a_place_tries_again(page: ConnectedPage, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that finds too many pages open is let in as soon as there is a place, and sends its stop."""
    page.client.close()
    monkeypatch.setattr(console_link, "MAX_PAGES", 0)
    page.client = FakeClient(page.client.port)
    wait_until("the page is refused", lambda: "too many pages" in page.text("hint"))
    page.stop()  # while the page tries again, it shows the stop when it is refused
    wait_until("the page shows that the stop waits", lambda: "It is sent if" in page.text("hint"))
    monkeypatch.undo()
    wait_until("the stop is sent", lambda: page.client.stops > 0)


def test_a_stop_that_will_never_be_sent_is_said(page: ConnectedPage) -> None:
    """A page whose token is no longer valid says that the stop was not sent, and promises nothing."""
    page.client.close()
    page.client = FakeClient(page.client.port, "fedcba9876543210")
    wait_until("the page is refused", lambda: "wrong token" in page.text("hint"))
    page.stop()
    assert "NOT sent" in page.text("hint")
    assert "It is sent if" not in page.text("hint")


def test_any_key_that_means_escape_stops(page: ConnectedPage) -> None:
    """A key that the person's keyboard layout has made Escape is an emergency stop, too."""
    event = "new KeyboardEvent('keydown', {code: 'CapsLock', key: 'Escape', bubbles: true})"
    page.tab.evaluate(f"document.body.dispatchEvent({event}); 0")
    wait_until("the stop is sent", lambda: page.client.stops > 0)


def test_a_hold_of_another_device_is_no_fresh_press(page: ConnectedPage) -> None:
    """When the space bar is released while a gamepad is held, nothing is held until the gamepad is pressed again."""
    plug_gamepad(page.tab, is_held=False)
    press(page.tab, "Space")
    page.client.wait_for_input("the space bar holds", held=True)
    plug_gamepad(page.tab, is_held=True)
    release(page.tab, "Space")
    page.client.wait_for_input("nothing holds", held=False)
    page.pass_time(0.3)
    assert not page.client.inputs[-1].held
    plug_gamepad(page.tab, is_held=False)
    plug_gamepad(page.tab, is_held=True)
    page.client.wait_for_input("the gamepad holds", held=True)


def test_a_mouse_holds_by_its_left_button_only(page: ConnectedPage) -> None:
    """A press of another mouse button on the touch field ends the hold: the left one's release would be no event."""

    def mouse(kind: str, button: int, buttons: int) -> bool:
        event = f"new PointerEvent('{kind}', {{pointerId: 1, button: {button}, buttons: {buttons}}})"
        page.tab.evaluate(f"document.querySelector('#touch_steering').dispatchEvent({event}); 0")
        return bool(page.tab.evaluate("lavtConsole.touch.holds"))

    page.tab.evaluate("document.querySelector('#touch_steering').style.display = 'grid'; 0")
    page.tab.evaluate("Element.prototype.setPointerCapture = () => {}; 0")
    assert not mouse("pointerdown", 2, 2)
    assert mouse("pointerdown", 0, 1)
    assert mouse("pointermove", -1, 1)
    assert not mouse("pointermove", 2, 3)
