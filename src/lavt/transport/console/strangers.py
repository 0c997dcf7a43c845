"""The connections that have not shown the token yet. Anybody on this machine can make them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

MAX_STRANGERS: Final = 128
"""A further connection closes the oldest one. A page shows the token within milliseconds, and asyncio accepts at most
100 connections before it reads from them."""
MAX_STRANGER_BYTES: Final = 16 * 1024
"""A connection that sends more is closed unread. The request of a browser, with the cookies of all ports of this
machine, and the first message are smaller."""


@dataclass(slots=True)
class _Stranger:
    abort: Callable[[], None]
    received: int = 0
    """Bytes."""


class Strangers:
    """The connections that have not shown the token, oldest first."""

    def __init__(self, counts: Counter[str]) -> None:
        self._counts = counts
        self._strangers: dict[object, _Stranger] = {}

    def add(self, connection: object, abort: Callable[[], None]) -> None:
        """Add a new connection, which `abort()` closes; if there are too many, close the oldest one."""
        self._strangers[connection] = _Stranger(abort)
        if len(self._strangers) > MAX_STRANGERS:
            self._abort(next(iter(self._strangers)), "connections_too_many")

    def remove(self, connection: object) -> None:
        """Forget a connection that has shown the token, or has ended."""
        self._strangers.pop(connection, None)

    def may_read(self, connection: object, size: int) -> bool:
        """Count the bytes of a connection, and return whether to read them; if there are too many, close it."""
        stranger = self._strangers.get(connection)
        if stranger is None:
            return True
        stranger.received += size
        if stranger.received <= MAX_STRANGER_BYTES:
            return True
        self._abort(connection, "connections_too_long")
        return False

    def _abort(self, connection: object, why: str) -> None:
        self._counts[why] += 1
        self._strangers.pop(connection).abort()
