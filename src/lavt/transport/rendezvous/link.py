"""The sockets of a rendezvous, and the vehicle's socket that also talks through one (`rendezvous.py`)."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

from lavt.clock import Clock
from lavt.domain import NS_PER_S, Now
from lavt.node import Send
from lavt.transport.rendezvous.forwarder import REGISTER_EVERY_NS, Address, Forwarder, unwrap, wrap
from lavt.transport.udp_link import Deliver, UdpLink

_VIA: Final = "rendezvous:"
"""Before the host of a client that is heard through the rendezvous: an answer goes the same way back."""


class RendezvousLink:
    """A `UdpLink` of the vehicle that hears clients directly and, at the same time, through the rendezvous.

    The peer of what came through is the client's address with a mark, so that all who take it for an address can.
    `registration` writes one for a time of the wall clock; it is sent from the start on, every second.
    """

    def __init__(
        self,
        clock: Clock,
        channel: str,
        deliver: Deliver,
        *,
        bind: Address,
        rendezvous: Address,
        registration: Callable[[int], bytes],
        name: str = "video",
    ) -> None:
        self._link = UdpLink(clock, channel, self._come, bind=bind, name=name)
        self._clock = clock
        self._deliver = deliver
        self._rendezvous = rendezvous
        self._registration = registration
        self._registered_ns = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._keep_registered, name="registration", daemon=True)

    @property
    def port(self) -> int:
        """The port that was opened."""
        return self._link.port

    @property
    def counts(self) -> Counter[str]:
        """What was counted."""
        return self._link.counts

    def start(self) -> None:
        """Begin to receive, and register."""
        self._link.start()
        self._thread.start()

    def send(self, *sends: Send) -> None:
        """Send datagrams, to each peer the way it came."""
        self._link.send(*map(self._addressed, sends))

    def close(self) -> None:
        """Stop and close the socket."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._link.close()

    def _come(self, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        if peer != self._rendezvous:
            self._deliver(channel, payload, arrived, peer)
            return
        unwrapped = unwrap(payload)
        if unwrapped is None:
            self.counts["datagrams_not_wrapped"] += 1
            return
        (host, port), datagram = unwrapped
        self._deliver(channel, datagram, arrived, (_VIA + host, port))

    def _addressed(self, send: Send) -> Send:
        host, port = send.peer
        if not host.startswith(_VIA):
            return send
        return Send(send.channel, wrap((host.removeprefix(_VIA), port), send.payload), self._rendezvous)

    def _keep_registered(self) -> None:
        while True:
            # later than any before, also where the wall clock is set back
            self._registered_ns = max(self._registered_ns + 1, self._clock.now().wall_ns)
            self._link.send(Send("registration", self._registration(self._registered_ns), self._rendezvous))
            if self._closing.wait(REGISTER_EVERY_NS / NS_PER_S):
                return


class RendezvousPort:
    """One flow's port on the machine that both ends reach: what comes is passed on by the thread that receives it.

    Raises `UserError` for a port that cannot be opened.
    """

    def __init__(self, clock: Clock, forwarder: Forwarder, *, bind: Address, name: str) -> None:
        self._clock = clock
        self._forwarder = forwarder
        self._link = UdpLink(clock, name, self._pass_on, bind=bind, name=name)

    @property
    def port(self) -> int:
        """The port that was opened."""
        return self._link.port

    @property
    def counts(self) -> dict[str, int]:
        """What became of what came."""
        return {**self._forwarder.counts, **self._link.counts}

    def vehicle_at(self) -> Address | None:
        """Tell from where the vehicle has registered; None: it is not there."""
        return self._forwarder.vehicle_at(self._clock.now().mono_ns)

    def start(self) -> None:
        """Begin."""
        self._link.start()

    def close(self) -> None:
        """End, and close the socket."""
        self._link.close()

    def _pass_on(self, channel: str, datagram: bytes, arrived: Now, sender: Any) -> None:
        passed = self._forwarder.receive(datagram, sender, arrived.mono_ns)
        if passed is not None:
            self._link.send(Send(channel, *passed))
