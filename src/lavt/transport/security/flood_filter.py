"""How a flood of commands is kept from the one who may drive: the cheap checks, before anything is queued or recorded.

A command that may be obeyed goes on, once: its length, version, epoch and sequence are right, and its code where
messages are signed. Of all others only so many a second are looked at: enough for a record that says why, too few to
delay anybody.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Final

import msgpack

from lavt.domain import NS_PER_S
from lavt.transport.messages import MAX_MESSAGE_BYTES, VERSION

OTHERS_PER_S: Final = 200
"""Four clients that command at 50 Hz what is refused are all heard and recorded; 200 signatures take 3 % of a core."""
QUERIES_PER_S: Final = 100
"""Of each kind; a client asks once a second."""
_HEAD_BYTES: Final = 32
"""More than version, epoch and sequence take."""


class RateLimiter:
    """So many a second, and no more."""

    def __init__(self, per_s: int) -> None:
        self._per_s = per_s
        self._left = per_s
        self._since_ns = 0

    def take(self, now_ns: int) -> bool:
        """Take one, if there is one left in this second."""
        if now_ns - self._since_ns >= NS_PER_S:
            self._since_ns, self._left = now_ns, self._per_s
        self._left -= self._left >= 0
        return self._left >= 0


class FloodFilter:
    """Says whether a command is worth being looked at.

    `in_force` returns the epoch in force and the sequence number of the last accepted command;
    `is_from_active_operator` checks an envelope cheaply.
    """

    def __init__(
        self, in_force: Callable[[], tuple[int, int]], is_from_active_operator: Callable[[bytes], bool]
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._in_force = in_force
        self._is_from_active_operator = is_from_active_operator
        self._newest = (0, -1)
        """Epoch and sequence of the newest command that was let in; of one that the vehicle refuses they do not become
        those in force, and it may come again and again."""
        self._old = RateLimiter(OTHERS_PER_S)
        self._strange = RateLimiter(OTHERS_PER_S)
        """Apart from the others, so that a stranger cannot hide what the holder says under an old epoch."""

    def passes(self, data: bytes, body: bytes, now_ns: int) -> bool:
        """Tell whether `body`, which came in the envelope `data`, goes on."""
        from_active_operator = self._is_from_active_operator(data)
        epoch, sequence = self._in_force()
        if self._newest[0] == epoch:
            sequence = max(sequence, self._newest[1])
        if from_active_operator and may_be_accepted(body, epoch, sequence):
            return True
        if (self._old if from_active_operator else self._strange).take(now_ns):
            return True
        self.counts["commands_screened_out"] += 1
        return False

    def note(self, body: bytes) -> None:
        """A command that passed was authentic: from now on it and those before it are old."""
        head = _head(body)
        if head is not None and head[0] == self._in_force()[0]:
            self._newest = max(self._newest, head) if self._newest[0] == head[0] else head


def may_be_accepted(body: bytes, epoch: int, sequence: int) -> bool:
    """Tell from the beginning of a command whether it is of this epoch and newer than `sequence`."""
    head = _head(body)
    return head is not None and head[0] == epoch and head[1] > sequence


def _head(body: bytes) -> tuple[int, int] | None:
    """Read epoch and sequence from the beginning of a command; None for what is none of this version."""
    if len(body) > MAX_MESSAGE_BYTES:
        return None
    head = msgpack.Unpacker(max_buffer_size=_HEAD_BYTES)
    try:
        head.feed(body[:_HEAD_BYTES])
        head.read_array_header()
        version, its_epoch, its_sequence = head.unpack(), head.unpack(), head.unpack()
    except Exception:  # the parser has half a dozen kinds of error, and bytes from outside may cause any
        return None
    if type(version) is not int or version != VERSION or type(its_epoch) is not int or type(its_sequence) is not int:
        return None
    return its_epoch, its_sequence
