"""The inbox of a node: for each channel a bounded queue, or only the newest message. Losses are counted."""

from __future__ import annotations

from collections import Counter, defaultdict, deque

from lavt.channels import CHANNELS
from lavt.node import Message


class Inbox:
    """The waiting messages of a node: queued messages come first, in order of arrival, then those of "newest" channels.

    Each channel has its own queue, so that a flood on one channel loses no message of another.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.message_count = 0
        """Number of messages in the inbox."""
        self._number = 0
        self._queues: defaultdict[str, deque[tuple[int, Message]]] = defaultdict(deque)
        """By channel, the messages with their numbers in order of arrival."""
        self._newest: dict[str, Message] = {}

    def is_empty(self) -> bool:
        """Return whether no message waits."""
        return self.message_count == 0

    def put(self, message: Message) -> None:
        """Add a message."""
        channel = CHANNELS[message.channel]
        if channel.waiting == "newest":
            if message.channel in self._newest:
                self.counts[f"{message.channel}_replaced"] += 1
            else:
                self.message_count += 1
            self._newest[message.channel] = message
            return
        queue = self._queues[message.channel]
        if len(queue) >= channel.length:
            queue.popleft()
            self.counts[f"{message.channel}_dropped"] += 1
        else:
            self.message_count += 1
        self._number += 1
        queue.append((self._number, message))

    def take(self) -> Message | None:
        """Remove and return the next message; None: no message waits."""
        if not self.message_count:
            return None
        self.message_count -= 1
        first_queue = None  # the queue whose first message has the lowest number
        for queue in self._queues.values():
            if queue and (first_queue is None or queue[0][0] < first_queue[0][0]):
                first_queue = queue
        if first_queue is not None:
            return first_queue.popleft()[1]
        return self._newest.pop(next(iter(self._newest)))

    def take_arrived(self, until_ns: int) -> Message | None:
        """Remove and return a queued message of an inline channel that arrived by `until_ns` (monotonic), or None.

        A message of an inline channel is queued only if its pipeline could not run in the thread that delivered it. A
        runtime processes these messages before a wake that was due at `until_ns`.
        """
        for channel, queue in self._queues.items():
            if CHANNELS[channel].inline and queue and queue[0][1].arrived.mono_ns <= until_ns:
                self.message_count -= 1
                return queue.popleft()[1]
        return None
