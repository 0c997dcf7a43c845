"""Writes down once a second what the host's source of time says of the host's clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from lavt.domain import NS_PER_S, Now
from lavt.node import WAKE, Hop, Message, Send
from lavt.nodes.reports import ClockSample
from lavt.transport.clock_offset import ClockReport

PERIOD_NS = NS_PER_S


class ClockSyncNode:
    """Asks the host's source of clock reports, and pairs each report with a reading of both clocks."""

    name = "clock_sync"

    def __init__(self, start_ns: int) -> None:
        self.counts: Counter[str] = Counter()
        self._next_ns = start_ns
        self.chains: Mapping[str, Sequence[Hop]] = {
            WAKE: (("ask", self._ask),),
            "clock_report": (("sample", self._sample),),
        }

    def next_wake_ns(self) -> int:
        """When the next report is due."""
        return self._next_ns

    def _ask(self, _message: Message, now: Now) -> list[Send]:
        late_ns = now.mono_ns - self._next_ns
        self._next_ns += (late_ns // PERIOD_NS + 1) * PERIOD_NS  # by the grid: being late must not add up
        return [Send("clock_query", None)]

    def _sample(self, message: Message, now: Now) -> list[Send]:
        report: ClockReport = message.payload
        sample = ClockSample(now.mono_ns, now.wall_ns, report.host, report.source, report.correction_s, report.bound_s)
        return [Send("clock", sample)]
