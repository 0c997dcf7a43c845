"""A page of the console in Python: it acknowledges pictures without decoding them, and drives with a fixed input."""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Final
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import WorkError
from lavt.transport.console.page_messages import PAGE_VERSION

INPUT_PERIOD_NS: Final = 20 * NS_PER_MS
CLOSE_LIMIT_S: Final = 30.0
ARM_LIMIT_NS: Final = 20 * NS_PER_S
UNIT_HEAD: Final = struct.Struct(">BBHIQ")
TakeUnit = Callable[[bytes, int, bool], None]


class PythonPage:
    """A page that is connected to the console at `url`, with a thread of its own.

    It sends `held`, `throttle` and `steering` as inputs every 20 ms while it drives. `take_unit(data, unit,
    is_keyframe)` gets each access unit before it is acknowledged.
    """

    def __init__(self, url: str, take_unit: TakeUnit | None = None) -> None:
        self.status: dict[str, Any] = {}
        """The newest status."""
        self.held = False
        self.throttle = self.steering = 0.0
        self.arrivals_ns: list[int] = []
        """When the statuses arrived."""
        self._clock = MachineClock()
        self._take_unit = take_unit
        self._seen_us = 0
        self._is_over = False
        self._closing = ExitStack()
        self.connection = self._closing.enter_context(open_socket(url))
        self.connection.send(json.dumps({"type": "hello", "version": PAGE_VERSION, "token": urlsplit(url).fragment}))
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)
        self._thread.start()

    def arm(self) -> None:
        """Open the hand and close it until the car is armed; raise `WorkError` if it is not within 20 s."""
        limit_ns = self._clock.now().mono_ns + ARM_LIMIT_NS
        while self.status.get("safety") != "driving":
            if self._clock.now().mono_ns > limit_ns:
                raise WorkError(f"the car could not be armed: {self.status}")
            if self.status.get("hand") not in ("open", "held"):
                self.held = False
            elif self.status.get("phase") == "arming":
                self.held = True
            pause(INPUT_PERIOD_NS)

    def be_silent(self) -> None:
        """Send and read nothing more; the connection stays open."""
        self._is_over = True
        self._thread.join()

    def wait_closed(self) -> tuple[int, str]:
        """Wait until the console closes a silent page; return the code and the reason, or (0, "") without them."""
        try:
            while True:
                self.connection.recv(timeout=CLOSE_LIMIT_S)
        except ConnectionClosed as error:
            return (0, "") if error.rcvd is None else (error.rcvd.code, error.rcvd.reason)

    def close(self) -> None:
        """Close the page."""
        self.be_silent()
        self._closing.close()

    def input(self) -> bytes:
        """Return the input of now as the page sends it."""
        values = {"held": self.held, "live": True, "steering": self.steering, "throttle": self.throttle, "brake": 0}
        return json.dumps({"type": "input", "seen_us": self._seen_us, **values}).encode()

    def _run(self) -> None:
        input_ns = 0
        try:
            while not self._is_over:
                now_ns = self._clock.now().mono_ns
                if now_ns >= input_ns:
                    input_ns = now_ns + INPUT_PERIOD_NS
                    self._send_input()
                try:
                    message = self.connection.recv(timeout=max(input_ns - now_ns, 0) / NS_PER_S)
                except TimeoutError:
                    continue
                self._take(message)
        except ConnectionClosed:
            return

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, str):
            parsed = json.loads(message)
            if parsed["type"] == "status":
                self.status, self._seen_us = parsed, parsed["sent_us"]
                self.arrivals_ns.append(self._clock.now().mono_ns)
            return
        _kind, flags, _zero, unit, self._seen_us = UNIT_HEAD.unpack_from(message)
        if self._take_unit is not None:
            self._take_unit(message[UNIT_HEAD.size :], unit, bool(flags & 1))
        self.connection.send(json.dumps({"type": "ack", "unit": unit}))

    def _send_input(self) -> None:
        if self.status.get("role") == "drives":
            self.connection.send(self.input().decode())


def open_socket(url: str) -> ClientConnection:
    """Return a connection to the socket of the console at `url`, to be used as a context manager."""
    address = urlsplit(url)
    origin: Any = f"http://{address.netloc}"
    return connect(f"ws://{address.netloc}/socket", origin=origin, compression=None, proxy=None, close_timeout=1)
