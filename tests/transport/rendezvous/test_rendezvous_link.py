from __future__ import annotations

import queue
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from tests.support.clocks import ShiftedClock

from lavt.clock import MachineClock
from lavt.domain import NS_PER_S, Now
from lavt.node import Send
from lavt.transport.rendezvous.forwarder import Forwarder, encode_registration, wrap
from lavt.transport.rendezvous.link import RendezvousLink, RendezvousPort
from lavt.transport.video.path_validation import PathClient

ARRIVES_S = 5.0
ANY = ("127.0.0.1", 0)
HELLO = PathClient(b"t" * 16).hello(0)


class Ends:
    """A rendezvous, the vehicle's link that talks through it, and what that has heard."""

    def __init__(self, stack: ExitStack) -> None:
        self.heard: queue.Queue[tuple[str, Any, Now, Any]] = queue.Queue()
        forwarder = Forwarder("vehicle-1", "video", None)
        self.between = RendezvousPort(MachineClock(), forwarder, bind=ANY, name="video")
        stack.callback(self.between.close)
        self.vehicle = RendezvousLink(
            MachineClock(), "feedback", lambda *heard: self.heard.put(heard), bind=ANY,
            rendezvous=("127.0.0.1", self.between.port),
            registration=lambda wall_ns: encode_registration("vehicle-1", "video", wall_ns, None),
        )  # fmt: skip
        stack.callback(self.vehicle.close)

    def hear(self) -> tuple[str, Any, Now, Any]:
        """Wait for what the vehicle hears next."""
        return self.heard.get(timeout=ARRIVES_S)


@pytest.fixture
def ends() -> Iterator[Ends]:
    """Both ends, open and not begun."""
    with ExitStack() as stack:
        yield Ends(stack)


@pytest.fixture
def client() -> Iterator[socket.socket]:
    """A client's socket."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(ANY)
        opened.settimeout(ARRIVES_S)
        yield opened


def begin(ends: Ends, client: socket.socket) -> Any:
    """Begin both, and say hello until one comes through; tell who the vehicle says it is from."""
    ends.between.start()
    ends.vehicle.start()
    while True:
        client.sendto(HELLO, ("127.0.0.1", ends.between.port))
        try:
            return ends.heard.get(timeout=0.1)[3]
        except queue.Empty:  # it has not registered yet
            continue


def test_through_the_rendezvous_and_back(ends: Ends, client: socket.socket) -> None:
    """A client is heard with its own address, marked, and what is sent to this peer comes back to it as it was sent."""
    peer = begin(ends, client)
    assert peer == ("rendezvous:127.0.0.1", client.getsockname()[1])
    ends.vehicle.send(Send("rtp", b"challenge", peer))
    assert client.recvfrom(100) == (b"challenge", ("127.0.0.1", ends.between.port))
    assert ends.between.vehicle_at() == ("127.0.0.1", ends.vehicle.port)
    assert ends.between.counts["to_clients"] == 1


def test_directly_beside_it(ends: Ends, client: socket.socket) -> None:
    """Who reaches the vehicle without the rendezvous is heard as ever; wrapping counts from the rendezvous only."""
    ends.vehicle.start()
    wrapped = wrap(("192.0.2.9", 5004), HELLO)
    for datagram in (HELLO, wrapped):
        client.sendto(datagram, ("127.0.0.1", ends.vehicle.port))
        channel, payload, _arrived, peer = ends.hear()
        assert (channel, payload, peer) == ("feedback", datagram, client.getsockname())
    ends.vehicle.send(Send("rtp", b"challenge", peer))
    assert client.recvfrom(100) == (b"challenge", ("127.0.0.1", ends.vehicle.port))


def test_what_is_not_wrapped(client: socket.socket) -> None:
    """What comes from the rendezvous's address without a client's is counted and goes nowhere."""
    heard: queue.Queue[Any] = queue.Queue()
    link = RendezvousLink(
        MachineClock(), "feedback", lambda *each: heard.put(each), bind=ANY, rendezvous=client.getsockname(),
        registration=lambda wall_ns: encode_registration("vehicle-1", "video", wall_ns, None),
    )  # fmt: skip
    link.start()
    for datagram in (HELLO, b"", b"LAVR\x01\x02short", wrap(("192.0.2.9", 5004), b"last")):
        client.sendto(datagram, ("127.0.0.1", link.port))
    assert heard.get(timeout=ARRIVES_S)[1:4:2] == (b"last", ("rendezvous:192.0.2.9", 5004))
    assert link.counts["datagrams_not_wrapped"] == 3
    link.close()


@pytest.mark.realtime
def test_each_registration_is_newer(client: socket.socket) -> None:
    """It registers at once and again after a second, with a later time even where the wall clock goes back."""
    backward = ShiftedClock(wall_step_ns=-2 * NS_PER_S)
    link = RendezvousLink(
        backward, "feedback", lambda *_: None, bind=ANY, rendezvous=client.getsockname(),
        registration=lambda wall_ns: wall_ns.to_bytes(8, "big"),
    )  # fmt: skip
    link.start()
    times_ns = [int.from_bytes(client.recv(100), "big") for _ in range(3)]
    link.close()
    assert times_ns == [times_ns[0], times_ns[0] + 1, times_ns[0] + 2]
