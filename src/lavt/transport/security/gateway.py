"""Gateways that filter and authenticate messages between Zenoh and the runtime of a side.

A link delivers to its gateway in threads of the link, and the gateway delivers to the runtime. So the runtime's nodes
get authentic messages only, and need not check who sent them. A message keeps the arrival time that the link measured.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Final

import lavt
from lavt.domain import NS_PER_S, Now, State, VehicleInfo
from lavt.errors import BadMessage
from lavt.node import Peer, Send
from lavt.transport.messages import decode, encode
from lavt.transport.security.envelope import REQUESTS, NullVehicleAuthenticator, OperatorAuthenticator
from lavt.transport.security.flood_filter import REQUESTS_PER_S, FloodFilter, RateLimiter
from lavt.transport.security.verified import VerifiedRequest

Deliver = Callable[[str, Any, Now, Peer], None]
"""Takes (channel, payload, arrived, peer) of each authentic message."""
Carry = Callable[..., None]
"""Takes `Send`s and passes them to the link."""

OWN_REQUEST_PERIOD_NS: Final = NS_PER_S
"""The least time between two requests that the client's gateway sends by itself, to authenticate the server."""
MAX_UNANSWERED_REQUESTS: Final = 64
INFO_QUERIES_PER_S: Final = 50
"""The limit for all who ask; the answer to a query takes one signature."""
INFO_NONCE_BYTES: Final = 16
"""Size of the random number in a query, which the signature of the answer covers."""
STATES_PER_S: Final = 500
"""Ten times as many as a vehicle sends; to verify this many signatures takes 7 % of a core."""


class OpenClientGateway:
    """The operator's gateway if nothing is signed: it passes everything unchanged."""

    counts: Mapping[str, int] = {}

    def __init__(self, deliver: Deliver, carry: Carry) -> None:
        self.receive = deliver
        self.send = carry


class ServerGateway:
    """The vehicle's gateway. `in_force` returns the epoch in force and the sequence of the last accepted command."""

    def __init__(
        self,
        deliver: Deliver,
        carry: Carry,
        in_force: Callable[[], tuple[int, int]],
        authenticator: NullVehicleAuthenticator,
    ) -> None:
        self._deliver = deliver
        self._carry = carry
        self._authenticator = authenticator
        self._flood_filter = FloodFilter(in_force, authenticator.is_from_active_operator)
        self._request_limiters = {channel: RateLimiter(REQUESTS_PER_S) for channel in REQUESTS}
        self._requests: dict[tuple[str, Peer], VerifiedRequest] = {}
        self._info_limiter = RateLimiter(INFO_QUERIES_PER_S)
        self._newest_state = b""
        self._own_reply: Send | None = None
        """A reply of the gateway itself, such as the demand to send a request again; it is sent as soon as the lock is
        free."""
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    @property
    def counts(self) -> dict[str, int]:
        """The numbers of rejected messages, by reason."""
        return {**self._counts, **self._flood_filter.counts, **self._authenticator.counts}

    def receive(self, channel: str, payload: bytes, arrived: Now, peer: Peer) -> None:
        """Filter and verify a message from the link, and deliver it to the runtime if it is authentic."""
        with self._lock:
            verify = {"control": self._verify_command, "info": self._answer_info}.get(channel, self._verify_request)
            body = verify(channel, payload, arrived.mono_ns, peer)
            own_reply, self._own_reply = self._own_reply, None
        # Sent outside the lock: the link can block for its router, which must not block `send`.
        if own_reply is not None:
            self._carry(own_reply)
        if body is not None:
            self._deliver(channel, body, arrived, peer)

    def _verify_command(self, _channel: str, payload: bytes, now_ns: int, _peer: Peer) -> bytes | None:
        if not self._flood_filter.passes(payload, self._authenticator.unverified_body(payload), now_ns):
            return None
        body = self._authenticator.verify_command(payload)
        # The sequence number of another operator's emergency stop says nothing about the active operator's commands.
        if body is not None and self._authenticator.is_from_active_operator(payload):
            self._flood_filter.note_authentic(body)
        return body

    def _verify_request(self, channel: str, payload: bytes, now_ns: int, peer: Peer) -> bytes | None:
        if not (
            self._authenticator.is_active_operators_next_request(channel, payload)
            or self._request_limiters[channel].take(now_ns)
        ):
            self._counts[f"{channel}_requests_screened_out"] += 1
            return None
        request = self._authenticator.verify_request(channel, payload)
        if request is None:
            return None
        if request.must_retry:
            self._own_reply = Send(f"{channel}_reply", self._authenticator.sign_reply(request, b""), peer)
            return None
        self._requests[channel, peer] = request
        if len(self._requests) > MAX_UNANSWERED_REQUESTS:
            self._requests.pop(next(iter(self._requests)))
        return request.body

    def _answer_info(self, _channel: str, nonce: bytes, now_ns: int, peer: Peer) -> None:
        """Answer a query for information about the vehicle, from the newest state; the nodes do not receive it."""
        if not self._info_limiter.take(now_ns):
            self._counts["info_queries_screened_out"] += 1
            return
        if len(nonce) != INFO_NONCE_BYTES:
            self._counts["info_queries_unreadable"] += 1
            return
        try:
            state = decode(State, self._newest_state)
        except BadMessage:  # there is no state yet
            return
        info = VehicleInfo(
            lavt.__version__,
            state.safety,
            state.reason,
            state.active_operator,
            state.speed_mps,
            max(0, now_ns - state.state_mono_ns),
            state.instance,
        )
        self._own_reply = Send("info_reply", self._authenticator.sign_info(nonce, encode(info)), peer)

    def send(self, *sends: Send) -> None:
        """Sign messages from the runtime and pass them to the link; a reply without a pending request is dropped."""
        with self._lock:
            signed = [message for send in sends if (message := self._sign(send)) is not None]
        self._carry(*signed)

    def _sign(self, send: Send) -> Send | None:
        if send.channel == "state":
            self._newest_state = send.payload
            return Send("state", self._authenticator.sign_state(send.payload))
        request = self._requests.pop((send.channel.removesuffix("_reply"), send.peer), None)
        if request is None:
            return None
        return Send(send.channel, self._authenticator.sign_reply(request, send.payload), send.peer)


class ClientGateway:
    """The operator's gateway."""

    def __init__(self, deliver: Deliver, carry: Carry, authenticator: OperatorAuthenticator) -> None:
        self._deliver = deliver
        self._carry = carry
        self._authenticator = authenticator
        self._state_limiter = RateLimiter(STATES_PER_S)
        self._counts: Counter[str] = Counter()
        self._requested_ns: int | None = None
        self._lock = threading.Lock()

    @property
    def counts(self) -> dict[str, int]:
        """The numbers of rejected messages, by reason."""
        return {**self._counts, **self._authenticator.counts}

    def receive(self, channel: str, payload: bytes, arrived: Now, peer: Peer) -> None:
        """Filter and verify a message from the link, and deliver it to the runtime if it is authentic."""
        with self._lock:
            verify = self._verify_state if channel == "state" else self._verify_reply
            body = verify(channel, payload, arrived.mono_ns)
        if body is not None:
            self._deliver(channel, body, arrived, peer)

    def _verify_state(self, _channel: str, payload: bytes, now_ns: int) -> bytes | None:
        if not (self._authenticator.is_next_state(payload) or self._state_limiter.take(now_ns)):
            self._counts["states_screened_out"] += 1
            return None
        state = self._authenticator.verify_state(payload)
        # The server's process is not authenticated yet. Its answer to a request authenticates it.
        if state.client_must_request and (
            self._requested_ns is None or now_ns - self._requested_ns >= OWN_REQUEST_PERIOD_NS
        ):
            self._requested_ns = now_ns
            self._send_in_thread(Send("session", self._authenticator.sign_request("session", b"")))
        return state.body

    def _verify_reply(self, channel: str, payload: bytes, _now_ns: int) -> bytes | None:
        request_channel = channel.removesuffix("_reply")
        reply = self._authenticator.verify_reply(request_channel, payload)
        if reply.repeated_request is not None:
            self._send_in_thread(Send(request_channel, reply.repeated_request))
        return reply.body

    def _send_in_thread(self, send: Send) -> None:
        """Send from a new thread: Zenoh does not allow sending in the thread that delivers."""
        threading.Thread(target=self._carry, args=(send,), name="gateway", daemon=True).start()

    def send(self, *sends: Send) -> None:
        """Sign messages from the runtime and pass them to the link."""
        with self._lock:
            signed = [Send(send.channel, self._sign(send), send.peer) for send in sends]
        self._carry(*signed)

    def _sign(self, send: Send) -> bytes:
        if send.channel == "control":
            return self._authenticator.sign_command(send.payload)
        return self._authenticator.sign_request(send.channel, send.payload)
