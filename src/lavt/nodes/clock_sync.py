"""The nodes that record the clock offset: reports of the host's time source, and probes between client and server."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from lavt.domain import NS_PER_S, Now
from lavt.errors import BadMessage
from lavt.node import WAKE, Message, Send, Stage
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
"""Period of the queries of the host's time source."""
PROBES_PER_PERIOD = 2
"""With 5, runs in virtual time without pictures took 3 to 7 % longer; with 2 no difference could be measured."""


class ClockSyncNode:
    """The server's node, which queries the host's time source once a second and answers probes."""

    name = "clock_sync"
    wakes_per_period = 1

    def __init__(self, start_ns: int) -> None:
        self.counts: Counter[str] = Counter()
        self._start_ns = start_ns
        self._next_wake_number = 0
        self._queried_period = -1
        self._wake_period_ns = PERIOD_NS // self.wakes_per_period
        self._latest: ClockReport | None = None
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            WAKE: (("ask", self._wake),),
            "clock_report": (("sample", self._sample),),
            **self._probe_pipelines(),
        }

    def next_wake_ns(self) -> int:
        """Return when the next query or probe is due."""
        return self._start_ns + self._next_wake_number * self._wake_period_ns

    def _probe_pipelines(self) -> dict[str, Sequence[Stage]]:
        return {"probe_request": (("answer", self._answer),)}

    def _wake(self, _message: Message, now: Now) -> list[Send]:
        elapsed_ns = now.mono_ns - self._start_ns
        # The next wake is at a multiple of the period, so that lateness does not accumulate.
        self._next_wake_number = elapsed_ns // self._wake_period_ns + 1
        probes = self._probes(now)
        if elapsed_ns // PERIOD_NS == self._queried_period:
            return probes
        self._queried_period = elapsed_ns // PERIOD_NS
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
        latest = self._latest
        correction_and_bound = (None, None) if latest is None else (latest.correction_s, latest.bound_s)
        # If the clock was set back since the arrival, the reply shows a duration of 0, because the true one is unknown.
        answered_ns = max(received_ns, now.wall_ns)
        reply = ProbeReply(sequence, sent_wall_ns, received_ns, answered_ns, *correction_and_bound)
        return [Send("probe_reply", encode_reply(reply), message.peer)]


class ProbingClockSyncNode(ClockSyncNode):
    """The client's node, which queries the host's time source and also probes the server's clock."""

    wakes_per_period = PROBES_PER_PERIOD

    def __init__(self, start_ns: int) -> None:
        super().__init__(start_ns)
        self._sequence = 0
        self._sent_ns: dict[int, int] = {}

    def _probe_pipelines(self) -> dict[str, Sequence[Stage]]:
        return {"probe_reply": (("compare", self._compare),)}

    def _probes(self, now: Now) -> list[Send]:
        """Return a probe. One reply to it is accepted, within two seconds."""
        self._sequence = (self._sequence + 1) % SEQUENCES
        self._sent_ns[self._sequence] = now.wall_ns
        if len(self._sent_ns) > 2 * PROBES_PER_PERIOD:
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
