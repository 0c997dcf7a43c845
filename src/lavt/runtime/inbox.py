"""What waits for a busy node: packets queue, of pictures and states only the newest stays; what is lost is counted."""

from __future__ import annotations

from collections import Counter, defaultdict, deque

from lavt.channels import CHANNELS
from lavt.node import Message


class Inbox:
    """Messages in the order in which a node shall see them: all that queues first, then the newest of the rest.

    Each channel has a queue of its own length, so that a flood on one loses nothing of another.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.waiting = 0
        """How many messages wait."""
        self._number = 0
        self._queues: defaultdict[str, deque[tuple[int, Message]]] = defaultdict(deque)
        self._newest: dict[str, Message] = {}

    def is_empty(self) -> bool:
        """Whether no message waits."""
        return self.waiting == 0

    def put(self, message: Message) -> None:
        """Let a message wait."""
        row = CHANNELS[message.channel]
        if row.waiting == "newest":
            if message.channel in self._newest:
                self.counts[f"{message.channel}_replaced"] += 1
            else:
                self.waiting += 1
            self._newest[message.channel] = message
            return
        queue = self._queues[message.channel]
        if len(queue) >= row.length:
            queue.popleft()
            self.counts[f"{message.channel}_dropped"] += 1
        else:
            self.waiting += 1
        self._number += 1
        queue.append((self._number, message))

    def take(self) -> Message | None:
        """Take the next message; None when nothing waits."""
        if not self.waiting:
            return None
        self.waiting -= 1
        first = None
        for queue in self._queues.values():
            if queue and (first is None or queue[0][0] < first[0][0]):
                first = queue
        if first is not None:
            return first.popleft()[1]
        return self._newest.pop(next(iter(self._newest)))

    def take_arrived(self, until_ns: int) -> Message | None:
        """Take a message that had arrived by a time of the monotonic clock.

        Only of a channel that queues and is walked at once: where only the newest counts a wake does not wait for it.
        """
        for channel, queue in self._queues.items():
            if CHANNELS[channel].at_once and queue and queue[0][1].arrived.mono_ns <= until_ns:
                self.waiting -= 1
                return queue.popleft()[1]
        return None
