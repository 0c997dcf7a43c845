"""The form of a fuzz target, and a bench that runs a node in simulated time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any

from benchmarks.fuzzing.mutation import Chance, Corpus

from lavt.domain import NS_PER_S, Now
from lavt.node import WAKE, Message, Node, Send
from lavt.runtime.pipeline import run_stages

START = Now(1_000 * NS_PER_S, 1_790_000_000 * NS_PER_S)


class InvariantViolation(Exception):
    """An input broke an invariant: a condition that must be true after every input."""


@dataclass
class Target:
    """A parser, or a node with its parsers, and the corpora from which its inputs are made."""

    corpora: Mapping[str, Corpus]
    """The corpora by channel."""
    feed: Callable[[str, bytes, Chance], None]
    """Delivers one input on a channel, and checks the invariants; any error but `InvariantViolation` is a parser's."""
    rejected_count: Callable[[], int]
    """Returns the number of rejected inputs."""
    finish: Callable[[], str] = field(default=lambda: "")
    """Checks the final invariants and returns a summary of the run."""


class NodeBench:
    """A node in simulated time; `on_send` is called with each message that the node sends."""

    def __init__(self, node: Node, on_send: Callable[[Send], None] = lambda _send: None) -> None:
        self.node = node
        self.now = START
        self._on_send = on_send

    def deliver(self, channel: str, payload: Any, peer: Any = None) -> list[Send]:
        """Deliver a message to the node and return the messages that the node sends."""
        message = Message(channel, payload, self.now, peer)
        stages = self.node.pipelines[channel]
        sends = run_stages(self.node.name, stages, message, self.now, repeat(self.now)).sends
        for send in sends:
            self._on_send(send)
        return sends

    def advance(self, duration_ns: int) -> None:
        """Advance the time, and wake the node at each of its wake times."""
        end = self.now.later(duration_ns)
        while (wake_ns := self.node.next_wake_ns()) is not None and wake_ns <= end.mono_ns:
            self.now = self.now.later(max(0, wake_ns - self.now.mono_ns))
            self.deliver(WAKE, None)
            if self.node.next_wake_ns() == wake_ns:
                raise InvariantViolation(f"{self.node.name} does not advance its wake time")
        self.now = end


def expect(condition: bool, violation: str) -> None:
    """Raise `InvariantViolation` with the text `violation` if `condition` is false."""
    if not condition:
        raise InvariantViolation(violation)


def payloads_on(sends: Iterable[Send], channel: str) -> list[Any]:
    """Return the payloads that were sent on a channel."""
    return [send.payload for send in sends if send.channel == channel]


def total(counts: Mapping[str, int], *prefixes: str) -> int:
    """Return the sum of the counters whose names begin with one of the prefixes."""
    return sum(count for name, count in counts.items() if name.startswith(prefixes))
