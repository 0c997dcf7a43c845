"""Walking a message through a node's hops, each with its own `now`, and writing down when each was done."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lavt.domain import Now
from lavt.node import Hop, Message, Send
from lavt.value import value


@value
class Timeline:
    """When each hop of a chain was done, on the host's monotonic clock.

    The first entry is "wait": when the first hop began; `arrived_mono_ns` is when the message came.
    """

    node: str
    channel: str
    stamp_ns: int
    arrived_mono_ns: int
    stages: tuple[tuple[str, int], ...]


@value
class PipelineResult:
    """What came of a message: what to send, when the node was done, and the timeline where there is a stamp."""

    sends: list[Send]
    end: Now
    timeline: Timeline | None
    called: int
    """How many hops were called."""


def walk(node: str, stages: Sequence[Hop], message: Message, start: Now, ends: Iterator[Now]) -> PipelineResult:
    """Call hop after hop; `ends`, asked after each, gives the time when it was done."""
    value: object = message
    now = start
    stamp_ns: int | None = None
    done = [("wait", start.mono_ns)]
    for name, stage in stages:
        value = stage(value, now)
        now = next(ends)
        done.append((name, now.mono_ns))
        stamp_ns = getattr(value, "stamp_ns", stamp_ns)
        if value is None:
            break
    timeline = None
    if stamp_ns:
        timeline = Timeline(node, message.channel, stamp_ns, message.arrived.mono_ns, tuple(done))
    return PipelineResult(value if isinstance(value, list) else [], now, timeline, len(done) - 1)
