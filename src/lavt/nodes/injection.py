"""Network conditions: the client requests one, and each side applies its part to the network queues of its machine.

A condition is in force under a lease: if the client does not renew the lease, the lease ends and all queues are
cleared. The nodes do not change the queues themselves. They send orders on the channel `inject` to a link, the
injector, which changes the queues and reports what it measured.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import Literal

from msgspec import Struct
from msgspec.structs import asdict

from lavt.domain import NS_PER_MS, NS_PER_S, NetemReply, NetemRequest, Now
from lavt.errors import BadMessage, UserError
from lavt.node import WAKE, Message, Peer, Send, Stage
from lavt.nodes.payloads import InjectionSample, StationaryStatus
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment, check_flows
from lavt.transport.messages import decode, encode
from lavt.transport.netem.injector import InjectionOrder, InjectionResult

MEASURE_PERIOD_NS = 5 * NS_PER_S
"""Period at which a condition in force is measured."""
REQUEST_PERIOD_NS = NS_PER_S
LEASE_MS = 5_000
"""The client renews its lease once a second, so the lease survives the loss of four requests in a row."""
MAX_PENDING_REQUESTS = 64
"""Largest number of requests whose reply waits until the queues have been changed."""


class _Queues:
    """The last order to this machine's network queues, and whether it is in force."""

    def __init__(self) -> None:
        self.flows: tuple[ImpairedFlow, ...] = ()
        self.condition = ""
        self.in_force = False
        self.repeat_ns: int | None = None
        """When the order is repeated, either to measure the condition in force or because the order failed."""
        self._number = 0

    def order(self, condition: str, flows: tuple[ImpairedFlow, ...]) -> list[Send]:
        self.condition, self.flows, self.in_force, self.repeat_ns = condition, flows, False, None
        self._number += 1
        return self._inject()

    def repeat_order(self, now_ns: int) -> list[Send]:
        """Return the order again, if that is due."""
        if self.repeat_ns is None or now_ns < self.repeat_ns:
            return []
        self.repeat_ns = None  # the result of the order sets it again
        return self._inject() if self.in_force else self.order(self.condition, self.flows)

    def handle_result(self, result: InjectionResult, now: Now) -> list[Send] | None:
        """Process a result and return its samples; None: the result belongs to an older order than the newest one."""
        if result.number != self._number:
            return None
        self.in_force = result.reason == ""
        if not self.in_force:
            self.repeat_ns = now.mono_ns + REQUEST_PERIOD_NS
        elif self.condition:
            self.repeat_ns = now.mono_ns + MEASURE_PERIOD_NS
        requested_ms: dict[str, float] = {flow.name: flow.impairment.delay_ms for flow in self.flows} or {"": 0.0}
        measured_ms = dict(result.measured_ms)
        reason = result.reason or result.problems
        return [
            Send(
                "injection",
                InjectionSample(now.mono_ns, self.condition, name, delay_ms, measured_ms.get(name), reason),
            )
            for name, delay_ms in requested_ms.items()
        ]

    def _inject(self) -> list[Send]:
        return [Send("inject", InjectionOrder(self._number, self.condition, self.flows))]


class Lease(Struct, frozen=True):
    """The client that controls the network condition, and the time when its control ends."""

    client: tuple[str, int]
    """Its name and the instance of its process."""
    until_ns: int


class InjectionNode:
    """The server's node, which impairs packets that this machine sends, on the request of one client at a time.

    `control` is the protocol and the port of the link between the routers. A vehicle that is not `simulated` must be
    stationary and disarmed for a change of the condition, but a lease can end at any time.
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
        self._status = StationaryStatus(False, None)
        self._waiting_peers: deque[Peer] = deque(maxlen=MAX_PENDING_REQUESTS)
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            "netem": (("answer", self._answer),),
            "injected": (("note", self._handle_result),),
            "rest": (("note", self._handle_status),),
            WAKE: (("look", self._wake),),
        }

    def next_wake_ns(self) -> int | None:
        """Return when the lease ends or an order is repeated."""
        lease_end_ns = None if self._lease is None else self._lease.until_ns
        return _earliest(lease_end_ns, self._queues.repeat_ns)

    def _answer(self, message: Message, now: Now) -> list[Send]:
        try:
            request = decode(NetemRequest, message.payload)
        except BadMessage:
            self.counts["netem_requests_unreadable"] += 1
            return []
        flows = self._flows(request)
        is_change = flows != self._queues.flows or request.condition != self._queues.condition
        rejection = self._rejection(request, is_change=is_change)
        self.counts[f"netem {'rejected' if rejection else 'granted'}"] += 1
        if rejection:
            return [_reply(rejection, message.peer)]
        self._lease = Lease((request.who, request.instance), now.mono_ns + request.lease_ms * NS_PER_MS)
        if not is_change and self._queues.in_force:
            return [_reply("", message.peer)]
        self._waiting_peers.append(message.peer)
        return self._queues.order(request.condition, flows) if is_change else []

    def _rejection(self, request: NetemRequest, *, is_change: bool) -> str:
        """Return why a request is rejected; empty: it is granted."""
        if not self._allowed:
            return "this server does not allow clients to inject delay: set injection.remote: true in its config"
        client = (request.who, request.instance)
        if self._lease is not None and self._lease.client != client:
            return f"{self._lease.client[0]} controls the network condition until its lease ends"
        if self._status.active_operator is not None and self._status.active_operator != client:
            return f"{self._status.active_operator[0]} has control of the vehicle"
        if is_change and not (self._simulated or self._status.at_rest):
            return "a vehicle that is not simulated must be stationary and disarmed for this"
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

    def _handle_status(self, message: Message, _now: Now) -> list[Send]:
        """End the lease if another client has control of the vehicle."""
        self._status = message.payload
        if self._lease is None or self._status.active_operator in (None, self._lease.client):
            return []
        return self._end_lease()

    def _handle_result(self, message: Message, now: Now) -> list[Send]:
        result: InjectionResult = message.payload
        sends = self._queues.handle_result(result, now)
        if sends is None:
            return []
        sends += [_reply(result.reason, peer) for peer in self._waiting_peers]
        self._waiting_peers.clear()
        if not result.reason:
            return sends
        self.counts["netem_failed"] += 1
        self._lease = None
        # Perhaps the order failed half-way, so the queues are cleared. If clearing fails, it is repeated every second.
        return [*sends, *self._queues.order("", ())] if self._queues.condition else sends

    def _wake(self, _message: Message, now: Now) -> list[Send]:
        if self._lease is not None and now.mono_ns >= self._lease.until_ns:
            return self._end_lease()
        return self._queues.repeat_order(now.mono_ns)

    def _end_lease(self) -> list[Send]:
        self._lease = None
        self.counts["netem_leases_ended"] += 1
        return self._queues.order("", ())


class InjectionClient:
    """The client's node, which delays commands on its own machine and requests the other delays from the server.

    The request is repeated, because it renews the lease. With a condition, the driver arms the vehicle only when the
    delays of both machines are in force.
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
        impairment = asdict(video)
        self.request = encode(
            NetemRequest(who, instance, condition, LEASE_MS, **impairment, state_delay_ms=state_delay_ms)
        )
        self._request_ns: int | None = start_ns if condition else None
        self._has_ordered = False
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            "netem_reply": (("note", self._handle_reply),),
            "injected": (("note", self._handle_result),),
            WAKE: (("ask", self._wake),),
        }

    def next_wake_ns(self) -> int | None:
        """Return when the lease is renewed or an order is repeated."""
        return _earliest(self._request_ns, self._queues.repeat_ns)

    def _wake(self, _message: Message, now: Now) -> list[Send]:
        sends = self._queues.repeat_order(now.mono_ns)
        if self._request_ns is None or now.mono_ns < self._request_ns:
            return sends
        self._request_ns = now.mono_ns + REQUEST_PERIOD_NS
        if not self._has_ordered:
            self._has_ordered = True
            return self._queues.order(self._condition, (self._control,))
        return [*sends, Send("netem", self.request)] if self._queues.in_force else sends

    def _handle_result(self, message: Message, now: Now) -> list[Send]:
        result: InjectionResult = message.payload
        sends = self._queues.handle_result(result, now) or []
        if result.reason:
            self.counts["netem_failed"] += 1
            return [*sends, Send("condition_in_force", f"this machine does not delay the control: {result.reason}")]
        self._request_ns = now.mono_ns if self._request_ns is None else min(self._request_ns, now.mono_ns)
        return sends

    def _handle_reply(self, message: Message, _now: Now) -> list[Send]:
        try:
            reply = decode(NetemReply, message.payload)
        except BadMessage:
            self.counts["netem_replies_unreadable"] += 1
            return []
        granted = reply.granted and self._queues.in_force
        reason = "" if granted else f"the server does not delay the video: {reply.reason}"
        return [Send("condition_in_force", reason)]


def _earliest(*times_ns: int | None) -> int | None:
    return min((time_ns for time_ns in times_ns if time_ns is not None), default=None)


def _reply(reason: str, peer: Peer) -> Send:
    return Send("netem_reply", encode(NetemReply(reason == "", reason)), peer)
