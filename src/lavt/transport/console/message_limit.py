"""The limit of the messages from one page: too many of them would drop those of other pages from the queue."""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_S
from lavt.transport.console.page_messages import is_stop

MAX_MESSAGES_PER_S: Final = 400
"""Further messages of a page in the same second are dropped. A page sends 50 inputs and two messages for each picture
in a second, and what it could not send before. `read_limit.py` limits what it costs to read them."""
MAX_STOPS_PER_S: Final = 20
"""Emergency stops are delivered also above the limit, up to this number; a page sends two in a second."""


class MessageLimit:
    """The numbers of messages that one page has sent in the present second."""

    def __init__(self) -> None:
        self._second = 0
        self._received = 0
        self._stops = 0

    def allows(self, message: str | bytes, now_ns: int) -> bool:
        """Return whether to deliver a message that arrives now. An emergency stop behind too many others is."""
        second = now_ns // NS_PER_S
        if second != self._second:
            self._second, self._received, self._stops = second, 0, 0
        self._received += 1
        if self._received <= MAX_MESSAGES_PER_S:
            return True
        if self._stops < MAX_STOPS_PER_S and is_stop(message):
            self._stops += 1
            return True
        return False
