from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_S
from lavt.transport.clock_sync.probe import ProbeReply, encode_reply, encode_request
from lavt.transport.rendezvous.forwarder import (
    CLIENT_SILENCE_NS,
    LONGEST_UPSTREAM_BYTES,
    MOST_CLIENTS,
    REGISTRATIONS_PER_S,
    UPSTREAM_PER_S,
    VEHICLE_SILENCE_NS,
    Address,
    Forwarder,
    encode_registration,
    unwrap,
    wrap,
)
from lavt.transport.rtp.rtp import Packetizer
from lavt.transport.security.keys import PrivateKey
from lavt.transport.video.path_validation import PathClient

VEHICLE, OTHER = ("203.0.113.2", 40_000), ("203.0.113.66", 40_000)
CLIENT, SECOND = ("198.51.100.2", 50_000), ("198.51.100.7", 50_001)
HELLO = PathClient(b"t" * 16).hello(0)
REPORT = struct.pack(">BBHI", 0x80, 201, 1, 7)
T = 100 * NS_PER_S


@pytest.fixture(scope="module")
def key() -> PrivateKey:
    """A vehicle's signing key."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    return PrivateKey(Ed25519PrivateKey.generate())


def registered(flow: str = "video") -> Forwarder:
    """A forwarder without keys, at which the vehicle has registered."""
    forwarder = Forwarder("vehicle-1", "probe" if flow == "probe" else "video", None)
    registration = encode_registration("vehicle-1", "probe" if flow == "probe" else "video", 1, None)
    assert forwarder.receive(registration, VEHICLE, T) is None
    assert forwarder.vehicle_at(T) == VEHICLE
    return forwarder


def ask(forwarder: Forwarder, client: Address = CLIENT, now_ns: int = T) -> tuple[bytes, Address] | None:
    return forwarder.receive(HELLO, client, now_ns)


def answer(forwarder: Forwarder, client: Address = CLIENT, now_ns: int = T) -> tuple[bytes, Address] | None:
    return forwarder.receive(wrap(client, b"answer"), VEHICLE, now_ns)


def test_bytes_on_the_wire(key: PrivateKey) -> None:
    """Registration and wrapping are as docs/wire.md says: magic, version, kind, and their fields in network order."""
    said = b"LAVR\x01\x01" + (258).to_bytes(8, "big") + b"vehicle-1".ljust(32, b"\0") + b"video".ljust(8, b"\0")
    assert encode_registration("vehicle-1", "video", 258, None) == said
    signed = encode_registration("vehicle-1", "video", 258, key)
    assert signed[:54] == said
    assert key.public.verify(signed[54:], b"LAVT 1 registration vehicle-1\0" + said)
    assert wrap(("192.0.2.9", 258), b"rest") == b"LAVR\x01\x02" + bytes([192, 0, 2, 9, 1, 2]) + b"rest"


@given(st.ip_addresses(v=4), st.integers(0, 65535), st.binary(max_size=1500))
def test_unwrapping_undoes_wrapping(host: object, port: int, datagram: bytes) -> None:
    """Whatever was wrapped comes out as it was, with its address."""
    assert unwrap(wrap((str(host), port), datagram)) == ((str(host), port), datagram)


def test_there_and_back() -> None:
    """What a client says goes to the vehicle with the client's address, and what it answers to the client without."""
    forwarder = registered()
    assert ask(forwarder) == (wrap(CLIENT, HELLO), VEHICLE)
    assert forwarder.receive(REPORT, CLIENT, T) == (wrap(CLIENT, REPORT), VEHICLE)
    assert answer(forwarder) == (b"answer", CLIENT)
    assert forwarder.counts == {"registrations": 1, "to_vehicle": 2, "to_clients": 1}


def test_each_flow_has_its_own() -> None:
    """Of clients only hellos, answers and RTCP go on in the video, and requests in the probe; the rest is counted."""
    video, probe = registered(), registered("probe")
    request = encode_request(1, 2)
    reply = encode_reply(ProbeReply(1, 2, 3, 4, None, None))
    rtp = Packetizer(1, 1).packetize(b"\0\0\0\1\x65abc", 1)[0]
    assert probe.receive(request, CLIENT, T) == (wrap(CLIENT, request), VEHICLE)
    for other in (HELLO, REPORT, rtp, reply, request + b"x", b""):
        assert probe.receive(other, CLIENT, T) is None
    for other in (request, rtp, b"", b"anything", HELLO + bytes(LONGEST_UPSTREAM_BYTES)):
        assert video.receive(other, CLIENT, T) is None
    assert video.receive(HELLO, VEHICLE, T) is None, "the vehicle is no client of its own"
    assert probe.counts["malformed"] == 6
    assert video.counts["malformed"] == 6


BEGINNINGS = [b"", b"LAVR", b"LAVR\x01\x01", b"LAVR\x01\x02", b"LAVT", b"LC\x01\x00"]


@given(st.binary(max_size=200), st.sampled_from(BEGINNINGS), st.sampled_from([VEHICLE, OTHER, CLIENT]))
def test_any_bytes(rest: bytes, begin: bytes, sender: Address) -> None:
    """No datagram from anywhere raises, unseats the vehicle or goes elsewhere than to it; and each is counted."""
    forwarder = registered()
    passed = forwarder.receive(begin + rest, sender, T)
    assert passed is None or (passed[1] == VEHICLE and sender != VEHICLE)
    assert forwarder.vehicle_at(T) == VEHICLE
    assert sum(forwarder.counts.values()) == 2


def test_nobody_is_reached_who_did_not_ask() -> None:
    """The vehicle itself can send to nobody who was not heard in the last 30 s: no client, no third party."""
    forwarder = registered()
    assert answer(forwarder) is None
    ask(forwarder)
    assert answer(forwarder, SECOND) is None
    assert answer(forwarder) is not None
    late_ns = T + CLIENT_SILENCE_NS + 1
    forwarder.receive(encode_registration("vehicle-1", "video", 2, None), VEHICLE, late_ns)
    assert answer(forwarder, now_ns=late_ns) is None
    assert forwarder.counts["to_nobody"] == 3


def test_only_the_vehicle_answers() -> None:
    """What is wrapped by anybody but the registered vehicle goes nowhere."""
    forwarder = registered()
    ask(forwarder)
    for other in (OTHER, CLIENT, (VEHICLE[0], VEHICLE[1] + 1)):
        assert forwarder.receive(wrap(CLIENT, b"forged"), other, T) is None
    assert forwarder.counts["not_from_vehicle"] == 3


def test_only_the_vehicle_registers(key: PrivateKey) -> None:
    """With its key only the vehicle's own signature registers: not none, another's, one over something else."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    forwarder = Forwarder("vehicle-1", "video", key.public)
    good = encode_registration("vehicle-1", "video", 5, key)
    stranger = PrivateKey(Ed25519PrivateKey.generate())
    forged = [
        encode_registration("vehicle-1", "video", 5, None),
        encode_registration("vehicle-1", "video", 5, stranger),
        encode_registration("vehicle-1", "video", 6, None) + good[54:],
        good[:-1] + bytes([good[-1] ^ 1]),
    ]
    for each in forged:
        forwarder.receive(each, OTHER, T)
    assert forwarder.counts == {"registrations_forged": 4}
    assert forwarder.vehicle_at(T) is None
    forwarder.receive(good, VEHICLE, T)
    assert forwarder.vehicle_at(T) == VEHICLE


def test_without_the_key(key: PrivateKey) -> None:
    """A rendezvous that has no key takes any registration of the vehicle's name and the flow, signed or not."""
    forwarder = Forwarder("vehicle-1", "video", None)
    forwarder.receive(encode_registration("vehicle-1", "video", 1, key), VEHICLE, T)
    assert forwarder.vehicle_at(T) == VEHICLE
    forwarder.receive(encode_registration("vehicle-1", "video", 2, None), OTHER, T)
    assert forwarder.vehicle_at(T) == OTHER


@pytest.mark.parametrize(("vehicle", "flow"), [("vehicle-2", "video"), ("vehicle-1", "probe")])
def test_another_vehicle_or_flow(vehicle: str, flow: str, key: PrivateKey) -> None:
    """A registration of another vehicle, or of the other flow, is none, signed by the right key or not."""
    forwarder = Forwarder("vehicle-1", "video", key.public)
    registration = encode_registration(vehicle, "probe" if flow == "probe" else "video", 1, key)
    forwarder.receive(registration, VEHICLE, T)
    assert forwarder.counts == {"registrations_of_others": 1}
    assert forwarder.vehicle_at(T) is None


def test_replayed_registration(key: PrivateKey) -> None:
    """A registration counts once: again, or one that is older, it moves nothing, wherever it comes from."""
    forwarder = Forwarder("vehicle-1", "video", key.public)
    old, new = (encode_registration("vehicle-1", "video", each, key) for each in (5, 6))
    forwarder.receive(new, VEHICLE, T)
    forwarder.receive(new, OTHER, T + 1)
    forwarder.receive(old, OTHER, T + VEHICLE_SILENCE_NS)
    assert forwarder.vehicle_at(T + VEHICLE_SILENCE_NS) == VEHICLE
    assert forwarder.counts["registrations_stale"] == 2


def test_a_vehicle_moves_and_goes() -> None:
    """A newer registration from elsewhere moves the vehicle at once; after 10 s without one it is not there."""
    forwarder = registered()
    ask(forwarder)
    forwarder.receive(encode_registration("vehicle-1", "video", 2, None), OTHER, T + 1)
    assert ask(forwarder, now_ns=T + 1) == (wrap(CLIENT, HELLO), OTHER)
    assert answer(forwarder, now_ns=T + 1) is None
    gone_ns = T + 1 + VEHICLE_SILENCE_NS + 1
    assert forwarder.vehicle_at(gone_ns - 1) == OTHER
    assert ask(forwarder, now_ns=gone_ns) is None
    assert forwarder.receive(wrap(CLIENT, b"late"), OTHER, gone_ns) is None
    forwarder.receive(encode_registration("vehicle-1", "video", 1, None), VEHICLE, gone_ns)
    assert forwarder.vehicle_at(gone_ns) == VEHICLE, "whose clock was set back meanwhile"


def test_a_crowd_drives_nobody_out() -> None:
    """However many strangers ask, no more than 64 are remembered beside the 64 that the vehicle has answered."""
    forwarder = registered()
    ask(forwarder)
    answer(forwarder)
    for number in range(10 * MOST_CLIENTS):
        ask(forwarder, ("192.0.2.1", 1000 + number), T + number)
    assert answer(forwarder) == (b"answer", CLIENT)
    assert len(forwarder._clients._unanswered) == MOST_CLIENTS
    for number in range(10 * MOST_CLIENTS):
        ask(forwarder, ("192.0.2.1", 1000 + number), T)
        answer(forwarder, ("192.0.2.1", 1000 + number))
    assert len(forwarder._clients._answered) == MOST_CLIENTS


def test_the_vehicle_is_not_flooded() -> None:
    """So many datagrams a second go to the vehicle, and strangers' do not count against those it has answered."""
    forwarder = registered()
    ask(forwarder, SECOND)
    answer(forwarder, SECOND)
    requested = [ask(forwarder) is not None for _ in range(2 * UPSTREAM_PER_S)]
    assert sum(requested) == UPSTREAM_PER_S - 1, "SECOND was one of them"
    told = [ask(forwarder, SECOND) is not None for _ in range(2 * UPSTREAM_PER_S)]
    assert sum(told) == UPSTREAM_PER_S
    assert ask(forwarder, now_ns=T + NS_PER_S) is not None


def test_forged_registrations_keep_nobody_out(key: PrivateKey) -> None:
    """Of a flood of registrations so many signatures a second are looked at, and the vehicle's next one counts."""
    forwarder = Forwarder("vehicle-1", "video", key.public)
    forwarder.receive(encode_registration("vehicle-1", "video", 5, key), VEHICLE, T)
    forged = encode_registration("vehicle-1", "video", 6, None)
    for _ in range(2 * REGISTRATIONS_PER_S):
        forwarder.receive(forged, OTHER, T + NS_PER_S)
    assert forwarder.counts["registrations_forged"] == REGISTRATIONS_PER_S
    forwarder.receive(encode_registration("vehicle-1", "video", 7, key), VEHICLE, T + NS_PER_S)
    assert forwarder.counts["registrations"] == 2


def test_what_is_wrapped_fits_everywhere() -> None:
    """The longest packet, of repair, encrypted and wrapped, fits into 1280 bytes with its IP and UDP headers."""
    assert 28 + len(wrap(CLIENT, bytes(1200 + 14 + 16))) <= 1280
