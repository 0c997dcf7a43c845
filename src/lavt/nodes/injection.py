"""The network's condition: the client asks for it, and each side sees that its own machine's queues follow.

A condition lasts as long as the client goes on asking for it: a lease that nobody renews ends, and everything is put
back. Neither node touches a queue; the link that carries `inject` does, and tells what it measured.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Literal

from lavt.domain import NS_PER_MS, NS_PER_S, NetemReply, NetemRequest, Now
from lavt.errors import BadMessage, UserError
from lavt.node import WAKE, Hop, Message, Peer, Send
from lavt.nodes.payloads import InjectionSample, StationaryStatus
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment, check_flows
from lavt.transport.messages import decode, encode
from lavt.transport.netem.injector import InjectionOrder, InjectionResult
from lavt.value import value

MEASURE_PERIOD_NS = 5 * NS_PER_S
"""A condition in force is measured as often."""
ASK_PERIOD_NS = NS_PER_S
LEASE_MS = 5_000
"""The client asks once a second: four may be lost."""
LONGEST_REASON = 300
QUESTIONS_KEPT = 64
"""So many wait for the queues; as many as the link keeps."""


class _Queues:
    """What this machine's queues were told, and whether they do it."""

    def __init__(self) -> None:
        self.flows: tuple[ImpairedFlow, ...] = ()
        self.condition = ""
        self.in_force = False
        self.again_ns: int | None = None
        """When the order is given again: to measure what is in force, or because it failed."""
        self._number = 0

    def tell(self, condition: str, flows: tuple[ImpairedFlow, ...]) -> list[Send]:
        self.condition, self.flows, self.in_force, self.again_ns = condition, flows, False, None
        self._number += 1
        return self._inject()

    def tell_again_when_due(self, now_ns: int) -> list[Send]:
        if self.again_ns is None or now_ns < self.again_ns:
            return []
        self.again_ns = None  # set anew by the answer
        return self._inject() if self.in_force else self.tell(self.condition, self.flows)

    def note(self, done: InjectionResult, now: Now) -> list[Send] | None:
        """Take in what became of the newest order; None where it was an older one."""
        if done.number != self._number:
            return None
        self.in_force = done.reason == ""
        if not self.in_force:
            self.again_ns = now.mono_ns + ASK_PERIOD_NS
        elif self.condition:
            self.again_ns = now.mono_ns + MEASURE_PERIOD_NS
        requested_ms: dict[str, float] = {flow.name: flow.impairment.delay_ms for flow in self.flows} or {"": 0.0}
        measured_ms = dict(done.measured_ms)
        return [
            Send(
                "injection",
                InjectionSample(
                    now.mono_ns, self.condition, name, each_ms, measured_ms.get(name), done.reason or done.problems
                ),
            )
            for name, each_ms in requested_ms.items()
        ]

    def _inject(self) -> list[Send]:
        return [Send("inject", InjectionOrder(self._number, self.condition, self.flows))]


@value
class Lease:
    """Who has the network's condition in hand, and until when."""

    active_operator: tuple[str, int]
    until_ns: int


class InjectionNode:
    """The server's: lets one client at a time say what happens to what this machine sends.

    A vehicle that is not `simulated` must stand disarmed for a change; that a lease ends is never in its way.
    """

    name = "injection"

    def __init__(
        self,
        *,
        allowed: bool,
        simulated: bool,
        video_port: int,
        control: tuple[Literal["udp", "tcp"], int],
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._allowed = allowed
        self._simulated = simulated
        self._video_port = video_port
        self._control = control
        self._queues = _Queues()
        self._lease: Lease | None = None
        self._rest = StationaryStatus(False, None)
        self._waiting: deque[Peer] = deque(maxlen=QUESTIONS_KEPT)
        self.chains: Mapping[str, Sequence[Hop]] = {
            "netem": (("answer", self._answer),),
            "injected": (("note", self._note_injected),),
            "rest": (("note", self._note_rest),),
            WAKE: (("look", self._look),),
        }

    def next_wake_ns(self) -> int | None:
        """When the lease ends, the condition is measured again, or what failed is tried again."""
        ends_ns = None if self._lease is None else self._lease.until_ns
        return _first(ends_ns, self._queues.again_ns)

    def _answer(self, message: Message, now: Now) -> list[Send]:
        try:
            request = decode(NetemRequest, message.payload)
        except BadMessage:
            self.counts["netem_requests_unreadable"] += 1
            return []
        flows = self._flows(request)
        changes = flows != self._queues.flows or request.condition != self._queues.condition
        rejection = self._rejection(request, changes=changes)
        self.counts[f"netem {'refused' if rejection else 'granted'}"] += 1
        if rejection:
            return [_reply(rejection, message.peer)]
        self._lease = Lease((request.who, request.instance), now.mono_ns + request.lease_ms * NS_PER_MS)
        if not changes and self._queues.in_force:
            return [_reply("", message.peer)]
        self._waiting.append(message.peer)
        return self._queues.tell(request.condition, flows) if changes else []

    def _rejection(self, request: NetemRequest, *, changes: bool) -> str:
        if not self._allowed:
            return "this server lets nobody inject delay: set injection.remote: true in its config"
        asking = (request.who, request.instance)
        if self._lease is not None and self._lease.active_operator != asking:
            return f"{self._lease.active_operator[0]} has the condition in hand until its lease ends"
        if self._rest.active_operator is not None and self._rest.active_operator != asking:
            return f"{self._rest.active_operator[0]} holds the vehicle"
        if changes and not (self._simulated or self._rest.at_rest):
            return "a vehicle that is not simulated must stand disarmed for this"
        try:
            check_flows(self._flows(request))
        except UserError as error:
            return str(error)
        return ""

    def _flows(self, request: NetemRequest) -> tuple[ImpairedFlow, ...]:
        video = Impairment(
            request.delay_ms,
            request.jitter_ms,
            request.jitter_correlation,
            request.jitter_distribution,  # type: ignore[arg-type]  # checked by `decode`
            request.loss,
            request.loss_burst_packets,
            request.rate_bps,
            request.reorder,
        )
        return (
            ImpairedFlow("video", "udp", self._video_port, "source", video),
            ImpairedFlow("state", *self._control, "source", Impairment(request.state_delay_ms)),
        )

    def _note_rest(self, message: Message, _now: Now) -> list[Send]:
        """Whoever holds the vehicle drives without what another had asked for."""
        self._rest = message.payload
        if self._lease is None or self._rest.active_operator in (None, self._lease.active_operator):
            return []
        return self._end_lease()

    def _note_injected(self, message: Message, now: Now) -> list[Send]:
        done: InjectionResult = message.payload
        sends = self._queues.note(done, now)
        if sends is None:
            return []
        sends += [_reply(done.reason, peer) for peer in self._waiting]
        self._waiting.clear()
        if not done.reason:
            return sends
        self.counts["netem_failed"] += 1
        self._lease = None
        # What failed half-way must not stay; what cannot be put back is tried again every second.
        return [*sends, *self._queues.tell("", ())] if self._queues.condition else sends

    def _look(self, _message: Message, now: Now) -> list[Send]:
        if self._lease is not None and now.mono_ns >= self._lease.until_ns:
            return self._end_lease()
        return self._queues.tell_again_when_due(now.mono_ns)

    def _end_lease(self) -> list[Send]:
        self._lease = None
        self.counts["netem_leases_ended"] += 1
        return self._queues.tell("", ())


class InjectionClient:
    """The client's: has the control delayed by its own machine, and asks the server for the rest, again and again.

    The driver arms when both are in force; without a condition it need not wait.
    """

    name = "injection"

    def __init__(
        self,
        who: str,
        instance: int,
        *,
        condition: str,
        control: ImpairedFlow,
        video: Impairment,
        state_delay_ms: float,
        start_ns: int,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._condition = condition
        self._control = control
        self._queues = _Queues()
        law = asdict(video)
        self.request = encode(NetemRequest(who, instance, condition, LEASE_MS, **law, state_delay_ms=state_delay_ms))
        self._ask_ns: int | None = start_ns if condition else None
        self._told = False
        self.chains: Mapping[str, Sequence[Hop]] = {
            "netem_reply": (("note", self._note_reply),),
            "injected": (("note", self._note_injected),),
            WAKE: (("ask", self._ask),),
        }

    def next_wake_ns(self) -> int | None:
        """When the lease is renewed, what this machine does is measured again, or what failed is tried again."""
        return _first(self._ask_ns, self._queues.again_ns)

    def _ask(self, _message: Message, now: Now) -> list[Send]:
        sends = self._queues.tell_again_when_due(now.mono_ns)
        if self._ask_ns is None or now.mono_ns < self._ask_ns:
            return sends
        self._ask_ns = now.mono_ns + ASK_PERIOD_NS
        if not self._told:
            self._told = True
            return self._queues.tell(self._condition, (self._control,))
        return [*sends, Send("netem", self.request)] if self._queues.in_force else sends

    def _note_injected(self, message: Message, now: Now) -> list[Send]:
        done: InjectionResult = message.payload
        sends = self._queues.note(done, now) or []
        if done.reason:
            self.counts["netem_failed"] += 1
            return [*sends, Send("condition_in_force", f"this machine does not delay the control: {done.reason}")]
        self._ask_ns = now.mono_ns if self._ask_ns is None else min(self._ask_ns, now.mono_ns)
        return sends

    def _note_reply(self, message: Message, _now: Now) -> list[Send]:
        try:
            reply = decode(NetemReply, message.payload)
        except BadMessage:
            self.counts["netem_replies_unreadable"] += 1
            return []
        granted = reply.granted and self._queues.in_force
        reason = "" if granted else f"the server does not delay the video: {reply.reason}"
        return [Send("condition_in_force", reason)]


def _first(*times_ns: int | None) -> int | None:
    return min((each for each in times_ns if each is not None), default=None)


def _reply(reason: str, peer: Peer) -> Send:
    return Send("netem_reply", encode(NetemReply(reason == "", reason[:LONGEST_REASON])), peer)
