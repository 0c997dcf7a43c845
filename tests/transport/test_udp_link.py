from __future__ import annotations

import queue
import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from typing import Any, NamedTuple

import pytest
from tests.support.clocks import ShiftedClock

from lavt.clock import Clock, MachineClock
from lavt.domain import NS_PER_S, Now
from lavt.errors import UserError
from lavt.node import Send
from lavt.streams import stream
from lavt.transport.udp_link import UdpLink

ARRIVAL_TIMEOUT_S = 5.0
ANY_PORT = ("127.0.0.1", 0)
CLOSED_PORT = 9


class Delivered(NamedTuple):
    """One message that a link delivered."""

    channel: str
    payload: Any
    arrived: Now
    peer: Any


class Received:
    """The messages that a link delivered."""

    def __init__(self) -> None:
        self.messages: queue.Queue[Delivered] = queue.Queue()

    def __call__(self, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        """Store a message."""
        self.messages.put(Delivered(channel, payload, arrived, peer))

    def next(self) -> Delivered:
        """Wait for the next message."""
        return self.messages.get(timeout=ARRIVAL_TIMEOUT_S)


def open_link(clock: Clock | None = None, remote: tuple[str, int] | None = None) -> UdpLink:
    return UdpLink(clock or MachineClock(), "rtp", bind=ANY_PORT, remote=remote)


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    """Open a socket on the loopback that belongs to no link."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened_socket:
        opened_socket.bind(ANY_PORT)
        opened_socket.settimeout(ARRIVAL_TIMEOUT_S)
        yield opened_socket


def test_delivers(sender: socket.socket) -> None:
    """A datagram is delivered on the link's channel, with the address it came from."""
    received = Received()
    with closing(open_link()) as link:
        link.start(received)
        sender.sendto(b"packet", ("127.0.0.1", link.port))
        message = received.next()
    assert (message.channel, message.payload, message.peer) == ("rtp", b"packet", sender.getsockname())


def test_time_of_arrival(sender: socket.socket) -> None:
    """The time of arrival is when the kernel received the datagram, however late the link reads it."""
    received = Received()
    with closing(open_link()) as link:
        before = MachineClock().now()
        sender.sendto(b"early", ("127.0.0.1", link.port))
        sent = MachineClock().now()
        link.start(received)
        arrived = received.next().arrived
    assert before.wall_ns <= arrived.wall_ns <= sent.wall_ns + NS_PER_S // 100
    assert before.mono_ns - NS_PER_S // 1000 <= arrived.mono_ns <= MachineClock().now().mono_ns


def test_arrival_on_both_clocks(sender: socket.socket) -> None:
    """A kernel timestamp of 5 s ago puts the arrival 5 s back on the wall clock and on the monotonic clock."""
    # The link's wall clock is 5 s ahead of the kernel's, so the timestamp of a datagram that is sent now is 5 s old.
    received, clock = Received(), ShiftedClock(mono_ns=10**15, wall_ns=5 * NS_PER_S)
    with closing(open_link(clock)) as link:
        before = MachineClock().now()
        link.start(received)
        sender.sendto(b"packet", ("127.0.0.1", link.port))
        arrived = received.next().arrived
        after = MachineClock().now()
    assert before.wall_ns <= arrived.wall_ns <= after.wall_ns
    mono_ns = arrived.mono_ns - 10**15 + 5 * NS_PER_S
    assert before.mono_ns - NS_PER_S // 1000 <= mono_ns <= after.mono_ns + NS_PER_S // 1000


@pytest.mark.parametrize("wall_s", [-5.0, 3600.0])
def test_stepped_clock(sender: socket.socket, wall_s: float) -> None:
    """A kernel timestamp in the future or an hour old is ignored, and the time of reading is used."""
    # The link's wall clock is ahead of the kernel's by `wall_s`, so the timestamp of a new datagram is that old.
    received, clock = Received(), ShiftedClock(mono_ns=10**15, wall_ns=round(wall_s * NS_PER_S))
    with closing(open_link(clock)) as link:
        before = clock.now()
        link.start(received)
        sender.sendto(b"packet", ("127.0.0.1", link.port))
        arrived = received.next().arrived
        after = clock.now()
    assert before.wall_ns <= arrived.wall_ns <= after.wall_ns
    assert before.mono_ns <= arrived.mono_ns <= after.mono_ns


def test_garbage(sender: socket.socket) -> None:
    """Datagrams of any content and length are delivered unchanged and in order, even an empty one."""
    received = Received()
    generator = stream(1, "garbage")
    datagrams = [b"", bytes(65_000), *(generator.bytes(int(generator.integers(1, 1500))) for _ in range(100))]
    with closing(open_link()) as link:
        link.start(received)
        for datagram in datagrams:
            sender.sendto(datagram, ("127.0.0.1", link.port))
            assert received.next().payload == datagram


def test_send_to_a_peer(sender: socket.socket) -> None:
    """A link without a remote sends to the peer that a message names."""
    with closing(open_link()) as link:
        link.send(Send("rtp", b"to you", sender.getsockname()))
        assert sender.recvfrom(100) == (b"to you", ("127.0.0.1", link.port))


@pytest.mark.parametrize("port_configured", [True, False])
def test_send_to_the_remote(sender: socket.socket, port_configured: bool) -> None:
    """A client's link sends to its server, at the configured port or else at the port of the session's reply."""
    port = sender.getsockname()[1]
    configured_port, port_in_reply = (port, CLOSED_PORT) if port_configured else (0, port)
    with closing(open_link(remote=("localhost", configured_port))) as link:
        link.send(Send("feedback", b"hello", port_in_reply))
        assert sender.recv(100) == b"hello"


def test_unsendable_datagrams_are_counted() -> None:
    """A datagram that the system rejects is counted and raises nothing."""
    with closing(open_link()) as link:
        for payload, address in ((bytes(70_000), ANY_PORT), (b"x", ("255.255.255.255", CLOSED_PORT)), (b"x", ANY_PORT)):
            link.send(Send("rtp", payload, address))
        assert link.counts == {"datagrams_not_sent": 3}


def test_port_in_use(sender: socket.socket) -> None:
    """A port in use raises a UserError that names the port and a remedy."""
    port = sender.getsockname()[1]
    with pytest.raises(UserError, match=rf"port 127\.0\.0\.1:{port} .*in use.*: choose another, or 0"):
        UdpLink(MachineClock(), "rtp", bind=("127.0.0.1", port))


@pytest.mark.parametrize("host", ["a" * 64, "192.0.2.1"])
def test_address_of_another_machine(host: str) -> None:
    """An address of another machine, or an invalid one, raises a UserError."""
    with pytest.raises(UserError, match="cannot be opened"):
        UdpLink(MachineClock(), "rtp", bind=(host, 0))


def test_unknown_remote() -> None:
    """A server whose name cannot be resolved raises a UserError."""
    with pytest.raises(UserError, match="is not known"):
        open_link(remote=("a" * 64, 5600))


@pytest.mark.parametrize("started", [True, False])
def test_close(started: bool) -> None:
    """Closing a link ends its thread and frees its port."""
    before = set(threading.enumerate())
    link = open_link()
    port = link.port
    if started:
        link.start(Received())
    link.close()
    assert set(threading.enumerate()) <= before
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(("127.0.0.1", port))


def test_only_from_one_host(sender: socket.socket) -> None:
    """A link with `only_from` receives from any port of that host; datagrams of other hosts are counted."""
    received = Received()
    with (
        closing(UdpLink(MachineClock(), "rtp", bind=ANY_PORT, only_from="127.0.0.2")) as link,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as permitted,
    ):
        permitted.bind(("127.0.0.2", 0))
        link.start(received)
        sender.sendto(b"stranger", ("127.0.0.1", link.port))
        permitted.sendto(b"permitted", ("127.0.0.1", link.port))
        assert received.next().payload == b"permitted"
        assert link.counts["datagrams_from_strangers"] == 1
