"""What takes inputs: a node on a bench whose time goes by as it is told, and what must hold after each input."""

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


class Wrong(Exception):
    """Something happened that no input may lead to."""


@dataclass
class Target:
    """A parser, or a node with its parsers.

    `feed` takes one input and raises `Wrong` where something happened that must not; any other error is the parser's.
    """

    corpora: Mapping[str, Corpus]
    """By channel."""
    feed: Callable[[str, bytes, Chance], None]
    rejected: Callable[[], int]
    """How many inputs were refused until now."""
    finish: Callable[[], str] = field(default=lambda: "")
    """Checks what must hold in the end, and gives something to say of the run."""


class Bench:
    """A node, both clocks of its host, and what became of what it was given."""

    def __init__(self, node: Node, hear: Callable[[Send], None] = lambda _send: None) -> None:
        self.node = node
        self.now = START
        self._hear = hear

    def give(self, channel: str, payload: Any, peer: Any = None) -> list[Send]:
        """Walk one message through the node."""
        message = Message(channel, payload, self.now, peer)
        stages = self.node.pipelines[channel]
        sends = run_stages(self.node.name, stages, message, self.now, repeat(self.now)).sends
        for send in sends:
            self._hear(send)
        return sends

    def go(self, duration_ns: int) -> None:
        """Let time pass, and wake the node whenever it asked to be woken."""
        end = self.now.later(duration_ns)
        while (wake_ns := self.node.next_wake_ns()) is not None and wake_ns <= end.mono_ns:
            self.now = self.now.later(max(0, wake_ns - self.now.mono_ns))
            self.give(WAKE, None)
            if self.node.next_wake_ns() == wake_ns:
                raise Wrong(f"{self.node.name} asks for the same wake again and again")
        self.now = end


def expect(holds: bool, otherwise: str) -> None:
    """Raise `Wrong` where something does not hold."""
    if not holds:
        raise Wrong(otherwise)


def of(sends: Iterable[Send], channel: str) -> list[Any]:
    """Give the payloads on one channel."""
    return [send.payload for send in sends if send.channel == channel]


def total(counts: Mapping[str, int], *beginnings: str) -> int:
    """Add up the counters whose names begin so."""
    return sum(count for name, count in counts.items() if name.startswith(beginnings))
