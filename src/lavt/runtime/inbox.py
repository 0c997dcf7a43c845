"""What waits for a busy node: packets queue, of pictures and states only the newest stays; what is lost is counted."""

from __future__ import annotations

from collections import Counter, deque

from lavt.node import Message
from lavt.transport.channels import CHANNELS, QUEUE_LENGTH


class Inbox:
    """Messages in the order in which a node shall see them: all that queues first, then the newest of the rest."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._queue: deque[Message] = deque()
        self._newest: dict[str, Message] = {}

    def put(self, message: Message) -> None:
        """Let a message wait."""
        if CHANNELS[message.channel].waiting == "newest":
            if message.channel in self._newest:
                self.counts[f"{message.channel}_replaced"] += 1
            self._newest[message.channel] = message
            return
        if len(self._queue) >= QUEUE_LENGTH:
            self.counts[f"{self._queue.popleft().channel}_dropped"] += 1
        self._queue.append(message)

    def take(self) -> Message | None:
        """Take the next message; None when nothing waits."""
        if self._queue:
            return self._queue.popleft()
        if self._newest:
            return self._newest.pop(next(iter(self._newest)))
        return None
