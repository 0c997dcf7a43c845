"""A real Firefox without a window, controlled over WebDriver BiDi."""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from tests.browser.chromium import START_LIMIT_S, ProtocolError, wait_until
from websockets.sync.client import ClientConnection, connect

PACKAGES: Final = ("firefox-esr",)
"""Debian packages; .ci/run installs them."""
PROGRAM: Final = "firefox-esr"
ARGUMENTS: Final = ("--headless", "--no-remote", "--remote-debugging-port=0")
LISTENING: Final = re.compile(r"BiDi listening on (ws://\S+)")
ANSWER_LIMIT_S: Final = 60.0
KEYS: Final = {
    "Space": " ",
    "ArrowLeft": "\ue012",
    "ArrowUp": "\ue013",
    "ArrowRight": "\ue014",
    "ArrowDown": "\ue015",
    "Escape": "\ue00c",
}
"""The values of WebDriver for the codes of keys."""
PREFERENCES: Final = {
    "app.normandy.enabled": False,
    "app.update.auto": False,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "services.settings.server": "data:,#remote-settings-dummy/v1",
    "toolkit.telemetry.enabled": False,
}
"""Settings with which Firefox contacts no server by itself."""


def is_missing() -> bool:
    """Return whether Firefox is not installed."""
    return shutil.which(PROGRAM) is None


class FirefoxTab:
    """A new window of a Firefox."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._numbers = itertools.count(1)
        self.call("session.new", capabilities={})
        # The first page of a Firefox without windows never has the focus, but that of a later window has.
        self._context: str = self.call("browsingContext.create", type="window")["context"]

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        number = next(self._numbers)
        self._connection.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(timeout=ANSWER_LIMIT_S))
            if answer.get("id") == number:
                if answer["type"] == "error":
                    raise ProtocolError(answer)
                result: dict[str, Any] = answer["result"]
                return result

    def navigate(self, url: str) -> None:
        """Load an address."""
        self.call("browsingContext.navigate", context=self._context, url=url, wait="complete")

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        result = self.call(
            "script.evaluate",
            expression=f"(async () => JSON.stringify(await ({expression})) ?? 'null')()",
            target={"context": self._context},
            awaitPromise=True,
        )
        assert result["type"] == "success", result
        return json.loads(result["result"]["value"])

    def key(self, code: str, *, down: bool) -> None:
        """Press or release a key."""
        self.keys({code: down})

    def keys(self, downs: Mapping[str, bool]) -> None:
        """Press or release several keys at once, each of a keyboard of its own: a call takes 50 ms or more."""
        values = {code: {"value": KEYS.get(code, code[-1])} for code in downs}
        actions = [
            {"type": "key", "id": code, "actions": [{"type": "keyDown" if down else "keyUp", **values[code]}]}
            for code, down in downs.items()
        ]
        self.call("input.performActions", context=self._context, actions=actions)

    def point(self, x: int = 300, y: int = 200) -> None:
        """Move the pointer to a place over the page."""
        action = {"type": "pointer", "id": "pointer", "actions": [{"type": "pointerMove", "x": x, "y": y}]}
        self.call("input.performActions", context=self._context, actions=[action])


@contextmanager
def running_firefox(profile: Path, preferences: Mapping[str, Any] = PREFERENCES) -> Iterator[FirefoxTab]:
    """Run Firefox with an empty profile and these preferences in this directory, and end all its processes."""
    profile.mkdir(parents=True, exist_ok=True)
    lines = (f"user_pref({json.dumps(name)}, {json.dumps(value)});\n" for name, value in preferences.items())
    (profile / "user.js").write_text("".join(lines))
    log = profile / "browser.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [PROGRAM, *ARGUMENTS, "--profile", str(profile), "about:blank"],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    try:
        wait_until("Firefox listens", lambda: LISTENING.search(log.read_text()) is not None, START_LIMIT_S)
        address = LISTENING.findall(log.read_text())[0]
        with connect(f"{address}/session", compression=None, max_size=2**26, proxy=None) as connection:
            yield FirefoxTab(connection)
    finally:
        os.killpg(process.pid, 9)
        process.wait()
