"""Whether a Zenoh router in this process still answers; a session is an object of type `zenoh.Session`."""

from __future__ import annotations

import faulthandler
import json
import os
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from lavt.errors import WorkError
from lavt.transport.zenoh_config import error_text

CHECK_PERIOD_S: Final = 1.0
REPORT_TIMEOUT_S: Final = 5.0
MAX_UNANSWERED: Final = 3
"""A query can remain unanswered because the process was suspended meanwhile."""
FAILED_END_S: Final = 5.0
"""How long a process may take to end after its links are closed, if its router has failed."""


class RouterCheck:
    """A check of the router of a session, to be repeated.

    A panic in Zenoh ends only one of its tasks, for example the handshake with one peer. But if this task changes the
    routing tables, they become unusable, and the router no longer delivers any message.
    """

    def __init__(self, session: Any) -> None:
        self.has_failed = False
        self._session = session
        self._unanswered = 0

    def run(self) -> None:
        """Query the router; raise `WorkError` if Zenoh fails, or after `MAX_UNANSWERED` queries without an answer."""
        try:
            self._unanswered = 0 if any(True for _ in _reports(self._session)) else self._unanswered + 1
        except BaseException as error:  # a panic is not an `Exception`
            self._fail(error_text(error))
        if self._unanswered >= MAX_UNANSWERED:
            self._fail(f"{self._unanswered} queries in a row had no answer")

    def repeat(self, closing: threading.Event) -> None:
        """Run the check again and again until `closing` is set."""
        while not closing.wait(CHECK_PERIOD_S):
            try:
                self.run()
            except WorkError:
                if not closing.is_set():
                    raise

    def _fail(self, reason: str) -> None:
        self.has_failed = True
        raise WorkError(f"the Zenoh router in this process has failed: {reason}")


def router_locators(session: Any) -> list[str]:
    """Return the endpoints at which the router of a session listens, with the actual port where the config has 0."""
    for report in _reports(session):
        with suppress(ValueError, TypeError, KeyError):  # a peer can answer, too
            locators: list[str] = json.loads(report)["locators"]
            return locators
    raise WorkError(f"the router does not report within {REPORT_TIMEOUT_S:.0f} s where it listens")


def end_process_later() -> None:
    """End the process in `FAILED_END_S` with exit code 1, even if closing the session of a failed router never ends."""
    faulthandler.dump_traceback_later(FAILED_END_S, exit=True, file=Path(os.devnull).open("w"))  # noqa: SIM115


def _reports(session: Any) -> Iterator[str]:
    """Query the router of a session for its report, and yield each answer."""
    for reply in session.get(f"@/{session.info.zid()}/router", timeout=REPORT_TIMEOUT_S):
        if reply.ok is not None:
            yield reply.ok.payload.to_string()
