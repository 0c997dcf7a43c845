"""Run a message through the stages of a pipeline, and note when each stage ends."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from msgspec import Struct

from lavt.domain import Now
from lavt.node import Message, Send, Stage


class Timeline(Struct, frozen=True):
    """The end times of the stages of a pipeline, on the host's monotonic clock.

    The first entry of `stages`, "wait", is the time in the inbox; its end is the start of the first stage.
    `arrived_mono_ns` is the arrival of the message.
    """

    node: str
    channel: str
    stamp_ns: int
    arrived_mono_ns: int
    stages: tuple[tuple[str, int], ...]


class PipelineResult(Struct, frozen=True):
    """The result of a pipeline run: the sends, the end time, and the timeline if the result of a stage had a stamp."""

    sends: list[Send]
    end: Now
    timeline: Timeline | None
    stages_run: int
    """Number of stages that were called; fewer than all if one returned None."""


def run_stages(node: str, stages: Sequence[Stage], message: Message, start: Now, ends: Iterator[Now]) -> PipelineResult:
    """Run a message through the stages; `ends` yields the end time of each stage."""
    value: object = message
    now = start
    stamp_ns: int | None = None
    stage_ends = [("wait", start.mono_ns)]
    for name, stage in stages:
        value = stage(value, now)
        now = next(ends)
        stage_ends.append((name, now.mono_ns))
        stamp_ns = getattr(value, "stamp_ns", stamp_ns)
        if value is None:
            break
    timeline = None
    if stamp_ns:
        timeline = Timeline(node, message.channel, stamp_ns, message.arrived.mono_ns, tuple(stage_ends))
    return PipelineResult(value if isinstance(value, list) else [], now, timeline, len(stage_ends) - 1)
