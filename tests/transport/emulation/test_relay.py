from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from tests.support.clocks import ManualClock

from lavt.assembly.links import link_injection
from lavt.cli.relay import flows
from lavt.config import DelayConfig, ImpairmentConfig, LinkConfig, RelayConfig
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.streams import stream
from lavt.transport.emulation.delay_line import DelayModel
from lavt.transport.emulation.link import EmulatedLink
from lavt.transport.emulation.relay import NO_DELAY, Relay

TIMEOUT_S = 5.0
"""How long a test waits for a datagram that must arrive."""
VIDEO_MS, CONTROL_MS = 75.0, 40.0
CHALLENGE = b"LAVT challenge"
END_MARKER = b"end of the datagrams"


class UdpEnd:
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
        self.socket.settimeout(TIMEOUT_S)
        datagram, address = self.socket.recvfrom(65_535)
        return datagram, address

    def receive_all(self) -> list[bytes]:
        """Return all datagrams that have arrived: those before a marker that this end sends to itself."""
        self.send(END_MARKER, self.address)
        datagrams = []
        while (datagram := self.receive()[0]) != END_MARKER:
            datagrams.append(datagram)
        return datagrams

    def receives_nothing(self) -> bool:
        """Return whether no datagram has arrived; drop those that have."""
        return not self.receive_all()


class RelayNetwork:
    """A relay with a manual clock between one server and any number of clients."""

    def __init__(self, **delays: Any) -> None:
        self.udp_ends: list[UdpEnd] = []
        self.server = {"video": self.open_end(), "control": self.open_end()}
        self.clock = ManualClock(1_000 * NS_PER_S)
        config = RelayConfig(
            video_server=f"127.0.0.1:{self.server['video'].address[1]}",
            control_server=f"127.0.0.1:{self.server['control'].address[1]}",
            **{"video": DelayConfig(constant_ms=VIDEO_MS), "control": DelayConfig(constant_ms=CONTROL_MS), **delays},
        )
        self.relay = Relay(self.clock, flows(config))
        self.relay_addresses = {name: ("127.0.0.1", port) for name, port in self.relay.ports().items()}

    def open_end(self) -> UdpEnd:
        """Open a socket, which `close` closes."""
        self.udp_ends.append(UdpEnd())
        return self.udp_ends[-1]

    def step(self) -> None:
        """Let the relay handle the one datagram that was just sent to it."""
        self.relay.step(TIMEOUT_S)

    def advance(self, duration_ms: float) -> None:
        """Advance the clock and let the relay send what is due."""
        self.clock.advance(duration_ms)
        self.relay.step(0)

    def connect(self, flow: str) -> tuple[UdpEnd, tuple[str, int]]:
        """Open a client of a flow; return the client and the relay's address at which the server sees it."""
        client = self.open_end()
        client.send(b"hello", self.relay_addresses[flow])
        self.step()
        if flow == "control":
            self.advance(CONTROL_MS)
        datagram, address_at_server = self.server[flow].receive()
        assert datagram == b"hello"
        return client, ("127.0.0.1", address_at_server[1])

    def close(self) -> None:
        """Close everything."""
        self.relay.close()
        for end in self.udp_ends:
            end.socket.close()


@pytest.fixture
def net() -> Iterator[RelayNetwork]:
    """Open a relay that delays the video by 75 ms and the control by 40 ms, but not the state."""
    with closing(RelayNetwork()) as network:
        yield network


def rtp(timestamp: int, sequence: int = 0) -> bytes:
    return struct.pack(">BBHII", 0x80, 96, sequence, timestamp, 1) + b"picture"


def sender_report() -> bytes:
    return struct.pack(">BBHI", 0x80, 200, 6, 1) + bytes(20)


@pytest.mark.parametrize("datagram", [rtp(9000), sender_report()], ids=["RTP", "sender report"])
def test_video_is_delayed(net: RelayNetwork, datagram: bytes) -> None:
    """RTP and sender reports reach the client exactly when their delay has passed."""
    client, address_at_server = net.connect("video")
    net.server["video"].send(datagram, address_at_server)
    net.step()
    assert client.receives_nothing()
    net.advance(VIDEO_MS - 0.001)
    assert client.receives_nothing()
    net.advance(0.001)
    assert client.receive() == (datagram, net.relay_addresses["video"])


def test_challenges_are_not_delayed(net: RelayNetwork) -> None:
    """A challenge of the path validation is forwarded without delay and overtakes delayed video."""
    client, address_at_server = net.connect("video")
    for datagram in (rtp(9000), CHALLENGE):
        net.server["video"].send(datagram, address_at_server)
        net.step()
    assert client.receive()[0] == CHALLENGE
    assert client.receives_nothing()
    net.advance(VIDEO_MS)
    assert client.receive()[0] == rtp(9000)


@pytest.mark.parametrize("datagram", [b"L hello", struct.pack(">BBHI", 0x81, 201, 1, 1), rtp(1), b"\xff"])
def test_video_upstream_is_not_delayed(net: RelayNetwork, datagram: bytes) -> None:
    """Whatever the client sends on the video flow is forwarded without delay."""
    client, _ = net.connect("video")
    client.send(datagram, net.relay_addresses["video"])
    net.step()
    assert net.server["video"].receive()[0] == datagram


def test_control_is_delayed(net: RelayNetwork) -> None:
    """Datagrams from the client's router are delayed by the control delay."""
    client, _ = net.connect("control")
    client.send(b"command", net.relay_addresses["control"])
    net.step()
    net.advance(CONTROL_MS - 0.001)
    assert net.server["control"].receives_nothing()
    net.advance(0.001)
    assert net.server["control"].receive()[0] == b"command"


def test_state_is_not_delayed(net: RelayNetwork) -> None:
    """Without a delay for the state, datagrams from the server's router are forwarded without delay."""
    client, address_at_server = net.connect("control")
    net.server["control"].send(b"state", address_at_server)
    net.step()
    assert client.receive() == (b"state", net.relay_addresses["control"])


def test_state_with_a_delay_of_its_own_is_delayed() -> None:
    """If a delay is configured for the state, datagrams from the server's router are delayed by it."""
    with closing(RelayNetwork(state=DelayConfig(constant_ms=VIDEO_MS))) as net:
        client, address_at_server = net.connect("control")
        net.server["control"].send(b"state", address_at_server)
        net.step()
        net.advance(VIDEO_MS - 0.001)
        assert client.receives_nothing()
        net.advance(0.001)
        assert client.receive()[0] == b"state"


def test_delays_change_while_a_client_is_connected(net: RelayNetwork) -> None:
    """After a change, new datagrams of old and new clients have the new delay, and none overtakes an older one."""
    client, address_at_server = net.connect("video")
    net.server["video"].send(rtp(9000), address_at_server)
    net.step()
    net.relay.change_delays("video", upstream=NO_DELAY, downstream=DelayModel(10.0))
    net.server["video"].send(rtp(12000), address_at_server)
    net.step()
    net.advance(10.0)
    assert client.receives_nothing()
    net.advance(VIDEO_MS - 10.0)
    assert [client.receive()[0], client.receive()[0]] == [rtp(9000), rtp(12000)]
    other, other_at_server = net.connect("video")
    for end, address in ((client, address_at_server), (other, other_at_server)):
        net.server["video"].send(rtp(15000), address)
        net.step()
        assert end.receives_nothing()
        net.advance(10.0)
        assert end.receive()[0] == rtp(15000)


def test_each_client_has_its_own_address(net: RelayNetwork) -> None:
    """The server sees each client at an address of its own, and each client receives only its own datagrams."""
    (one, one_address), (two, two_address) = net.connect("video"), net.connect("video")
    assert one_address != two_address
    for datagram, to in ((b"for one", one_address), (b"for two", two_address)):
        net.server["video"].send(datagram, to)
        net.step()
    assert (one.receive()[0], two.receive()[0]) == (b"for one", b"for two")
    assert one.receives_nothing()
    assert two.receives_nothing()


def test_datagrams_not_from_the_server_are_ignored(net: RelayNetwork) -> None:
    """A datagram to a client's upstream socket is ignored unless it comes from the server."""
    client, address_at_server = net.connect("video")
    stranger = net.open_end()
    for sender, datagram in ((stranger, b"stolen"), (net.server["control"], b"wrong"), (net.server["video"], b"true")):
        sender.send(datagram, address_at_server)
        net.step()
    assert client.receive()[0] == b"true"
    assert client.receives_nothing()


def test_packets_of_a_frame_share_a_delay() -> None:
    """All packets of a frame share a delay, and a frame with a shorter delay waits for the frame before it."""
    delay = DelayConfig(constant_ms=10.0, jitter_median_ms=12.0, jitter_sigma=0.668)
    with closing(RelayNetwork(video=delay)) as net:
        client, address_at_server = net.connect("video")
        sent = [rtp(timestamp, sequence) for timestamp in range(0, 60_000, 3_000) for sequence in range(3)]
        for datagram in sent:
            net.server["video"].send(datagram, address_at_server)
            net.step()
        batches = []
        for _ in range(3_000):
            net.advance(0.1)
            if batch := client.receive_all():
                batches.append(batch)
    assert [datagram for batch in batches for datagram in batch] == sent
    assert len(batches) > 3
    assert all(len(batch) % 3 == 0 for batch in batches)


def test_any_bytes_pass_unchanged(net: RelayNetwork) -> None:
    """Datagrams of any bytes and length pass unchanged; only their first bits decide whether they are delayed."""
    client, address_at_server = net.connect("video")
    generator = stream(1, "garbage")
    datagrams = [b"", b"\x80", bytes(65_000), *(generator.bytes(int(generator.integers(1, 60))) for _ in range(300))]
    for datagram in datagrams:
        client.send(datagram, net.relay_addresses["video"])
        net.step()
        assert net.server["video"].receive()[0] == datagram
        net.server["video"].send(datagram, address_at_server)
        net.step()
        if len(datagram) >= 2 and datagram[0] >> 6 == 2:
            assert client.receives_nothing()
            net.advance(VIDEO_MS)
        assert client.receive()[0] == datagram


def test_relay_reports_the_measured_delays(net: RelayNetwork) -> None:
    """The relay reports the measured median delay of each flow and direction, None where nothing passed."""
    assert set(net.relay.median_delays_ms().values()) == {None}
    client, address_at_server = net.connect("video")
    for late_ms in (2.0, 7.0, 30.0):
        net.server["video"].send(rtp(1), address_at_server)
        net.step()
        net.advance(VIDEO_MS + late_ms)
        client.receive()
    assert net.relay.median_delays_ms() == {
        "video upstream": 0.0,
        "video downstream": VIDEO_MS + 7.0,
        "control upstream": None,
        "control downstream": None,
    }


def send_through(net: RelayNetwork, impairments: LinkConfig, count: int, period_ms: float) -> list[tuple[int, float]]:
    """Send numbered video packets through the relay; return the number and the arrival time (ms) of each that arrived.

    The relay sends what is due every half millisecond.
    """
    client, address_at_server = net.connect("video")
    arrived, begin_ns = [], net.clock.mono_ns
    steps_per_period = round(period_ms * 2)
    for step in range(count * steps_per_period + round(2 * (impairments.delay_ms + 8 * impairments.jitter_ms)) + 400):
        number, rest = divmod(step, steps_per_period)
        if rest == 0 and number < count:
            net.server["video"].send(rtp(3000 * number, number), address_at_server)
            net.step()
        arrived += [
            (int.from_bytes(datagram[2:4], "big"), (net.clock.mono_ns - begin_ns) / NS_PER_MS)
            for datagram in client.receive_all()
        ]
        net.advance(0.5)
    return arrived


LINKS = {
    "loss": LinkConfig(delay_ms=75.0, loss=0.3),
    "bursts": LinkConfig(delay_ms=75.0, loss=0.3, loss_burst_packets=4.0),
    "jitter": LinkConfig(delay_ms=75.0, jitter_ms=10.0),
    "correlated": LinkConfig(delay_ms=75.0, jitter_ms=10.0, jitter_correlation=0.9),
    "reorder": LinkConfig(delay_ms=75.0, reorder=0.25),
    "rate": LinkConfig(delay_ms=20.0, rate_bps=40_000, queue_packets=5),
    "delays": LinkConfig(trace="handover.csv"),
    "capacity": LinkConfig(delay_ms=20.0, trace="fading.mahimahi"),
}


@pytest.mark.parametrize("name", LINKS)
def test_relay_follows_the_link_model(name: str) -> None:
    """The relay loses, delays and counts packets exactly as the model of the link."""
    impairments = LINKS[name]
    with closing(RelayNetwork(video=DelayConfig(link=impairments))) as net:
        requested = link_injection(
            "video", impairments.delay_ms, ImpairmentConfig(**impairments.model_dump(exclude={"delay_ms"})), 1
        )
        assert requested is not None
        model = EmulatedLink(requested)
        arrived = send_through(net, impairments, count := 60, 10.0)
        counts = net.relay.counts()
        late_ms = net.relay.median_lateness_ms()["video downstream"]
    departures_ns = [model.departure_ns(round(10 * NS_PER_MS * number), 0, len(rtp(0))) for number in range(count)]
    expected = sorted(
        (departed_ns, number) for number, departed_ns in enumerate(departures_ns) if departed_ns is not None
    )
    assert [number for number, _ in arrived] == [number for _, number in expected]
    assert all(
        0 <= arrived_ms - expected_ns / NS_PER_MS <= 0.5
        for (_, arrived_ms), (expected_ns, _) in zip(arrived, expected, strict=True)
    )
    assert counts == {"video downstream": model.counts}
    assert late_ms is not None
    assert 0 <= late_ms <= 0.5


def test_control_loss_has_the_configured_share() -> None:
    """About the configured share of the control datagrams is lost, as the counters say."""
    with closing(RelayNetwork(control=DelayConfig(link=LinkConfig(loss=0.5)))) as net:
        client = net.open_end()
        for number in range(200):
            client.send(bytes([number]), net.relay_addresses["control"])
            net.step()
        arrived = net.server["control"].receive_all()
        counts = net.relay.counts()["control upstream"]
    assert counts["packets"] == 200
    assert len(arrived) == 200 - counts["lost"]
    assert 60 <= counts["lost"] <= 140
    assert arrived == sorted(arrived)


def test_the_packets_of_one_client_do_not_change_the_losses_of_another() -> None:
    """Each client has a link of its own with the same seed: of equal packets, two clients lose the same ones."""
    with closing(RelayNetwork(video=DelayConfig(link=LinkConfig(loss=0.3)))) as net:
        clients = [net.connect("video") for _ in range(2)]
        for number in range(100):
            for _, address_at_server in clients:
                net.server["video"].send(rtp(1, number), address_at_server)
                net.step()
        one, two = (client.receive_all() for client, _ in clients)
    assert one == two
    assert 50 < len(one) < 90


@pytest.mark.parametrize(
    ("link", "message"),
    [
        (LinkConfig(trace="nowhere"), "unknown trace 'nowhere'"),
        (LinkConfig(reorder=0.1), "reorder needs a delay"),
        (LinkConfig(rate_bps=1000, trace="fading.mahimahi"), "give one of the two"),
    ],
)
def test_invalid_links_are_rejected(link: LinkConfig, message: str) -> None:
    """A contradictory link, or one with an unknown trace, is rejected."""
    config = RelayConfig(video_server="127.0.0.1:1", control_server="127.0.0.1:1", control=DelayConfig(link=link))
    with pytest.raises(UserError, match=message):
        flows(config)


def test_counters_include_former_clients() -> None:
    """The counters of a flow include clients that the relay has removed."""
    with closing(RelayNetwork(control=DelayConfig(link=LinkConfig(loss=0.5)))) as net:
        for _ in range(2):
            client = net.open_end()
            for number in range(40):
                client.send(bytes([number]), net.relay_addresses["control"])
                net.step()
            net.advance(31_000)
        arrived = len(net.server["control"].receive_all())
        counts = net.relay.counts()["control upstream"]
    assert counts["packets"] == 80
    assert counts["lost"] == 80 - arrived > 0


def test_idle_client_is_removed(net: RelayNetwork) -> None:
    """A client that is idle for half a minute is removed when another connects, and is new if it sends again."""
    client, address_at_server = net.connect("video")
    net.advance(31_000)
    net.connect("video")
    client.send(b"again", net.relay_addresses["video"])
    net.step()
    datagram, new_address = net.server["video"].receive()
    assert datagram == b"again"
    assert new_address[1] != address_at_server[1]


def test_port_in_use_is_rejected() -> None:
    """A port in use is rejected with a message that names it."""
    with closing(UdpEnd().socket) as taken:
        port = taken.getsockname()[1]
        config = RelayConfig(
            video_server="127.0.0.1:1", control_server="127.0.0.1:1", control_listen=f"127.0.0.1:{port}"
        )
        with pytest.raises(UserError, match=rf"control port 127\.0\.0\.1:{port} .*in use"):
            Relay(ManualClock(1_000 * NS_PER_S), flows(config))


@pytest.mark.parametrize(
    "address",
    [
        "",
        "5600",
        "host:",
        ":5600",
        "127.0.0.1:65536",
        "127.0.0.1:x",
        "127.0.0.1:²",
        "127.0.0.1:-1",
        "tcp/127.0.0.1:7448",
        "a" * 64 + ":1",
        f"127.0.0.1:{'9' * 5000}",
    ],
)
def test_invalid_addresses_are_rejected(address: str) -> None:
    """An invalid address, or one of another transport than UDP, is rejected with its key."""
    config = RelayConfig(video_server=address, control_server="127.0.0.1:1")
    with pytest.raises(UserError, match="video_server"):
        flows(config)
