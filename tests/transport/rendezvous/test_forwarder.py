from __future__ import annotations

import socket
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_S
from lavt.streams import stream
from lavt.transport.clock_sync.probe import ProbeReply, encode_reply, encode_request
from lavt.transport.rendezvous.forwarder import (
    ANSWERED_HOST_PER_S,
    CLIENT_TIMEOUT_NS,
    HOST_PER_S,
    MAX_CLIENTS,
    MAX_UNANSWERED,
    MAX_UPSTREAM_BYTES,
    REGISTER_EVERY_NS,
    UPSTREAM_PER_S,
    VEHICLE_TIMEOUT_NS,
    Address,
    FlowName,
    Forwarder,
    encode_registration,
    unwrap,
    wrap,
)
from lavt.transport.rtp.rtp import Packetizer
from lavt.transport.security.keys import PrivateKey
from lavt.transport.video.path_validation import PathClient, PathServer

VEHICLE, OTHER_ADDRESS = ("203.0.113.2", 40_000), ("203.0.113.66", 40_000)
CLIENT, SECOND_CLIENT = ("198.51.100.2", 50_000), ("198.51.100.7", 50_001)
HELLO = PathClient(b"t" * 16).hello(0)
REPORT = struct.pack(">BBHI", 0x80, 201, 1, 7)
NOW_NS = 100 * NS_PER_S
LATER_NS = NOW_NS + 2 * NS_PER_S
"""After this time all rate limits have been reset."""
UNSIGNED_BYTES = 4 + 1 + 1 + 8 + 32 + 8
"""Length of a registration before its signature; the fields are in docs/wire.md."""


@pytest.fixture(scope="module")
def key() -> PrivateKey:
    """Make the vehicle's signing key."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    return PrivateKey(Ed25519PrivateKey.generate())


def registered_forwarder(flow: FlowName = "video") -> Forwarder:
    """Return a forwarder without a key, at which the vehicle has registered."""
    forwarder = Forwarder("vehicle-1", flow, None)
    registration = encode_registration("vehicle-1", flow, 1, None)
    assert forwarder.receive(registration, VEHICLE, NOW_NS) is None
    assert forwarder.vehicle_address(NOW_NS) == VEHICLE
    return forwarder


def send_hello(forwarder: Forwarder, client: Address = CLIENT, now_ns: int = NOW_NS) -> tuple[bytes, Address] | None:
    return forwarder.receive(HELLO, client, now_ns)


def send_answer(forwarder: Forwarder, client: Address = CLIENT, now_ns: int = NOW_NS) -> tuple[bytes, Address] | None:
    """Send something from the vehicle to a client: a client is answered from then on."""
    return forwarder.receive(wrap(client, b"answer"), VEHICLE, now_ns)


def flood(forwarder: Forwarder, count: int) -> int:
    """Send hellos at the rate limit for unanswered clients, each from another host; return the time of the last."""
    now_ns = NOW_NS
    for number in range(count):
        now_ns = NOW_NS + number * NS_PER_S // UPSTREAM_PER_S
        if number % UPSTREAM_PER_S == 0:
            forwarder.receive(encode_registration("vehicle-1", "video", 2 + number, None), VEHICLE, now_ns)
        send_hello(forwarder, (socket.inet_ntoa((number + 1).to_bytes(4, "big")), 9), now_ns)
    return now_ns


def test_wire_format(key: PrivateKey) -> None:
    """Registrations and wrapped datagrams have the bytes that docs/wire.md describes."""
    plain = b"LAVR\x01\x01" + (258).to_bytes(8, "big") + b"vehicle-1".ljust(32, b"\0") + b"video".ljust(8, b"\0")
    assert encode_registration("vehicle-1", "video", 258, None) == plain
    signed = encode_registration("vehicle-1", "video", 258, key)
    assert signed[:UNSIGNED_BYTES] == plain
    assert key.public.verify(signed[UNSIGNED_BYTES:], b"LAVT 1 registration vehicle-1\0" + plain)
    assert wrap(("192.0.2.9", 258), b"rest") == b"LAVR\x01\x02" + bytes([192, 0, 2, 9, 1, 2]) + b"rest"


@given(st.ip_addresses(v=4), st.integers(0, 65535), st.binary(max_size=1500))
def test_unwrapping_undoes_wrapping(host: object, port: int, datagram: bytes) -> None:
    """Unwrapping a wrapped datagram returns the same datagram and address."""
    assert unwrap(wrap((str(host), port), datagram)) == ((str(host), port), datagram)


def test_datagrams_are_forwarded_both_ways() -> None:
    """A client's datagram goes to the vehicle wrapped, and the vehicle's answer to the client unwrapped."""
    forwarder = registered_forwarder()
    assert send_hello(forwarder) == (wrap(CLIENT, HELLO), VEHICLE)
    assert forwarder.receive(REPORT, CLIENT, NOW_NS) == (wrap(CLIENT, REPORT), VEHICLE)
    assert send_answer(forwarder) == (b"answer", CLIENT)
    assert forwarder.counts == {"registrations": 1, "to_vehicle": 2, "to_clients": 1}


def test_each_flow_accepts_only_its_own_datagrams() -> None:
    """Datagrams that no client sends on a flow are counted as malformed and not forwarded."""
    video, probe = registered_forwarder(), registered_forwarder("probe")
    request = encode_request(1, 2)
    reply = encode_reply(ProbeReply(1, 2, 3, 4, None, None))
    rtp = Packetizer(1, 1).packetize(b"\0\0\0\1\x65abc", 1)[0]
    assert probe.receive(request, CLIENT, NOW_NS) == (wrap(CLIENT, request), VEHICLE)
    for datagram in (HELLO, REPORT, rtp, reply, request + b"x", b""):
        assert probe.receive(datagram, CLIENT, NOW_NS) is None
    for datagram in (request, rtp, b"", b"anything", HELLO + bytes(MAX_UPSTREAM_BYTES)):
        assert video.receive(datagram, CLIENT, NOW_NS) is None
    assert video.receive(HELLO, VEHICLE, NOW_NS) is None, "the vehicle cannot be its own client"
    assert probe.counts["malformed"] == 6
    assert video.counts["malformed"] == 6


PREFIXES = [b"", b"LAVR", b"LAVR\x01\x01", b"LAVR\x01\x02", b"LAVT", b"LC\x01\x00"]


@given(st.binary(max_size=200), st.sampled_from(PREFIXES), st.sampled_from([VEHICLE, OTHER_ADDRESS, CLIENT]))
def test_arbitrary_datagrams_are_counted(rest: bytes, prefix: bytes, sender: Address) -> None:
    """An arbitrary datagram is counted and is forwarded to the vehicle or dropped; the vehicle stays registered."""
    forwarder = registered_forwarder()
    forwarded = forwarder.receive(prefix + rest, sender, NOW_NS)
    assert forwarded is None or (forwarded[1] == VEHICLE and sender != VEHICLE)
    assert forwarder.vehicle_address(NOW_NS) == VEHICLE
    assert sum(forwarder.counts.values()) == 2


def test_the_vehicle_can_only_send_to_recent_clients() -> None:
    """The vehicle can send only to addresses that have sent something in the last 30 s."""
    forwarder = registered_forwarder()
    assert send_answer(forwarder) is None
    send_hello(forwarder)
    assert send_answer(forwarder, SECOND_CLIENT) is None
    assert send_answer(forwarder) is not None
    late_ns = NOW_NS + CLIENT_TIMEOUT_NS + 1
    forwarder.receive(encode_registration("vehicle-1", "video", 2, None), VEHICLE, late_ns)
    assert send_answer(forwarder, now_ns=late_ns) is None
    assert forwarder.counts["to_nobody"] == 3


def test_only_the_vehicle_can_send_to_clients() -> None:
    """A wrapped datagram from any address but the registered vehicle's is dropped."""
    forwarder = registered_forwarder()
    send_hello(forwarder)
    for other in (OTHER_ADDRESS, CLIENT, (VEHICLE[0], VEHICLE[1] + 1)):
        assert forwarder.receive(wrap(CLIENT, b"forged"), other, NOW_NS) is None
    assert forwarder.counts["not_from_vehicle"] == 3


def test_only_the_vehicle_can_register(key: PrivateKey) -> None:
    """With a key, a registration without a signature or with an invalid one is rejected."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    forwarder = Forwarder("vehicle-1", "video", key.public)
    good = encode_registration("vehicle-1", "video", 5, key)
    stranger = PrivateKey(Ed25519PrivateKey.generate())
    forged = [
        encode_registration("vehicle-1", "video", 5, None),
        encode_registration("vehicle-1", "video", 5, stranger),
        encode_registration("vehicle-1", "video", 6, None) + good[UNSIGNED_BYTES:],
        good[:-1] + bytes([good[-1] ^ 1]),
    ]
    for registration in forged:
        forwarder.receive(registration, OTHER_ADDRESS, NOW_NS)
    assert forwarder.counts == {"registrations_forged": 4}
    assert forwarder.vehicle_address(NOW_NS) is None
    forwarder.receive(good, VEHICLE, NOW_NS)
    assert forwarder.vehicle_address(NOW_NS) == VEHICLE


def test_without_a_key_every_registration_is_accepted(key: PrivateKey) -> None:
    """Without a key, every registration with the vehicle's name and the flow is accepted, signed or not."""
    forwarder = Forwarder("vehicle-1", "video", None)
    forwarder.receive(encode_registration("vehicle-1", "video", 1, key), VEHICLE, NOW_NS)
    assert forwarder.vehicle_address(NOW_NS) == VEHICLE
    forwarder.receive(encode_registration("vehicle-1", "video", 2, None), OTHER_ADDRESS, NOW_NS)
    assert forwarder.vehicle_address(NOW_NS) == OTHER_ADDRESS


@pytest.mark.parametrize(("vehicle", "flow"), [("vehicle-2", "video"), ("vehicle-1", "probe")])
def test_registration_of_another_vehicle_or_flow_is_rejected(vehicle: str, flow: FlowName, key: PrivateKey) -> None:
    """A registration of another vehicle or flow is rejected, even if it is signed with the right key."""
    forwarder = Forwarder("vehicle-1", "video", key.public)
    registration = encode_registration(vehicle, flow, 1, key)
    forwarder.receive(registration, VEHICLE, NOW_NS)
    assert forwarder.counts == {"registrations_of_others": 1}
    assert forwarder.vehicle_address(NOW_NS) is None


def test_replayed_registration_is_rejected(key: PrivateKey) -> None:
    """A replayed or older registration is rejected."""
    forwarder = Forwarder("vehicle-1", "video", key.public)
    old, new = (encode_registration("vehicle-1", "video", time_ns, key) for time_ns in (5, 6))
    forwarder.receive(new, VEHICLE, NOW_NS)
    forwarder.receive(new, OTHER_ADDRESS, NOW_NS + 1)
    forwarder.receive(old, OTHER_ADDRESS, NOW_NS + VEHICLE_TIMEOUT_NS)
    assert forwarder.vehicle_address(NOW_NS + VEHICLE_TIMEOUT_NS) == VEHICLE
    assert forwarder.counts["registrations_stale"] == 2


def test_a_vehicle_moves_and_expires() -> None:
    """A newer registration from another address takes effect at once; a registration expires after 10 s."""
    forwarder = registered_forwarder()
    send_hello(forwarder)
    forwarder.receive(encode_registration("vehicle-1", "video", 2, None), OTHER_ADDRESS, NOW_NS + 1)
    assert send_hello(forwarder, now_ns=NOW_NS + 1) == (wrap(CLIENT, HELLO), OTHER_ADDRESS)
    assert send_answer(forwarder, now_ns=NOW_NS + 1) is None
    expired_ns = NOW_NS + 1 + VEHICLE_TIMEOUT_NS + 1
    assert forwarder.vehicle_address(expired_ns - 1) == OTHER_ADDRESS
    assert send_hello(forwarder, now_ns=expired_ns) is None
    assert forwarder.receive(wrap(CLIENT, b"late"), OTHER_ADDRESS, expired_ns) is None
    older_registration = encode_registration("vehicle-1", "video", 1, None)
    forwarder.receive(older_registration, VEHICLE, expired_ns)
    assert forwarder.vehicle_address(expired_ns) == VEHICLE, "its clock may have been set back"


def test_unanswered_clients_displace_no_answered_ones() -> None:
    """Unanswered clients displace no answered client; of either kind only a limited number is remembered."""
    forwarder = registered_forwarder()
    send_hello(forwarder)
    send_answer(forwarder)
    now_ns = flood(forwarder, 2 * MAX_UNANSWERED)
    assert send_answer(forwarder, now_ns=now_ns) == (b"answer", CLIENT)
    assert len(forwarder._clients._unanswered) == MAX_UNANSWERED
    for client in list(forwarder._clients._unanswered):
        send_answer(forwarder, client, now_ns)
    assert len(forwarder._clients._answered) == MAX_CLIENTS


def test_datagrams_to_the_vehicle_are_rate_limited() -> None:
    """Answered clients share one limit of datagrams per second to the vehicle, and unanswered clients another."""
    forwarder = registered_forwarder()
    send_hello(forwarder, SECOND_CLIENT)
    send_answer(forwarder, SECOND_CLIENT)
    hosts = [f"203.0.113.{number % 100}" for number in range(2 * UPSTREAM_PER_S)]
    unanswered = [send_hello(forwarder, (host, 9)) is not None for host in hosts]
    assert sum(unanswered) == UPSTREAM_PER_S - 1, "the hello of SECOND_CLIENT was one of the allowed ones"
    answered = [send_hello(forwarder, SECOND_CLIENT) is not None for _ in range(2 * UPSTREAM_PER_S)]
    assert sum(answered) == ANSWERED_HOST_PER_S
    assert send_hello(forwarder, now_ns=LATER_NS) is not None


@pytest.mark.parametrize(("flow", "datagram"), [("video", HELLO), ("video", REPORT), ("probe", encode_request(1, 1))])
def test_a_flood_with_the_address_of_an_answered_client_spares_the_others(flow: FlowName, datagram: bytes) -> None:
    """However much arrives with the address of one answered client, another answered client's datagrams pass."""
    forwarder = registered_forwarder(flow)
    for client in (CLIENT, SECOND_CLIENT):
        assert forwarder.receive(datagram, client, NOW_NS) is not None
        send_answer(forwarder, client)
    for _ in range(2 * UPSTREAM_PER_S):
        forwarder.receive(datagram, SECOND_CLIENT, NOW_NS)
    assert forwarder.receive(datagram, CLIENT, NOW_NS) is not None


def test_a_flood_with_a_clients_address_keeps_it_out_until_it_is_answered() -> None:
    """A flood from a new client's host keeps the client out, but no longer once the vehicle has answered the client.

    The flood comes from another port of that host: a datagram from the client's own port counts as the client's.
    """
    forwarder = registered_forwarder()
    false_address = (CLIENT[0], CLIENT[1] + 1)
    for _ in range(2 * UPSTREAM_PER_S):
        send_hello(forwarder, false_address)
    assert send_hello(forwarder) is None
    assert send_hello(forwarder, now_ns=LATER_NS) is not None, "it was the first since the limit was reset"
    assert send_answer(forwarder, now_ns=LATER_NS) is not None
    for _ in range(2 * UPSTREAM_PER_S):
        send_hello(forwarder, false_address, LATER_NS)
    assert send_hello(forwarder, now_ns=LATER_NS) is not None


def test_a_flood_from_one_host_does_not_keep_a_new_client_out() -> None:
    """If one host floods the rendezvous from many ports, the hellos and reports of a new client are still forwarded."""
    forwarder = registered_forwarder()
    for now_ns in range(NOW_NS, NOW_NS + 5 * NS_PER_S, NS_PER_S // 2):
        for port in range(1, 2 * UPSTREAM_PER_S):
            send_hello(forwarder, (OTHER_ADDRESS[0], port), now_ns)
            forwarder.receive(REPORT, (OTHER_ADDRESS[0], port), now_ns)
        assert send_hello(forwarder, now_ns=now_ns) is not None
        assert forwarder.receive(REPORT, CLIENT, now_ns) is not None
    assert send_answer(forwarder, now_ns=now_ns) is not None


def test_a_flood_does_not_displace_a_client_before_the_vehicle_answers() -> None:
    """If a flood from many addresses follows a client's hello, the vehicle's answer 4 s later still reaches it."""
    forwarder = registered_forwarder()
    send_hello(forwarder)
    last_ns = NOW_NS + 4 * NS_PER_S
    for now_ns in range(NOW_NS, last_ns + 1, NS_PER_S):
        for number in range(3 * UPSTREAM_PER_S):
            send_hello(forwarder, (f"203.0.113.{number % 250}", 1 + number), now_ns)
            forwarder.receive(REPORT, (f"203.0.113.{number % 250}", 1001 + number), now_ns)
    assert send_answer(forwarder, now_ns=last_ns) is not None


def test_a_flood_of_false_addresses_uses_little_memory_and_spares_answered_clients() -> None:
    """In a flood from many hosts only those within the rate limit are remembered, and answered clients still pass."""
    forwarder = registered_forwarder()
    send_hello(forwarder)
    send_answer(forwarder)
    for number in range(10 * UPSTREAM_PER_S):
        send_hello(forwarder, (socket.inet_ntoa((number + 1).to_bytes(4, "big")), 9))
    assert len(forwarder._clients._unanswered) == UPSTREAM_PER_S - 1, "the hello of CLIENT was one of the allowed ones"
    assert all(len(limiter._passed) <= UPSTREAM_PER_S for limiter in forwarder._unanswered_limiters.values())
    assert send_hello(forwarder) is not None
    assert forwarder.receive(REPORT, CLIENT, NOW_NS) is not None


def test_replayed_hellos_do_not_crowd_out_reports() -> None:
    """Replays of a client's hello from the client's address do not use up the rate limit of its reports."""
    forwarder = registered_forwarder()
    send_hello(forwarder)
    send_answer(forwarder)
    for _ in range(10 * UPSTREAM_PER_S):
        send_hello(forwarder)
    assert forwarder.counts["too_many"] > 0
    assert forwarder.receive(REPORT, CLIENT, NOW_NS) is not None


def test_replayed_hellos_from_many_addresses_do_not_displace_the_client() -> None:
    """The vehicle answers only a few copies of a hello, so the copies do not displace the client."""
    forwarder, path, client = registered_forwarder(), PathServer(lambda: bytes(16)), PathClient(b"t" * 16)
    path.set_token(b"t" * 16)

    def exchange(datagram: bytes, sender: Address) -> bytes:
        """Send a datagram to the vehicle through the forwarder; return the reply that the sender gets, or nothing."""
        forwarded = forwarder.receive(datagram, sender, NOW_NS)
        reply = None if forwarded is None else path.receive(datagram, sender, NOW_NS)
        back = None if reply is None else forwarder.receive(wrap(sender, reply), VEHICLE, NOW_NS)
        return b"" if back is None else back[0]

    newest = client.hello(0)
    exchange(client.answer(exchange(newest, CLIENT)) or b"", CLIENT)
    assert path.open_address(NOW_NS) == CLIENT
    for port in range(UPSTREAM_PER_S):
        exchange(newest, ("198.51.100.99", port + 1))
    assert forwarder.receive(wrap(CLIENT, b"video"), VEHICLE, NOW_NS) is not None


def test_floods_from_answered_addresses_spare_the_client_that_gets_the_video() -> None:
    """Floods from many addresses that got a challenge, also at the client's host, displace nothing of the client."""
    forwarder = registered_forwarder()
    others = [(f"203.0.113.{number}", 9) for number in range(1, 10)] + [(CLIENT[0], CLIENT[1] + 1)]
    for client in (CLIENT, *others):
        send_hello(forwarder, client)
        assert forwarder.receive(wrap(client, b"LAVT challenge"), VEHICLE, NOW_NS) is not None
    assert forwarder.receive(wrap(CLIENT, b"video"), VEHICLE, NOW_NS) == (b"video", CLIENT)
    for other in others * UPSTREAM_PER_S:
        forwarder.receive(REPORT, other, NOW_NS)
        send_hello(forwarder, other)
    assert forwarder.receive(REPORT, CLIENT, NOW_NS) is not None
    assert send_hello(forwarder) is not None


@pytest.mark.parametrize(("flow", "payload"), [("video", b"LAVT challenge"), ("probe", b"reply")])
def test_an_answer_other_than_video_gives_no_limit_of_its_own(flow: FlowName, payload: bytes) -> None:
    """Clients that got only a challenge or the reply to a probe share one limit, and so have at most that many."""
    forwarder = registered_forwarder(flow)
    datagram = REPORT if flow == "video" else encode_request(1, 1)
    clients = [(f"203.0.113.{number}", 9) for number in range(1, 10)]
    for client in clients:
        forwarder.receive(datagram, client, NOW_NS)
        forwarder.receive(wrap(client, payload), VEHICLE, NOW_NS)
    passed = sum(forwarder.receive(datagram, client, NOW_NS) is not None for client in clients * UPSTREAM_PER_S)
    assert passed == UPSTREAM_PER_S


@pytest.mark.parametrize("first", [None, OTHER_ADDRESS])
def test_forged_registrations_from_one_host_do_not_keep_the_vehicle_out(first: Address | None, key: PrivateKey) -> None:
    """In a flood of forged registrations from one host, the vehicle registers at once, also from another address."""
    forwarder = Forwarder("vehicle-1", "video", key.public)
    if first is not None:
        forwarder.receive(encode_registration("vehicle-1", "video", 5, key), first, NOW_NS)
    forged = encode_registration("vehicle-1", "video", 6, None)
    for port in range(1, 2 * UPSTREAM_PER_S):
        forwarder.receive(forged, ("203.0.113.99", port), NOW_NS)
    assert forwarder.counts["registrations_forged"] == HOST_PER_S
    forwarder.receive(encode_registration("vehicle-1", "video", 7, key), VEHICLE, NOW_NS)
    assert forwarder.vehicle_address(NOW_NS) == VEHICLE


@pytest.mark.parametrize("now_ns", [LATER_NS, LATER_NS + VEHICLE_TIMEOUT_NS])
def test_forged_registrations_from_many_hosts_are_rate_limited(now_ns: int, key: PrivateKey) -> None:
    """In a flood from many hosts few signatures are verified, and the vehicle registers at once from its last address.

    This also holds if its registration has expired.
    """
    forwarder = Forwarder("vehicle-1", "video", key.public)
    forwarder.receive(encode_registration("vehicle-1", "video", 5, key), VEHICLE, NOW_NS)
    forged = encode_registration("vehicle-1", "video", 6, None)
    for number in range(2 * UPSTREAM_PER_S):
        forwarder.receive(forged, (f"198.51.100.{number % 200}", 9), now_ns)
    assert forwarder.counts["registrations_forged"] == UPSTREAM_PER_S
    forwarder.receive(encode_registration("vehicle-1", "video", 7, key), VEHICLE, now_ns)
    assert forwarder.counts["registrations"] == 2


@pytest.mark.parametrize("burst", [1, 500])
@pytest.mark.parametrize("phase", [0.0, 0.2, 0.4, 0.6, 0.8])
def test_forged_registrations_from_many_hosts_only_delay_the_vehicle(phase: float, burst: int, key: PrivateKey) -> None:
    """500 forged registrations a second from many hosts, evenly spaced or at once, delay the first one by at most 20 s.

    This holds for any phase between the flood and the vehicle, which registers every second.
    """
    chance = stream(1, f"windows {phase}")
    forwarder = Forwarder("vehicle-1", "video", key.public, random_below=lambda limit: int(chance.integers(limit)))
    forged = encode_registration("vehicle-1", "video", 10**18, None)
    start_ns = next_ns = NOW_NS + round(phase * NS_PER_S)
    for number in range(20 * 500):
        now_ns = start_ns + number // burst * burst * NS_PER_S // 500
        forwarder.receive(forged, (f"198.51.100.{number % 200}", 9), now_ns)
        while next_ns < now_ns:
            forwarder.receive(encode_registration("vehicle-1", "video", next_ns, key), VEHICLE, next_ns)
            next_ns += REGISTER_EVERY_NS
    assert forwarder.counts["registrations"] > 0


def test_the_longest_packet_fits_the_minimum_mtu() -> None:
    """The longest packet, an encrypted and wrapped repair packet, fits into 1280 bytes with its IP and UDP headers."""
    ip_and_udp_bytes, media_bytes, repair_bytes, srtp_bytes = 28, 1200, 14, 16
    assert ip_and_udp_bytes + len(wrap(CLIENT, bytes(media_bytes + repair_bytes + srtp_bytes))) <= 1280
