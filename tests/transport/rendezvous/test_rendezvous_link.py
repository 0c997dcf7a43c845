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

TIMEOUT_S = 5.0
ANY_PORT = ("127.0.0.1", 0)
HELLO = PathClient(b"t" * 16).hello(0)


class VehicleBehindRendezvous:
    """A rendezvous, the vehicle's link through it, and the messages that the link delivered."""

    def __init__(self, stack: ExitStack) -> None:
        self.received: queue.Queue[tuple[str, Any, Now, Any]] = queue.Queue()
        forwarder = Forwarder("vehicle-1", "video", None)
        self.rendezvous = RendezvousPort(MachineClock(), forwarder, bind=ANY_PORT, name="video")
        stack.callback(self.rendezvous.close)
        self.vehicle = RendezvousLink(
            MachineClock(),
            "feedback",
            bind=ANY_PORT,
            rendezvous=("127.0.0.1", self.rendezvous.port),
            registration=lambda wall_ns: encode_registration("vehicle-1", "video", wall_ns, None),
        )
        stack.callback(self.vehicle.close)

    def start(self) -> None:
        """Start the vehicle's link."""
        self.vehicle.start(lambda *message: self.received.put(message))

    def receive(self) -> tuple[str, Any, Now, Any]:
        """Wait for the vehicle's next message."""
        return self.received.get(timeout=TIMEOUT_S)


@pytest.fixture
def setup() -> Iterator[VehicleBehindRendezvous]:
    """Make a rendezvous and a vehicle's link, open but not started."""
    with ExitStack() as stack:
        yield VehicleBehindRendezvous(stack)


@pytest.fixture
def client() -> Iterator[socket.socket]:
    """Open a client's socket."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp_socket:
        udp_socket.bind(ANY_PORT)
        udp_socket.settimeout(TIMEOUT_S)
        yield udp_socket


def connect(setup: VehicleBehindRendezvous, client: socket.socket) -> Any:
    """Start both ends and send hellos until one arrives; return the client's peer address at the vehicle's link."""
    setup.rendezvous.start()
    setup.start()
    while True:
        client.sendto(HELLO, ("127.0.0.1", setup.rendezvous.port))
        try:
            _channel, _payload, _arrived, peer = setup.received.get(timeout=0.1)
        except queue.Empty:  # the vehicle has not registered yet
            continue
        return peer


def test_datagrams_pass_the_rendezvous_both_ways(setup: VehicleBehindRendezvous, client: socket.socket) -> None:
    """The vehicle receives a client's datagram with the client's address as its peer, and can send to this peer."""
    peer = connect(setup, client)
    assert peer == ("rendezvous:127.0.0.1", client.getsockname()[1])
    setup.vehicle.send(Send("rtp", b"challenge", peer))
    assert client.recvfrom(100) == (b"challenge", ("127.0.0.1", setup.rendezvous.port))
    assert setup.rendezvous.vehicle_address() == ("127.0.0.1", setup.vehicle.port)
    assert setup.rendezvous.counts["to_clients"] == 1


def test_clients_reach_the_vehicle_directly(setup: VehicleBehindRendezvous, client: socket.socket) -> None:
    """A client can reach the vehicle directly, and only datagrams from the rendezvous are unwrapped."""
    setup.start()
    wrapped = wrap(("192.0.2.9", 5004), HELLO)
    for datagram in (HELLO, wrapped):
        client.sendto(datagram, ("127.0.0.1", setup.vehicle.port))
        channel, payload, _arrived, peer = setup.receive()
        assert (channel, payload, peer) == ("feedback", datagram, client.getsockname())
    setup.vehicle.send(Send("rtp", b"challenge", peer))
    assert client.recvfrom(100) == (b"challenge", ("127.0.0.1", setup.vehicle.port))


def test_datagrams_without_wrapping_are_counted(client: socket.socket) -> None:
    """A datagram from the rendezvous that is not wrapped is counted and not delivered."""
    received: queue.Queue[Any] = queue.Queue()
    link = RendezvousLink(
        MachineClock(),
        "feedback",
        bind=ANY_PORT,
        rendezvous=client.getsockname(),
        registration=lambda wall_ns: encode_registration("vehicle-1", "video", wall_ns, None),
    )
    link.start(lambda *message: received.put(message))
    for datagram in (HELLO, b"", b"LAVR\x01\x02short", wrap(("192.0.2.9", 5004), b"last")):
        client.sendto(datagram, ("127.0.0.1", link.port))
    _, payload, _, peer = received.get(timeout=TIMEOUT_S)
    assert (payload, peer) == (b"last", ("rendezvous:192.0.2.9", 5004))
    assert link.counts["datagrams_not_wrapped"] == 3
    link.close()


@pytest.mark.realtime
def test_each_registration_is_newer(client: socket.socket) -> None:
    """Each registration has a later time than the last one, even if the wall clock goes back."""
    backward_clock = ShiftedClock(wall_step_ns=-2 * NS_PER_S)
    link = RendezvousLink(
        backward_clock,
        "feedback",
        bind=ANY_PORT,
        rendezvous=client.getsockname(),
        registration=lambda wall_ns: wall_ns.to_bytes(8, "big"),
    )
    link.start(lambda *_: None)
    times_ns = [int.from_bytes(client.recv(100), "big") for _ in range(3)]
    link.close()
    assert times_ns == [times_ns[0], times_ns[0] + 1, times_ns[0] + 2]
