from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from tests.support.clocks import ManualClock

from lavt.assembly.links import injected
from lavt.cli.relay import flows
from lavt.config import DelayConfig, ImpairmentConfig, LinkConfig, RelayConfig
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.streams import stream
from lavt.transport.emulation.link import EmulatedLink
from lavt.transport.emulation.relay import Relay

ARRIVES_S = 5.0
"""So long a test waits for what must come."""
VIDEO_MS, CONTROL_MS = 75.0, 40.0
CHALLENGE = b"LAVT challenge"
LAST = b"that was all"


class End:
    """A socket of a client or a server on loopback."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.address: tuple[str, int] = self.socket.getsockname()

    def send(self, datagram: bytes, to: tuple[str, int]) -> None:
        """Send a datagram."""
        self.socket.sendto(datagram, to)

    def receive(self) -> tuple[bytes, tuple[str, int]]:
        """Wait for the next datagram."""
        self.socket.settimeout(ARRIVES_S)
        datagram, address = self.socket.recvfrom(65_535)
        return datagram, address

    def waiting(self) -> list[bytes]:
        """Take what has come so far: all that was sent on this machine before a last datagram to itself."""
        self.send(LAST, self.address)
        datagrams = []
        while (datagram := self.receive()[0]) != LAST:
            datagrams.append(datagram)
        return datagrams

    def hears_nothing(self) -> bool:
        """Whether nothing has come so far."""
        return not self.waiting()


class Net:
    """A relay under a manual clock between one server and as many clients as a test wants."""

    def __init__(self, **delays: Any) -> None:
        self.ends: list[End] = []
        self.server = {"video": self.end(), "control": self.end()}
        self.clock = ManualClock(1_000 * NS_PER_S)
        config = RelayConfig(
            video_server=f"127.0.0.1:{self.server['video'].address[1]}",
            control_server=f"127.0.0.1:{self.server['control'].address[1]}",
            **{"video": DelayConfig(constant_ms=VIDEO_MS), "control": DelayConfig(constant_ms=CONTROL_MS), **delays},
        )
        self.relay = Relay(self.clock, flows(config))
        self.at = {name: ("127.0.0.1", port) for name, port in self.relay.ports().items()}

    def end(self) -> End:
        """Open a socket that is closed with the net."""
        self.ends.append(End())
        return self.ends[-1]

    def step(self) -> None:
        """Let the relay take the one datagram that was just sent to it."""
        self.relay.step(ARRIVES_S)

    def later(self, duration_ms: float) -> None:
        """Let time go by, and the relay do what is then due."""
        self.clock.advance(duration_ms)
        self.relay.step(0)

    def connect(self, flow: str) -> tuple[End, tuple[str, int]]:
        """Open a client of a flow; returns it and where the server sees it."""
        client = self.end()
        client.send(b"hello", self.at[flow])
        self.step()
        if flow == "control":
            self.later(CONTROL_MS)
        datagram, seen_at = self.server[flow].receive()
        assert datagram == b"hello"
        return client, ("127.0.0.1", seen_at[1])

    def close(self) -> None:
        """Close everything."""
        self.relay.close()
        for end in self.ends:
            end.socket.close()


@pytest.fixture
def net() -> Iterator[Net]:
    """A relay that holds video 75 ms and control 40 ms, and no state."""
    with closing(Net()) as opened:
        yield opened


def rtp(timestamp: int, sequence: int = 0) -> bytes:
    return struct.pack(">BBHII", 0x80, 96, sequence, timestamp, 1) + b"picture"


def sender_report() -> bytes:
    return struct.pack(">BBHI", 0x80, 200, 6, 1) + bytes(20)


@pytest.mark.parametrize("datagram", [rtp(9000), sender_report()], ids=["RTP", "sender report"])
def test_video_waits(net: Net, datagram: bytes) -> None:
    """RTP and sender reports to the client are sent when their delay is over, and not a moment before."""
    client, seen_at = net.connect("video")
    net.server["video"].send(datagram, seen_at)
    net.step()
    assert client.hears_nothing()
    net.later(VIDEO_MS - 0.001)
    assert client.hears_nothing()
    net.later(0.001)
    assert client.receive() == (datagram, net.at["video"])


def test_challenge_does_not_wait(net: Net) -> None:
    """A challenge, by which a path is proven, passes at once and overtakes the video that waits."""
    client, seen_at = net.connect("video")
    for datagram in (rtp(9000), CHALLENGE):
        net.server["video"].send(datagram, seen_at)
        net.step()
    assert client.receive()[0] == CHALLENGE
    assert client.hears_nothing()
    net.later(VIDEO_MS)
    assert client.receive()[0] == rtp(9000)


@pytest.mark.parametrize("datagram", [b"L hello", struct.pack(">BBHI", 0x81, 201, 1, 1), rtp(1), b"\xff"])
def test_nothing_upstream_of_the_video_waits(net: Net, datagram: bytes) -> None:
    """Hellos, RTCP and whatever else the client sends on the video's flow pass at once."""
    client, _ = net.connect("video")
    client.send(datagram, net.at["video"])
    net.step()
    assert net.server["video"].receive()[0] == datagram


def test_control_waits(net: Net) -> None:
    """What the client's router sends waits for the delay of control."""
    client, _ = net.connect("control")
    client.send(b"command", net.at["control"])
    net.step()
    net.later(CONTROL_MS - 0.001)
    assert net.server["control"].hears_nothing()
    net.later(0.001)
    assert net.server["control"].receive()[0] == b"command"


def test_state_does_not_wait(net: Net) -> None:
    """What the server's router answers passes at once."""
    client, seen_at = net.connect("control")
    net.server["control"].send(b"state", seen_at)
    net.step()
    assert client.receive() == (b"state", net.at["control"])


def test_state_waits_where_requested() -> None:
    """With a delay of its own the state waits for it, and not for that of control."""
    with closing(Net(state=DelayConfig(constant_ms=VIDEO_MS))) as net:
        client, seen_at = net.connect("control")
        net.server["control"].send(b"state", seen_at)
        net.step()
        net.later(VIDEO_MS - 0.001)
        assert client.hears_nothing()
        net.later(0.001)
        assert client.receive()[0] == b"state"


def test_two_clients(net: Net) -> None:
    """The server sees each client at an address of its own, and each gets only what was sent to it."""
    (one, one_at), (two, two_at) = net.connect("video"), net.connect("video")
    assert one_at != two_at
    for datagram, to in ((b"for one", one_at), (b"for two", two_at)):
        net.server["video"].send(datagram, to)
        net.step()
    assert (one.receive()[0], two.receive()[0]) == (b"for one", b"for two")
    assert one.hears_nothing()
    assert two.hears_nothing()


def test_stranger(net: Net) -> None:
    """A datagram to the socket that stands for a client is ignored unless it comes from the server."""
    client, seen_at = net.connect("video")
    for sender, datagram in ((net.end(), b"stolen"), (net.server["control"], b"wrong"), (net.server["video"], b"true")):
        sender.send(datagram, seen_at)
        net.step()
    assert client.receive()[0] == b"true"
    assert client.hears_nothing()


def test_frames_stay_whole_and_in_order() -> None:
    """All packets of one frame share a delay, a frame with a shorter delay waits for the one before it."""
    delay = DelayConfig(constant_ms=10.0, jitter_median_ms=12.0, jitter_sigma=0.668)
    with closing(Net(video=delay)) as net:
        client, seen_at = net.connect("video")
        sent = [rtp(timestamp, sequence) for timestamp in range(0, 60_000, 3_000) for sequence in range(3)]
        for datagram in sent:
            net.server["video"].send(datagram, seen_at)
            net.step()
        moments = []
        for _ in range(3_000):
            net.later(0.1)
            if together := client.waiting():
                moments.append(together)
    assert [datagram for together in moments for datagram in together] == sent
    assert len(moments) > 3
    assert all(len(together) % 3 == 0 for together in moments)


def test_garbage(net: Net) -> None:
    """Bytes of any kind and length pass as they are; only their first bits decide whether they wait."""
    client, seen_at = net.connect("video")
    generator = stream(1, "garbage")
    up = [b"", b"\x80", bytes(65_000), *(generator.bytes(int(generator.integers(1, 60))) for _ in range(300))]
    for datagram in up:
        client.send(datagram, net.at["video"])
        net.step()
        assert net.server["video"].receive()[0] == datagram
        net.server["video"].send(datagram, seen_at)
        net.step()
        if len(datagram) >= 2 and datagram[0] >> 6 == 2:
            assert client.hears_nothing()
            net.later(VIDEO_MS)
        assert client.receive()[0] == datagram


def test_held(net: Net) -> None:
    """The relay tells for how long it really held, for each flow and direction; null where nothing came."""
    assert set(net.relay.held_ms().values()) == {None}
    client, seen_at = net.connect("video")
    for late_ms in (2.0, 7.0, 30.0):
        net.server["video"].send(rtp(1), seen_at)
        net.step()
        net.later(VIDEO_MS + late_ms)
        client.receive()
    assert net.relay.held_ms() == {
        "video upstream": 0.0, "video downstream": VIDEO_MS + 7.0, "control upstream": None, "control downstream": None,
    }  # fmt: skip


def through(net: Net, impairments: LinkConfig, count: int, period_ms: float) -> list[tuple[int, float]]:
    """Send numbered packets through a net of this law at a period; gives the number of each that came, and when."""
    client, seen_at = net.connect("video")
    came, begin_ns = [], net.clock.mono_ns
    steps_a_period = round(period_ms * 2)
    for step in range(count * steps_a_period + round(2 * (impairments.delay_ms + 8 * impairments.jitter_ms)) + 400):
        number, rest = divmod(step, steps_a_period)
        if rest == 0 and number < count:
            net.server["video"].send(rtp(3000 * number, number), seen_at)
            net.step()
        came += [
            (int.from_bytes(each[2:4], "big"), (net.clock.mono_ns - begin_ns) / NS_PER_MS) for each in client.waiting()
        ]
        net.later(0.5)
    return came


LINKS = {
    "loss": LinkConfig(delay_ms=75.0, loss=0.3),
    "bursts": LinkConfig(delay_ms=75.0, loss=0.3, loss_burst_packets=4.0),
    "jitter": LinkConfig(delay_ms=75.0, jitter_ms=10.0),
    "wander": LinkConfig(delay_ms=75.0, jitter_ms=10.0, jitter_correlation=0.9),
    "reorder": LinkConfig(delay_ms=75.0, reorder=0.25),
    "rate": LinkConfig(delay_ms=20.0, rate_bps=40_000, queue_packets=5),
    "delays": LinkConfig(trace="handover.csv"),
    "capacity": LinkConfig(delay_ms=20.0, trace="fading.mahimahi"),
}


@pytest.mark.parametrize("name", LINKS)
def test_the_relay_does_what_the_link_says(name: str) -> None:
    """Through the relay each packet is lost, or leaves, as the model of the link has it, and that is counted."""
    impairments = LINKS[name]
    with closing(Net(video=DelayConfig(link=impairments))) as net:
        requested = injected(
            "video", impairments.delay_ms, ImpairmentConfig(**impairments.model_dump(exclude={"delay_ms"})), 1
        )
        assert requested is not None
        model = EmulatedLink(requested)
        came = through(net, impairments, count := 60, 10.0)
        counts = net.relay.counts()
        late_ms = net.relay.late_ms()["video downstream"]
    left = [model.departure_ns(round(10 * NS_PER_MS * number), 0, len(rtp(0))) for number in range(count)]
    # the relay looks every half millisecond here
    expected = sorted((each, number) for number, each in enumerate(left) if each is not None)
    assert [number for number, _ in came] == [number for _, number in expected]
    assert all(0 <= at - each_ns / NS_PER_MS <= 0.5 for (_, at), (each_ns, _) in zip(came, expected, strict=True))
    assert counts == {"video downstream": model.counts}
    assert late_ms is not None
    assert 0 <= late_ms <= 0.5


def test_losses_of_control() -> None:
    """What is lost upstream of the control is the share asked for; the state and the video are left alone."""
    with closing(Net(control=DelayConfig(link=LinkConfig(loss=0.5)))) as net:
        client = net.end()
        for number in range(200):
            client.send(bytes([number]), net.at["control"])
            net.step()
        came = net.server["control"].waiting()
        counts = net.relay.counts()["control upstream"]
    assert counts["packets"] == 200
    assert len(came) == 200 - counts["lost"]
    assert 60 <= counts["lost"] <= 140
    assert came == sorted(came)


def test_each_client_has_a_link_of_its_own() -> None:
    """What is lost for one client does not depend on what others are sent."""
    with closing(Net(video=DelayConfig(link=LinkConfig(loss=0.3)))) as net:
        clients = [net.connect("video") for _ in range(2)]
        for number in range(100):
            for _, seen_at in clients:
                net.server["video"].send(rtp(1, number), seen_at)
                net.step()
        one, two = (client.waiting() for client, _ in clients)
    assert one == two
    assert 50 < len(one) < 90


@pytest.mark.parametrize(
    ("link", "said"),
    [
        (LinkConfig(trace="nowhere"), "there is no trace 'nowhere'"),
        (LinkConfig(reorder=0.1), "reorder needs a delay"),
        (LinkConfig(rate_bps=1000, trace="fading.mahimahi"), "give one of the two"),
    ],
)
def test_bad_links(link: LinkConfig, said: str) -> None:
    """A link that contradicts itself, or has no trace, is refused in a sentence."""
    config = RelayConfig(video_server="127.0.0.1:1", control_server="127.0.0.1:1", control=DelayConfig(link=link))
    with pytest.raises(UserError, match=said):
        flows(config)


def test_clients_that_are_gone_are_counted() -> None:
    """What became of a client's packets is counted for its flow when the relay has forgotten the client."""
    with closing(Net(control=DelayConfig(link=LinkConfig(loss=0.5)))) as net:
        for _ in range(2):
            client = net.end()
            for number in range(40):
                client.send(bytes([number]), net.at["control"])
                net.step()
            net.later(31_000)
        came = len(net.server["control"].waiting())
        counts = net.relay.counts()["control upstream"]
    assert counts["packets"] == 80
    assert counts["lost"] == 80 - came > 0


def test_silent_client(net: Net) -> None:
    """A client silent for half a minute loses its socket when another comes, and begins anew when it speaks."""
    client, seen_at = net.connect("video")
    net.later(31_000)
    net.connect("video")
    client.send(b"again", net.at["video"])
    net.step()
    datagram, now_at = net.server["video"].receive()
    assert datagram == b"again"
    assert now_at[1] != seen_at[1]


def test_port_in_use() -> None:
    """A port that another program has is named in a sentence that says what to do."""
    with closing(End().socket) as taken:
        port = taken.getsockname()[1]
        config = RelayConfig(
            video_server="127.0.0.1:1", control_server="127.0.0.1:1", control_listen=f"127.0.0.1:{port}"
        )
        with pytest.raises(UserError, match=rf"control port 127\.0\.0\.1:{port} .* in use.*: name another, or 0"):
            Relay(ManualClock(1_000 * NS_PER_S), flows(config))


@pytest.mark.parametrize(
    "address", ["", "5600", "host:", ":5600", "127.0.0.1:65536", "127.0.0.1:x", "127.0.0.1:²", "127.0.0.1:-1",
                "tcp/127.0.0.1:7448", "a" * 64 + ":1", f"127.0.0.1:{'9' * 5000}"],
)  # fmt: skip
def test_bad_addresses(address: str) -> None:
    """An address that is none, or names another transport than UDP, is refused with its key."""
    config = RelayConfig(video_server=address, control_server="127.0.0.1:1")
    with pytest.raises(UserError, match="video_server"):
        flows(config)
