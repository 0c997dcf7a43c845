"""What Zenoh routers report, and whether the router in this process still answers.

A peer can answer a query for a router's report, too, and with anything.
"""

from __future__ import annotations

import faulthandler
import json
import os
import threading
from collections.abc import Callable, Iterable, Sequence, Set
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import Final, NamedTuple

from lavt.errors import WorkError
from lavt.transport.zenoh_config import error_text

CHECK_PERIOD_S: Final = 1.0
REPORT_TIMEOUT_S: Final = 5.0
MAX_REPORTS: Final = 64
"""The number of answers that are read: a peer can answer without end."""
MAX_UNANSWERED: Final = 3
"""A query can remain unanswered because the process was suspended meanwhile."""
FAILED_END_S: Final = 5.0
"""How long a process may take to end after its links are closed, if its router has failed."""


class Routers(NamedTuple):
    """The links and versions that a session's router and the routers linked to it report."""

    linked: int
    """The number of other routers to which the session's router is linked."""
    versions: tuple[str, ...]
    """Zenoh's version in every router that reports it, the session's router first."""


class RouterCheck:
    """A check of the router in this process, to be repeated; `query` returns the answers to a query for its report.

    A panic in Zenoh ends only one of its tasks, for example the handshake with one peer. But if this task changes the
    routing tables, they become unusable, and the router no longer delivers any message.
    """

    def __init__(self, query: Callable[[], Sequence[bytes]]) -> None:
        self.has_failed = False
        self._query = query
        self._unanswered = 0

    def run(self) -> None:
        """Query the router; raise `WorkError` if Zenoh fails, or after `MAX_UNANSWERED` queries without an answer."""
        try:
            self._unanswered = 0 if self._query() else self._unanswered + 1
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


def parse_locators(answers: Iterable[bytes]) -> list[str]:
    """Return the endpoints at which a router listens, with the actual port where the config has 0."""
    for answer in answers:
        with suppress(ValueError, TypeError, KeyError):
            locators: list[str] = json.loads(answer)["locators"]
            return locators
    raise WorkError(f"the router does not report within {REPORT_TIMEOUT_S:.0f} s where it listens")


def end_process_later() -> None:
    """End the process in `FAILED_END_S` with exit code 1, even if closing the session of a failed router never ends."""
    faulthandler.dump_traceback_later(FAILED_END_S, exit=True, file=Path(os.devnull).open("w"))  # noqa: SIM115


def parse_routers(answers: Iterable[bytes], own: Set[str]) -> Routers | None:
    """Return the links and versions that routers report; None if no router whose id is in `own` has answered."""
    reports: list[tuple[bool, int, str]] = []
    for answer in answers:
        with suppress(ValueError, TypeError, KeyError, AttributeError):
            report = json.loads(answer)
            linked = sum(peer["whatami"] == "router" for peer in report["sessions"])
            reports.append((report["zid"] not in own, linked, report["version"].partition("-")[0]))
    reports.sort(key=itemgetter(0))
    if not reports or reports[0][0]:
        return None
    return Routers(reports[0][1], tuple(version for _, _, version in reports))
