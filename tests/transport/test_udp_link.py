from __future__ import annotations

import queue
import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from tests.support.clocks import ShiftedClock

from lavt.clock import Clock, MachineClock
from lavt.domain import NS_PER_S, Now
from lavt.errors import UserError
from lavt.node import Send
from lavt.streams import stream
from lavt.transport.udp_link import UdpLink

ARRIVES_S = 5.0
ANY = ("127.0.0.1", 0)


class Heard:
    """What a link delivered."""

    def __init__(self) -> None:
        self.messages: queue.Queue[tuple[str, Any, Now, Any]] = queue.Queue()

    def __call__(self, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        """Take a message."""
        self.messages.put((channel, payload, arrived, peer))

    def next(self) -> tuple[str, Any, Now, Any]:
        """Wait for the next message."""
        return self.messages.get(timeout=ARRIVES_S)


def opened(heard: Heard, clock: Clock | None = None, remote: tuple[str, int] | None = None) -> UdpLink:
    return UdpLink(clock or MachineClock(), "rtp", heard, bind=ANY, remote=remote)


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    """A socket on loopback that belongs to nobody."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened_socket:
        opened_socket.bind(ANY)
        opened_socket.settimeout(ARRIVES_S)
        yield opened_socket


def test_delivers(sender: socket.socket) -> None:
    """A datagram is delivered on the link's channel, with the address it came from."""
    heard = Heard()
    with closing(opened(heard)) as link:
        link.start()
        sender.sendto(b"packet", ("127.0.0.1", link.port))
        channel, payload, _, peer = heard.next()
    assert (channel, payload, peer) == ("rtp", b"packet", sender.getsockname())


def test_time_of_arrival(sender: socket.socket) -> None:
    """Arrival is when the kernel got the datagram, however late the link takes it, and is never in the future."""
    heard = Heard()
    with closing(opened(heard)) as link:
        before = MachineClock().now()
        sender.sendto(b"early", ("127.0.0.1", link.port))
        taken_from = MachineClock().now()
        link.start()
        arrived = heard.next()[2]
    assert before.wall_ns <= arrived.wall_ns <= taken_from.wall_ns + NS_PER_S // 100
    assert before.mono_ns - NS_PER_S // 1000 <= arrived.mono_ns <= MachineClock().now().mono_ns


def test_arrival_on_both_clocks(sender: socket.socket) -> None:
    """A datagram that the kernel stamped 5 s ago arrived 5 s ago on the wall clock and on the monotonic clock."""
    heard, clock = Heard(), ShiftedClock(mono_ns=10**15, wall_ns=5 * NS_PER_S)
    with closing(opened(heard, clock)) as link:
        before = MachineClock().now()
        link.start()
        sender.sendto(b"packet", ("127.0.0.1", link.port))
        arrived = heard.next()[2]
        after = MachineClock().now()
    assert before.wall_ns <= arrived.wall_ns <= after.wall_ns
    mono_ns = arrived.mono_ns - 10**15 + 5 * NS_PER_S
    assert before.mono_ns - NS_PER_S // 1000 <= mono_ns <= after.mono_ns + NS_PER_S // 1000


@pytest.mark.parametrize("wall_s", [-5.0, 3600.0])
def test_stepped_clock(sender: socket.socket, wall_s: float) -> None:
    """A kernel's stamp in the future or an hour old is not believed: the wall clock was stepped, it arrived now."""
    heard, clock = Heard(), ShiftedClock(mono_ns=10**15, wall_ns=round(wall_s * NS_PER_S))
    with closing(opened(heard, clock)) as link:
        before = clock.now()
        link.start()
        sender.sendto(b"packet", ("127.0.0.1", link.port))
        arrived = heard.next()[2]
        after = clock.now()
    assert before.wall_ns <= arrived.wall_ns <= after.wall_ns
    assert before.mono_ns <= arrived.mono_ns <= after.mono_ns


def test_garbage(sender: socket.socket) -> None:
    """Datagrams of any content and length are delivered as they are and in order, the empty one too."""
    heard = Heard()
    generator = stream(1, "garbage")
    datagrams = [b"", bytes(65_000), *(generator.bytes(int(generator.integers(1, 1500))) for _ in range(100))]
    with closing(opened(heard)) as link:
        link.start()
        for datagram in datagrams:
            sender.sendto(datagram, ("127.0.0.1", link.port))
            assert heard.next()[1] == datagram


def test_send_to_a_peer(sender: socket.socket) -> None:
    """A link without a remote sends to the peer that a message names."""
    with closing(opened(Heard())) as link:
        link.send(Send("rtp", b"to you", sender.getsockname()))
        assert sender.recvfrom(100) == (b"to you", ("127.0.0.1", link.port))


@pytest.mark.parametrize("known", [True, False])
def test_send_to_the_remote(sender: socket.socket, known: bool) -> None:
    """A client's link sends to its remote: to the configured port, or else to the one that the session named."""
    port = sender.getsockname()[1]
    with closing(opened(Heard(), remote=("localhost", port if known else 0))) as link:
        link.send(Send("feedback", b"hello", 9 if known else port))
        assert sender.recv(100) == b"hello"


def test_what_cannot_be_sent() -> None:
    """A datagram that the system refuses is counted, and the link goes on."""
    with closing(opened(Heard())) as link:
        for payload, address in ((bytes(70_000), ANY), (b"x", ("255.255.255.255", 9)), (b"x", ANY)):
            link.send(Send("rtp", payload, address))
        assert link.counts == {"datagrams_not_sent": 3}


def test_port_in_use(sender: socket.socket) -> None:
    """A port that another program has is named in a sentence that says what to do."""
    port = sender.getsockname()[1]
    with pytest.raises(UserError, match=rf"port 127\.0\.0\.1:{port} .*in use.*: choose another, or 0"):
        UdpLink(MachineClock(), "rtp", Heard(), bind=("127.0.0.1", port))


@pytest.mark.parametrize("host", ["a" * 64, "192.0.2.1"])
def test_address_of_another_machine(host: str) -> None:
    """An address that is not this machine's, or none at all, is refused in a sentence."""
    with pytest.raises(UserError, match="cannot be opened"):
        UdpLink(MachineClock(), "rtp", Heard(), bind=(host, 0))


def test_unknown_remote() -> None:
    """A server that nobody can look up is refused at once."""
    with pytest.raises(UserError, match="is not known"):
        opened(Heard(), remote=("a" * 64, 5600))


@pytest.mark.parametrize("started", [True, False])
def test_close(started: bool) -> None:
    """Closing ends the thread and frees the port."""
    before = set(threading.enumerate())
    link = opened(Heard())
    port = link.port
    if started:
        link.start()
    link.close()
    assert set(threading.enumerate()) <= before
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind(("127.0.0.1", port))


def test_only_from_one_host(sender: socket.socket) -> None:
    """A link that only listens hears any port of the one host that it was given; the others are counted."""
    heard = Heard()
    with (
        closing(UdpLink(MachineClock(), "rtp", heard, bind=ANY, only_from="127.0.0.2")) as link,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as known,
    ):
        known.bind(("127.0.0.2", 0))
        link.start()
        sender.sendto(b"stranger", ("127.0.0.1", link.port))
        known.sendto(b"known", ("127.0.0.1", link.port))
        assert heard.next()[1] == b"known"
        assert link.counts["datagrams_from_strangers"] == 1
