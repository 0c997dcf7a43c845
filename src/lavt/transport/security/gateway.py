"""Where messages of Zenoh come in and go out on one side: what is not authentic, or is too much, stays outside.

A door is what a link delivers to, in threads of its own, and what hands on to the side's runtime. Behind it a message
is what its sender meant to say, so that no node asks who sent it. Times of arrival are those of the link.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Final

from lavt.domain import NS_PER_S, Now
from lavt.node import Peer, Send
from lavt.transport.security.envelope import REQUESTS, NullVehicleAuthenticator, OperatorAuthenticator, VerifiedRequest
from lavt.transport.security.flood_filter import QUERIES_PER_S, FloodFilter, RateLimiter

Deliver = Callable[[str, Any, Now, Peer], None]
Carry = Callable[..., None]
"""What is outside: takes `Send`s."""

ASK_PERIOD_NS: Final = NS_PER_S
QUERIES_KEPT: Final = 64
STATES_PER_S: Final = 500
"""Ten times what a vehicle tells; as many signatures take 7 % of a core."""


class OpenClientGateway:
    """The operator's door where nothing is signed."""

    counts: Mapping[str, int] = {}

    def __init__(self, deliver: Deliver, carry: Carry) -> None:
        self.receive = deliver
        self.send = carry


class ServerGateway:
    """The vehicle's door. `in_force` gives the epoch in force and the sequence last obeyed."""

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
        self._screen = FloodFilter(in_force, authenticator.is_from_active_operator)
        self._budgets = {channel: RateLimiter(QUERIES_PER_S) for channel in REQUESTS}
        self._requests: dict[tuple[str, Peer], VerifiedRequest] = {}
        self._again: Send | None = None
        """What a stale request is answered, as soon as the turn is over."""
        self._counts: Counter[str] = Counter()
        self._turn = threading.Lock()

    @property
    def counts(self) -> dict[str, int]:
        """What was kept outside."""
        return {**self._counts, **self._screen.counts, **self._authenticator.counts}

    def receive(self, channel: str, payload: bytes, arrived: Now, peer: Peer) -> None:
        """Take what the link delivers."""
        with self._turn:
            opened = self._command if channel == "control" else self._request
            body = opened(channel, payload, arrived.mono_ns, peer)
            again, self._again = self._again, None
        if again is not None:  # out of turn: the link may wait for its router, and the vehicle for its turn
            self._carry(again)
        if body is not None:
            self._deliver(channel, body, arrived, peer)

    def _command(self, _channel: str, payload: bytes, now_ns: int, _peer: Peer) -> bytes | None:
        if not self._screen.passes(payload, self._authenticator.body(payload), now_ns):
            return None
        body = self._authenticator.open_command(payload)
        if body is not None:
            self._screen.note(body)
        return body

    def _request(self, channel: str, payload: bytes, now_ns: int, peer: Peer) -> bytes | None:
        if not (
            self._authenticator.is_next_of_active_operator(channel, payload) or self._budgets[channel].take(now_ns)
        ):
            self._counts[f"{channel}_requests_screened_out"] += 1
            return None
        request = self._authenticator.open_request(channel, payload)
        if request is None:
            return None
        if request.is_stale:
            self._again = Send(f"{channel}_reply", self._authenticator.sign_reply(request, b""), peer)
            return None
        self._requests[channel, peer] = request
        if len(self._requests) > QUERIES_KEPT:
            self._requests.pop(next(iter(self._requests)))
        return request.body

    def send(self, *sends: Send) -> None:
        """Let messages of this side out."""
        with self._turn:
            signed = [each for send in sends if (each := self._signed(send)) is not None]
        self._carry(*signed)

    def _signed(self, send: Send) -> Send | None:
        if send.channel == "state":
            return Send("state", self._authenticator.sign_state(send.payload))
        request = self._requests.pop((send.channel.removesuffix("_reply"), send.peer), None)
        return (
            None
            if request is None
            else Send(send.channel, self._authenticator.sign_reply(request, send.payload), send.peer)
        )


class ClientGateway:
    """The operator's door."""

    def __init__(self, deliver: Deliver, carry: Carry, authenticator: OperatorAuthenticator) -> None:
        self._deliver = deliver
        self._carry = carry
        self._authenticator = authenticator
        self._states = RateLimiter(STATES_PER_S)
        self._counts: Counter[str] = Counter()
        self._requested_ns: int | None = None
        self._turn = threading.Lock()

    @property
    def counts(self) -> dict[str, int]:
        """What was kept outside."""
        return {**self._counts, **self._authenticator.counts}

    def receive(self, channel: str, payload: bytes, arrived: Now, peer: Peer) -> None:
        """Take what the link delivers."""
        with self._turn:
            opened = self._state if channel == "state" else self._reply
            body = opened(channel, payload, arrived.mono_ns)
        if body is not None:
            self._deliver(channel, body, arrived, peer)

    def _state(self, _channel: str, payload: bytes, now_ns: int) -> bytes | None:
        if not (self._authenticator.is_next_state(payload) or self._states.take(now_ns)):
            self._counts["states_screened_out"] += 1
            return None
        opened = self._authenticator.open_state(payload)
        if opened.ask and (self._requested_ns is None or now_ns - self._requested_ns >= ASK_PERIOD_NS):
            self._requested_ns = now_ns
            self._send_soon(Send("session", self._authenticator.sign_request("session", b"")))
        return opened.body

    def _reply(self, channel: str, payload: bytes, _now_ns: int) -> bytes | None:
        query = channel.removesuffix("_reply")
        reply = self._authenticator.open_reply(query, payload)
        if reply.again is not None:
            self._send_soon(Send(query, reply.again))
        return reply.body

    def _send_soon(self, send: Send) -> None:
        """Send in a thread of its own: in the one that delivers, Zenoh does not allow it."""
        threading.Thread(target=self._carry, args=(send,), name="gateway", daemon=True).start()

    def send(self, *sends: Send) -> None:
        """Let messages of this side out."""
        with self._turn:
            signed = [Send(send.channel, self._signed(send), send.peer) for send in sends]
        self._carry(*signed)

    def _signed(self, send: Send) -> bytes:
        if send.channel == "control":
            return self._authenticator.sign_command(send.payload)
        return self._authenticator.sign_request(send.channel, send.payload)
