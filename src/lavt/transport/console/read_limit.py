"""Limits of what connections may cost: reading frames takes processor time from the thread that makes the commands.

A message that is valid costs as much as one that is not, so frames and reads are counted before they mean anything. A
page that is closed can connect again, so new connections and new pages have limits for all of them together.
"""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_S

READS_PER_S: Final = 600
"""How many frames and reads of a page are processed in a second. A page at 30 Hz sends 110 frames in a second, each in
a read of its own, and one at 60 Hz 170."""
MAX_READS: Final = 1200
"""How many it can save up: more than it sends in the second after which the client must have read it."""
FIRST_READS: Final = 300
"""What a new page has. It is less, so that a page gains nothing by connecting again."""
MAX_STRANGER_READS: Final = 64
"""How many frames and reads are processed before the token. A browser needs three."""
CONNECTIONS_PER_S: Final = 50
MAX_CONNECTIONS: Final = 300
"""How many connections are accepted together. A browser makes 20 of them when it loads the page."""
OPENINGS_PER_S: Final = 2
MAX_OPENINGS: Final = 16
"""How many pages may show the token together: all pages twice."""


class RefillingLimit:
    """A limit that allows `first` events, and `per_s` more in each second, but never more than `most` together."""

    def __init__(self, per_s: int, most: int, first: int | None = None) -> None:
        self._per_s, self._most = per_s, most * NS_PER_S
        self._left = self._most if first is None else first * NS_PER_S
        """Events, each as `NS_PER_S`."""
        self._since_ns: int | None = None

    def take(self, now_ns: int) -> bool:
        """Count one event, and return whether it is within the limit."""
        if self._since_ns is not None:
            self._left = min(self._most, self._left + (now_ns - self._since_ns) * self._per_s)
        self._since_ns = now_ns
        if self._left < NS_PER_S:
            return False
        self._left -= NS_PER_S
        return True


class ReadLimits:
    """The limit of each connection for its frames and reads."""

    def __init__(self) -> None:
        self._limits: dict[object, RefillingLimit] = {}

    def add(self, connection: object) -> None:
        """Add a connection that has not shown the token."""
        self._limits[connection] = RefillingLimit(0, MAX_STRANGER_READS)

    def admit(self, connection: object) -> None:
        """Give a connection the limit of a page, because it has shown the token."""
        if connection in self._limits:
            self._limits[connection] = RefillingLimit(READS_PER_S, MAX_READS, FIRST_READS)

    def remove(self, connection: object) -> None:
        """Forget a connection that has ended."""
        self._limits.pop(connection, None)

    def take(self, connection: object, now_ns: int) -> bool:
        """Count a frame or a read of a connection, and return whether it is within its limit."""
        limit = self._limits.get(connection)
        return limit is not None and limit.take(now_ns)
