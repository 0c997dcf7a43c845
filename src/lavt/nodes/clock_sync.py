"""Writes down what the host's source of time says of its clock; the client's also probes the server's clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from lavt.domain import NS_PER_S, Now
from lavt.errors import BadMessage
from lavt.node import WAKE, Hop, Message, Send
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.probe import (
    SEQUENCES,
    ClockProbe,
    ProbeReply,
    decode_reply,
    decode_request,
    encode_reply,
    encode_request,
)

PERIOD_NS = NS_PER_S
"""Between two questions to the host's source of time."""
PROBES = 2
"""In that time. At 5 virtual time without pictures was 3 to 7 % slower, at 2 the difference is lost in the noise."""


class ClockSyncNode:
    """The server's: asks the host's source of time once a second, and answers probes."""

    name = "clock_sync"
    wakes = 1
    """In each period."""

    def __init__(self, start_ns: int) -> None:
        self.counts: Counter[str] = Counter()
        self._start_ns = start_ns
        self._tick = 0
        self._requested = -1
        self._period_ns = PERIOD_NS // self.wakes
        self._latest: ClockReport | None = None
        self.chains: Mapping[str, Sequence[Hop]] = {
            WAKE: (("ask", self._wake),),
            "clock_report": (("sample", self._sample),),
            **self._probing(),
        }

    def next_wake_ns(self) -> int:
        """When the next question is due."""
        return self._start_ns + self._tick * self._period_ns

    def _probing(self) -> dict[str, Sequence[Hop]]:
        return {"probe_request": (("answer", self._answer),)}

    def _wake(self, _message: Message, now: Now) -> list[Send]:
        gone_ns = now.mono_ns - self._start_ns
        self._tick = gone_ns // self._period_ns + 1  # by the grid: being late must not add up
        probes = self._probes(now)
        if gone_ns // PERIOD_NS == self._requested:
            return probes
        self._requested = gone_ns // PERIOD_NS
        return [Send("clock_query", None), *probes]

    def _probes(self, _now: Now) -> list[Send]:
        return []

    def _sample(self, message: Message, _now: Now) -> list[Send]:
        self._latest = message.payload
        return [Send("clock", message.payload)]

    def _answer(self, message: Message, now: Now) -> list[Send] | None:
        try:
            sequence, sent_wall_ns = decode_request(message.payload)
        except BadMessage:
            self.counts["probes_rejected"] += 1
            return None
        received_ns = message.arrived.wall_ns
        known = (None, None) if self._latest is None else (self._latest.correction_s, self._latest.bound_s)
        # Where the clock was set back in between, the answer says that it took no time: the time of arrival is lost.
        reply = ProbeReply(sequence, sent_wall_ns, received_ns, max(received_ns, now.wall_ns), *known)
        return [Send("probe_reply", encode_reply(reply), message.peer)]


class ProbingClockSyncNode(ClockSyncNode):
    """The client's: asks the host's source of time once a second, and the server for its time several times."""

    wakes = PROBES

    def __init__(self, start_ns: int) -> None:
        super().__init__(start_ns)
        self._sequence = 0
        self._sent_ns: dict[int, int] = {}

    def _probing(self) -> dict[str, Sequence[Hop]]:
        return {"probe_reply": (("compare", self._compare),)}

    def _probes(self, now: Now) -> list[Send]:
        """Ask, and remember when: a reply counts once, for a request of the last two seconds."""
        self._sequence = (self._sequence + 1) % SEQUENCES
        self._sent_ns[self._sequence] = now.wall_ns
        if len(self._sent_ns) > 2 * PROBES:
            self._sent_ns.pop(next(iter(self._sent_ns)))
            self.counts["probes_unanswered"] += 1
        return [Send("probe_request", encode_request(self._sequence, now.wall_ns))]

    def _compare(self, message: Message, _now: Now) -> list[Send] | None:
        try:
            reply = decode_reply(message.payload)
        except BadMessage:
            self.counts["probes_rejected"] += 1
            return None
        if self._sent_ns.get(reply.sequence) != reply.sent_wall_ns:
            self.counts["probes_rejected"] += 1
            return None
        del self._sent_ns[reply.sequence]
        times = (reply.sent_wall_ns, reply.received_wall_ns, reply.answered_wall_ns, message.arrived.wall_ns)
        return [Send("clock_probe", ClockProbe(reply.sequence, *times))]
