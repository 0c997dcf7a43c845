"""The limit of the messages from one page: too many of them would drop those of other pages from the queue."""

from __future__ import annotations

from enum import Enum, auto
from typing import Final

from lavt.domain import NS_PER_S
from lavt.transport.console.page_messages import is_stop

MAX_MESSAGES_PER_S: Final = 400
"""Further messages of a page in the same second are dropped. A page sends 50 inputs and two messages for each picture
in a second, and what it could not send before."""
MAX_STOPS_PER_S: Final = 20
"""Emergency stops are delivered also above the limit, up to this number; a page sends two in a second."""
MAX_DROPPED_PER_S: Final = 10 * MAX_MESSAGES_PER_S
"""A page from which more would be dropped is closed: reading them delays the messages of others."""


class Verdict(Enum):
    """What to do with a message."""

    DELIVER = auto()
    DROP = auto()
    CLOSE = auto()


class MessageLimit:
    """The numbers of messages that one page has sent in the present second."""

    def __init__(self) -> None:
        self._second = 0
        self._received = 0
        self._stops = 0

    def judge(self, message: str | bytes, now_ns: int) -> Verdict:
        """Return what to do with a message that arrives now. An emergency stop behind too many others is delivered."""
        second = now_ns // NS_PER_S
        if second != self._second:
            self._second, self._received, self._stops = second, 0, 0
        self._received += 1
        if self._received <= MAX_MESSAGES_PER_S:
            return Verdict.DELIVER
        if self._stops < MAX_STOPS_PER_S and is_stop(message):
            self._stops += 1
            return Verdict.DELIVER
        return Verdict.DROP if self._received <= MAX_MESSAGES_PER_S + MAX_DROPPED_PER_S else Verdict.CLOSE
