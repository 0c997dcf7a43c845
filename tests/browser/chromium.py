"""A real Chromium, by default without a window, controlled over the Chrome DevTools Protocol.

Libraries such as Playwright tell a page that it is visible and has the focus even if it is not, which makes tests of a
dead-man control worthless. The protocol itself does not.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from http.client import HTTPConnection
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from websockets.sync.client import connect

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S

PACKAGES: Final = ("chromium", "xvfb", "xdotool", "openbox")
"""Debian packages; .ci/run installs them."""
PROGRAM: Final = "chromium"
PROGRAMS: Final = (PROGRAM, "Xvfb", "xdotool", "openbox")
FOREIGN_NAME: Final = "attacker.example"
"""A name of another site that leads to this machine, as after DNS rebinding."""
START_LIMIT_S: Final = 60.0
POLL_NS: Final = 50 * NS_PER_MS
KEY_CODES: Final = {"Space": 32, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "Escape": 27}


def is_missing() -> bool:
    """Return whether Chromium, or a program with which a test uses its window, is not installed."""
    return any(shutil.which(program) is None for program in PROGRAMS)


def wait_until(expectation: str, condition: Callable[[], bool], limit_s: float = 30.0) -> None:
    """Wait until `condition()`; fail with the expectation after `limit_s`."""
    clock = MachineClock()
    limit_ns = clock.now().mono_ns + round(limit_s * NS_PER_S)
    while not condition():
        assert clock.now().mono_ns < limit_ns, f"not within {limit_s:g} s: {expectation}"
        pause(POLL_NS)


class ProtocolError(Exception):
    """The browser has answered a call with an error, for example because the page is not loaded yet."""


class Tab:
    """A tab of the browser."""

    def __init__(self, target: dict[str, Any]) -> None:
        self.target: str = target["id"]
        self._connection = ExitStack()
        uri = target["webSocketDebuggerUrl"]
        self._socket = self._connection.enter_context(connect(uri, compression=None, max_size=2**26, proxy=None))
        self._numbers = itertools.count(1)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=30))
            if answer.get("id") == number:
                if "error" in answer:
                    raise ProtocolError(answer["error"])
                result: dict[str, Any] = answer["result"]
                return result

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def has_loaded(self, url: str) -> bool:
        """Return whether the tab has loaded an address; before, a call can end with an error when the page changes."""
        try:
            at, state = self.evaluate("[location.href, document.readyState]")
        except ProtocolError:
            return False
        return (at.rstrip("/"), state) == (url.rstrip("/"), "complete")

    def key(self, code: str, *, down: bool) -> None:
        """Press or release a key."""
        event = {"code": code, "windowsVirtualKeyCode": KEY_CODES.get(code, ord(code[-1]))}
        self.call("Input.dispatchKeyEvent", type="rawKeyDown" if down else "keyUp", key=code, **event)

    def keys(self, downs: Mapping[str, bool]) -> None:
        """Press or release several keys."""
        for code, down in downs.items():
            self.key(code, down=down)

    def point(self, x: float = 300, y: float = 200) -> None:
        """Move the pointer to a place over the page."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def to_front(self) -> None:
        """Show this tab, which hides the others."""
        self.call("Page.bringToFront")

    def close(self) -> None:
        """Close the connection to the tab; the tab itself stays."""
        self._connection.close()


class Browser:
    """A running Chromium."""

    def __init__(self, process: subprocess.Popen[bytes], profile: Path) -> None:
        self.process = process
        self._profile = profile
        self._tabs: list[Tab] = []
        port_file = profile / "DevToolsActivePort"
        wait_until("Chromium listens", lambda: port_file.exists() and port_file.read_text() != "", START_LIMIT_S)
        self._port = int(port_file.read_text().splitlines()[0])

    def open(self, url: str) -> Tab:
        """Open an address in a new tab, in front of the others, and wait until it is loaded."""
        tab = Tab(json.loads(self._request("PUT", "/json/new?about:blank")))
        self._tabs.append(tab)
        tab.to_front()
        tab.call("Page.navigate", url=url)  # a new tab with an address stays empty at times
        wait_until(f"{url} is loaded", lambda: tab.has_loaded(url))
        return tab

    def close_tab(self, tab: Tab) -> None:
        """Close a tab."""
        self._request("GET", f"/json/close/{tab.target}")

    def _request(self, method: str, path: str) -> bytes:
        connection = HTTPConnection("127.0.0.1", self._port, timeout=30)
        with closing(connection):
            connection.request(method, path)
            return connection.getresponse().read()

    def renderers(self) -> list[int]:
        """Return the process ids of the browser's renderers."""
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    command = (entry / "cmdline").read_bytes()
                except OSError:
                    continue
                if b"--type=renderer" in command and str(self._profile).encode() in command:
                    found.append(int(entry.name))
        return found

    def close(self) -> None:
        """Close the connections to all tabs."""
        for tab in self._tabs:
            tab.close()


@contextmanager
def running_browser(
    profile: Path, display: str | None = None, *, environment: Mapping[str, str] = MappingProxyType({})
) -> Iterator[Browser]:
    """Run Chromium with an empty profile in this directory, and end all its processes.

    With `display`, it has a window there, at (50, 30). `environment` has further variables of its environment.
    """
    arguments = ["--disable-gpu", "--no-first-run"]
    if display is None:
        arguments += ["--headless=new", "--window-size=1280,800"]
    else:
        arguments += ["--window-size=1000,800", "--window-position=50,30"]
    arguments += ["--remote-debugging-port=0", "--remote-allow-origins=*", f"--user-data-dir={profile}"]
    arguments += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    arguments += [f"--host-resolver-rules=MAP {FOREIGN_NAME} 127.0.0.1"]
    arguments += ["--no-sandbox"] * (os.geteuid() == 0)
    profile.mkdir(parents=True, exist_ok=True)
    with (profile / "browser.log").open("wb") as log:
        process = subprocess.Popen(
            [PROGRAM, *arguments, "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=os.environ | dict(environment) | ({} if display is None else {"DISPLAY": display}),
            start_new_session=True,
        )
    browser = None
    try:
        browser = Browser(process, profile)
        yield browser
    finally:
        if browser is not None:
            browser.close()
        os.killpg(process.pid, 9)
        process.wait()
