"""A client without a vehicle: it tells the page that it drives, and keeps what the page sends."""

from __future__ import annotations

from typing import Any, Final

from tests.browser.chromium import ProtocolError, Tab, wait_until

from lavt.clock import MachineClock
from lavt.domain import NS_PER_US, Now
from lavt.node import Send
from lavt.transport.console.console_link import ConsoleLink
from lavt.transport.console.page_messages import (
    PageDelay,
    PageInput,
    PageStatus,
    PageStop,
    pack_text,
    parse_page_message,
)

TOKEN: Final = "0123456789abcdef"
STATUS: Final[dict[str, Any]] = {
    "role": "drives",
    "can_drive": False,
    "hand": "open",
    "phase": "driving",
    "session_reason": "",
    "has_control": True,
    "safety": "driving",
    "reason": "",
    "active_operator": "",
    "requested_by": "",
    "rejected": "",
    "limited": "",
    "speed_mps": 0.0,
    "target_mps": 8.0,
    "steering_rad": 0.0,
    "state_age_ms": 0.0,
    "emergency_stop": "none",
    "command": None,
    "video_ms": None,
    "round_trip_ms": None,
    "bit_rate_bps": 0,
    "lost_share": None,
    "delay": None,
}
CONFIRMED: Final = {"emergency_stop": "confirmed", "safety": "emergency_stop"}


class FakeClient:
    """A link that answers each message of its page, which sends one at least every 500 ms, with a status."""

    def __init__(self, port: int = 0, token: str = TOKEN) -> None:
        self._clock = MachineClock()
        self._link = ConsoleLink(self._clock, token, port)
        self.port, self.url = self._link.port, self._link.url
        self.is_silent = False
        self.confirms_stops = False
        self.changes: dict[str, Any] = {}
        """Values of the status that differ from `STATUS`."""
        self.inputs: list[PageInput] = []
        self.stops = 0
        self.marks = 0
        """How many messages without a meaning have arrived, each after all that the page has sent before."""
        self._link.start(self._deliver)

    def _deliver(self, channel: str, payload: Any, now: Now, page: Any) -> None:
        if channel == "page_message":
            message = parse_page_message(payload)
            if isinstance(message, PageInput):
                self.inputs.append(message)
            elif isinstance(message, PageDelay):
                self.marks += 1
            elif isinstance(message, PageStop):
                self.stops += 1
                if self.confirms_stops:
                    self._answer(page, now, CONFIRMED)
        if channel != "page_closed" and not self.is_silent:
            self._answer(page, now, self.changes)

    def _answer(self, page: Any, now: Now, changes: dict[str, Any]) -> None:
        status = PageStatus(sent_us=now.mono_ns // NS_PER_US, **STATUS | changes)
        self._link.send(Send("page_status", pack_text(status), page))

    def wait_for_input(self, expectation: str, *, limit_s: float = 5.0, **values: bool) -> None:
        """Wait until the newest input has these values."""
        wait_until(expectation, lambda: all(getattr(self.inputs[-1], name) == values[name] for name in values), limit_s)

    def wait_for_sent(self, tab: Tab) -> None:
        """Wait until all that the page has sent so far has arrived: a message that is sent now arrives after it."""
        before = self.marks
        tab.evaluate("lavtConsole.send({type: 'delay', video_ms: 0, control_ms: 0})")
        wait_until("what the page has sent has arrived", lambda: self.marks > before)

    def close(self) -> None:
        """End the link."""
        self._link.close()


def wait_until_loaded(tab: Tab, client: FakeClient) -> None:
    """Wait until the page is connected, which it needs to send anything, and sends inputs."""

    def is_loaded() -> bool:
        try:
            return bool(tab.evaluate("globalThis.lavtConsole?.status?.role === 'drives'")) and client.inputs != []
        except ProtocolError:
            return False

    wait_until("the page is connected and sends inputs", is_loaded)
