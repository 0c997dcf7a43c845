"""Cheap checks that keep a flood of commands away from the vehicle, before anything is queued or recorded.

A command that the vehicle may accept always passes, once. Its length, version, epoch and sequence must be right, and
its MAC if messages are signed. All others pass at a limited rate, which is enough for a record that gives the reason
and too low to delay anything.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Final

from lavt.domain import NS_PER_S, Command
from lavt.errors import BadMessage
from lavt.transport.messages import decode

OTHER_COMMANDS_PER_S: Final = 200
"""Enough to record all rejected commands of four clients at 50 Hz; 200 signatures take 3 % of a core."""
QUERIES_PER_S: Final = 100
"""Per channel; a client sends one a second."""


class RateLimiter:
    """A limit on the number of messages per second, counted in windows of one second."""

    def __init__(self, per_s: int) -> None:
        self._per_s = per_s
        self._left = per_s
        self._since_ns = 0

    def take(self, now_ns: int) -> bool:
        """Count one message; return whether it is within the limit."""
        if now_ns - self._since_ns >= NS_PER_S:
            self._since_ns, self._left = now_ns, self._per_s
        self._left -= self._left >= 0
        return self._left >= 0


class FloodFilter:
    """A filter that decides which commands are worth verifying.

    `in_force` returns the epoch in force and the sequence number of the last accepted command;
    `is_from_active_operator` checks the MAC of an envelope.
    """

    def __init__(
        self, in_force: Callable[[], tuple[int, int]], is_from_active_operator: Callable[[bytes], bool]
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._in_force = in_force
        self._is_from_active_operator = is_from_active_operator
        self._newest = (0, -1)
        """Epoch and sequence of the newest authentic command. The vehicle may reject it, and then `in_force` does not
        change, so replays of it must be recognized here."""
        self._active_operator_limiter = RateLimiter(OTHER_COMMANDS_PER_S)
        """Separate, so that others cannot crowd out the active operator's commands of an old epoch."""
        self._other_limiter = RateLimiter(OTHER_COMMANDS_PER_S)

    def passes(self, data: bytes, body: bytes, now_ns: int) -> bool:
        """Return whether the command `body`, received in the envelope `data`, passes."""
        from_active_operator = self._is_from_active_operator(data)
        epoch, sequence = self._in_force()
        if self._newest[0] == epoch:
            sequence = max(sequence, self._newest[1])
        if from_active_operator and may_be_accepted(body, epoch, sequence):
            return True
        if (self._active_operator_limiter if from_active_operator else self._other_limiter).take(now_ns):
            return True
        self.counts["commands_screened_out"] += 1
        return False

    def note_authentic(self, body: bytes) -> None:
        """Note a verified command of the active operator: from now on it and earlier ones are replays."""
        head = _head(body)
        if head is not None and head[0] == self._in_force()[0]:
            self._newest = max(self._newest, head) if self._newest[0] == head[0] else head


def may_be_accepted(body: bytes, epoch: int, sequence: int) -> bool:
    """Return whether the head of a command has this epoch and a newer sequence number than `sequence`."""
    head = _head(body)
    return head is not None and head[0] == epoch and head[1] > sequence


def _head(body: bytes) -> tuple[int, int] | None:
    """Return epoch and sequence of a command; None for anything else."""
    try:
        command = decode(Command, body)
    except BadMessage:
        return None
    return command.epoch, command.sequence
