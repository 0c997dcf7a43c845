"""Cheap checks that keep a flood of commands away from the vehicle, before anything is queued or recorded.

A command is acceptable if its length, version, epoch and sequence are right, and its MAC if messages are signed. An
acceptable command always passes, once. Unacceptable commands pass at a limited rate, which is enough to record why they
are rejected, and too low to delay anything.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Final, NamedTuple

from lavt.domain import NS_PER_S, Command
from lavt.errors import BadMessage
from lavt.transport.messages import decode

UNACCEPTABLE_COMMANDS_PER_S: Final = 200
"""Enough to record all rejected commands of four clients at 50 Hz; 200 signatures take 3 % of a core."""
REQUESTS_PER_S: Final = 100
"""The limit for each channel of requests; a client sends one request a second."""


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


class _CommandHead(NamedTuple):
    """Epoch and sequence of a command."""

    epoch: int
    sequence: int


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
        self._newest = _CommandHead(0, -1)
        """Of the newest authentic command. If the vehicle rejects this command, `in_force` does not change, so the
        filter itself must recognize its replays."""
        self._active_operator_limiter = RateLimiter(UNACCEPTABLE_COMMANDS_PER_S)
        """A separate limit, so that no flood crowds out the active operator's commands of an old epoch."""
        self._other_limiter = RateLimiter(UNACCEPTABLE_COMMANDS_PER_S)

    def passes(self, data: bytes, body: bytes, now_ns: int) -> bool:
        """Return whether the command `body`, received in the envelope `data`, passes."""
        from_active_operator = self._is_from_active_operator(data)
        epoch, sequence = self._in_force()
        if self._newest.epoch == epoch:
            sequence = max(sequence, self._newest.sequence)
        if from_active_operator and may_be_accepted(body, epoch, sequence):
            return True
        if (self._active_operator_limiter if from_active_operator else self._other_limiter).take(now_ns):
            return True
        self.counts["commands_screened_out"] += 1
        return False

    def note_authentic(self, body: bytes) -> None:
        """Note a verified command of the active operator: from now on this command and earlier ones are replays."""
        head = _head(body)
        epoch, _ = self._in_force()
        if head is not None and head.epoch == epoch:
            self._newest = max(self._newest, head) if self._newest.epoch == epoch else head


def may_be_accepted(body: bytes, epoch: int, sequence: int) -> bool:
    """Return whether a command has this epoch and a higher sequence number than `sequence`."""
    head = _head(body)
    return head is not None and head.epoch == epoch and head.sequence > sequence


def _head(body: bytes) -> _CommandHead | None:
    """Return epoch and sequence of a command; None for anything else."""
    try:
        command = decode(Command, body)
    except BadMessage:
        return None
    return _CommandHead(command.epoch, command.sequence)
