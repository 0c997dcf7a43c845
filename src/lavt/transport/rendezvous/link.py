"""The sockets of a rendezvous, and the vehicle's socket that also communicates through one."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from lavt.clock import Clock
from lavt.domain import NS_PER_S, Now
from lavt.node import Send
from lavt.transport.rendezvous.forwarder import REGISTER_EVERY_NS, Address, Forwarder, unwrap, wrap
from lavt.transport.udp_link import Deliver, UdpLink

_VIA_PREFIX: Final = "rendezvous:"
"""Prefix of the host in the address of a client behind the rendezvous; replies to such an address go through it."""


class RendezvousLink:
    """A `UdpLink` of the vehicle that receives from clients both directly and through the rendezvous.

    The peer of a datagram that came through the rendezvous is the client's address with a prefix before the host, which
    can be used like any other address. `registration` returns a registration for a time of the wall clock; from `start`
    on one is sent every second.
    """

    def __init__(
        self,
        clock: Clock,
        channel: str,
        *,
        bind: Address,
        rendezvous: Address,
        registration: Callable[[int], bytes],
        name: str = "video",
    ) -> None:
        self._link = UdpLink(clock, channel, bind=bind, name=name)
        self._clock = clock
        self._rendezvous = rendezvous
        self._registration = registration
        self._registered_ns = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._keep_registered, name="registration", daemon=True)

    @property
    def port(self) -> int:
        """The UDP port of the socket."""
        return self._link.port

    @property
    def counts(self) -> Counter[str]:
        """The numbers of lost and rejected datagrams, by reason."""
        return self._link.counts

    def start(self, deliver: Deliver) -> None:
        """Start to receive and to register; the receiving thread calls `deliver`."""
        self._link.start(partial(self._on_datagram, deliver))
        self._thread.start()

    def send(self, *sends: Send) -> None:
        """Send datagrams, to each peer directly or through the rendezvous."""
        self._link.send(*map(self._route, sends))

    def close(self) -> None:
        """Stop and close the socket."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._link.close()

    def _on_datagram(self, deliver: Deliver, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        if peer != self._rendezvous:
            deliver(channel, payload, arrived, peer)
            return
        unwrapped = unwrap(payload)
        if unwrapped is None:
            self.counts["datagrams_not_wrapped"] += 1
            return
        (host, port), datagram = unwrapped
        deliver(channel, datagram, arrived, (_VIA_PREFIX + host, port))

    def _route(self, send: Send) -> Send:
        host, port = send.peer
        if not host.startswith(_VIA_PREFIX):
            return send
        return Send(send.channel, wrap((host.removeprefix(_VIA_PREFIX), port), send.payload), self._rendezvous)

    def _keep_registered(self) -> None:
        while True:
            # later than any earlier one, even if the wall clock was set back
            self._registered_ns = max(self._registered_ns + 1, self._clock.now().wall_ns)
            self._link.send(Send("registration", self._registration(self._registered_ns), self._rendezvous))
            if self._closing.wait(REGISTER_EVERY_NS / NS_PER_S):
                return


class RendezvousPort:
    """The UDP port of one flow at the rendezvous; the thread that receives a datagram also forwards it.

    Raises `UserError` for a port that cannot be opened.
    """

    def __init__(self, clock: Clock, forwarder: Forwarder, *, bind: Address, name: str) -> None:
        self._clock = clock
        self._forwarder = forwarder
        self._link = UdpLink(clock, name, bind=bind, name=name)

    @property
    def port(self) -> int:
        """The UDP port of the socket."""
        return self._link.port

    @property
    def counts(self) -> dict[str, int]:
        """The numbers of datagrams by result."""
        return {**self._forwarder.counts, **self._link.counts}

    def vehicle_address(self) -> Address | None:
        """Return the address from which the vehicle registered; None if there is none or the registration expired."""
        return self._forwarder.vehicle_address(self._clock.now().mono_ns)

    def start(self) -> None:
        """Start to forward."""
        self._link.start(self._forward)

    def close(self) -> None:
        """Stop forwarding and close the socket."""
        self._link.close()

    def _forward(self, channel: str, datagram: bytes, arrived: Now, sender: Any) -> None:
        forwarded = self._forwarder.receive(datagram, sender, arrived.mono_ns)
        if forwarded is not None:
            self._link.send(Send(channel, *forwarded))
