from __future__ import annotations

import queue
import threading
from typing import Any

import pytest

import lavt
from lavt.domain import (
    NS_PER_MS,
    NS_PER_S,
    PATH_POINTS,
    Command,
    Now,
    RunReply,
    RunRequest,
    SessionReply,
    SessionRequest,
    State,
    VehicleInfo,
)
from lavt.node import Send
from lavt.transport import zenoh_link
from lavt.transport.messages import decode, encode
from lavt.transport.security.envelope import (
    NullVehicleAuthenticator,
    OperatorAuthenticator,
    VehicleAuthenticator,
    verify_info,
)
from lavt.transport.security.gateway import ClientGateway, OpenClientGateway, ServerGateway

pytest.importorskip("cryptography", reason="an extra: pip install -e '.[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from lavt.transport.security.keys import PrivateKey

# The expected values of the code's limits. They are not imported, so that a changed limit makes a test fail.
UNACCEPTABLE_COMMANDS_PER_S = 200
REQUESTS_PER_S = 100
INFO_QUERIES_PER_S = 50
STATES_PER_S = 500
MAX_UNANSWERED_REQUESTS = 64
EPOCH, LAST_ACCEPTED_SEQUENCE = 7, 2
HIGHEST_SEQUENCE = 2**63 - 1


def encoded_command(sequence: int, *, emergency_stop: int = 0) -> bytes:
    return encode(
        Command(
            epoch=EPOCH,
            sequence=sequence,
            sent_wall_ns=1,
            stamp_ns=2,
            stamp_received_wall_ns=3,
            steering_rad=0.1,
            throttle=0.2,
            brake=0.0,
            path_curvature_per_m=(0.0,) * PATH_POINTS,
            mode="drive",
            emergency_stop=emergency_stop,
        )
    )


ACQUIRE = encode(SessionRequest("acquire", "alice", instance=5, number=0))
GRANTED = encode(
    SessionReply(
        granted=True,
        reason="",
        epoch=EPOCH,
        token=bytes(range(16)),
        video_port=5600,
        host="kernel",
        emergency_stop=0,
    )
)
COMMAND, NEXT_COMMAND = (encoded_command(LAST_ACCEPTED_SEQUENCE + number) for number in (1, 2))


class GatewayPair:
    """A server's and a client's gateway; messages between them wait in `in_flight` until the test delivers them."""

    def __init__(self) -> None:
        vehicle, alice, bob = (PrivateKey(Ed25519PrivateKey.generate()) for _ in range(3))
        self.vehicle_key = vehicle.public
        self.bob = OperatorAuthenticator("car", "bob", bob, vehicle.public)
        self.in_flight: list[Send] = []
        self.server_received: list[tuple[str, bytes, Any]] = []
        self.client_received: list[tuple[str, bytes]] = []
        self.server = ServerGateway(
            lambda channel, payload, _arrived, peer: self.server_received.append((channel, payload, peer)),
            lambda *sends: self.in_flight.extend(sends),
            lambda: (EPOCH, LAST_ACCEPTED_SEQUENCE),
            VehicleAuthenticator("car", vehicle, {"alice": alice.public, "bob": bob.public}),
        )
        self.client = ClientGateway(
            lambda channel, payload, _arrived, _peer: self.client_received.append((channel, payload)),
            lambda *sends: self.in_flight.extend(sends),
            OperatorAuthenticator("car", "alice", alice, vehicle.public),
        )
        self.client._send_in_thread = lambda send: self.in_flight.append(send)  # type: ignore[method-assign]

    def deliver_all(self, mono_ns: int = 0) -> None:
        """Deliver all messages in flight, and those sent in response."""
        while self.in_flight:
            send = self.in_flight.pop(0)
            is_for_client = send.channel == "state" or send.channel.endswith("_reply")
            gateway = self.client if is_for_client else self.server
            gateway.receive(send.channel, send.payload, Now(mono_ns, 0), send.peer or "query")

    def acquire_control(self) -> None:
        """Make the client the active operator."""
        self.client.send(Send("session", ACQUIRE))
        self.deliver_all()
        self.server.send(Send("session_reply", GRANTED, "query"))
        self.deliver_all()


@pytest.fixture
def pair() -> GatewayPair:
    new_pair = GatewayPair()
    new_pair.acquire_control()
    return new_pair


def test_gateways_deliver_each_message_once_and_unchanged(pair: GatewayPair) -> None:
    """A request that needed a retry is delivered once, and its reply, a command and a state arrive unchanged."""
    pair.client.send(Send("control", COMMAND))
    pair.server.send(Send("state", b"state"))
    pair.deliver_all()
    assert pair.server_received == [("session", ACQUIRE, "query"), ("control", COMMAND, "query")]
    assert pair.client_received == [("session_reply", GRANTED), ("state", b"state")]


def test_replayed_requests_replies_and_states_are_rejected(pair: GatewayPair) -> None:
    """Replayed requests, replies and states are rejected and counted; a replayed command is left to the safety gate."""
    recorded = []
    for channel, payload in (("session", ACQUIRE), ("control", COMMAND)):
        pair.client.send(Send(channel, payload))
        recorded += pair.in_flight
        pair.deliver_all()
    pair.server.send(Send("session_reply", GRANTED, "query"))
    pair.deliver_all()
    pair.server.send(Send("state", b"state"))
    recorded += pair.in_flight
    pair.deliver_all()
    server_received, client_received = list(pair.server_received), list(pair.client_received)
    pair.in_flight = list(recorded)
    pair.deliver_all()
    delivered_again = pair.server_received[len(server_received) :]
    assert delivered_again == [("control", COMMAND, "query")], "the gate rejects it, because its sequence is old"
    assert pair.client_received == client_received
    # Two requests had a wrong counter: the replayed one, and the client's first one, which it then sent again.
    assert pair.server.counts["session_requests_with_wrong_counter"] == 2
    assert pair.client.counts["states_replayed"] == 1


def test_requests_for_runs_are_signed_and_not_replayed(pair: GatewayPair) -> None:
    """A request for a run arrives once, in the name of its signer only; a part of a record arrives as the reply."""
    begin = RunRequest("begin", "alice", instance=5, number=1, run=7, settings="{}", offset=0)
    pair.server_received.clear()
    pair.client_received.clear()
    pair.client.send(Send("run", encode(begin)))
    pair.deliver_all()
    assert pair.server_received == [("run", encode(begin), "query")]
    part = encode(RunReply(1, "", "", "finished", "", 1, 2, size=32_768, digest=bytes(32), data=bytes(32_768)))
    pair.server.send(Send("run_reply", part, "query"))
    reply = pair.in_flight[0]
    pair.deliver_all()
    pair.in_flight = [reply]
    pair.deliver_all()
    assert pair.client_received == [("run_reply", part)], "the replayed reply is dropped"
    pair.client.send(Send("run", encode(begin)))
    recorded = list(pair.in_flight)
    pair.deliver_all()
    pair.server.send(Send("run_reply", part, "query"))
    pair.deliver_all()
    pair.server_received.clear()
    pair.in_flight = [*recorded, Send("run", pair.bob.sign_request("run", encode(begin))), Send("run", encode(begin))]
    pair.deliver_all()
    assert not pair.server_received, "a replay, a request in another's name, and an unsigned one"


def test_replays_of_a_rejected_command_are_rate_limited(pair: GatewayPair) -> None:
    """Ten thousand replays of a command that the vehicle rejected are rate-limited, and the next command passes.

    Their sequence is newer than that of the last accepted command, so the filter cannot recognize them as replays.
    """
    pair.client.send(Send("control", COMMAND))
    rejected, before = pair.in_flight.pop().payload, len(pair.server_received)
    for _ in range(10_000):
        pair.server.receive("control", rejected, Now(2 * NS_PER_S, 0), None)
    assert len(pair.server_received) - before == 1 + UNACCEPTABLE_COMMANDS_PER_S
    pair.client.send(Send("control", NEXT_COMMAND))
    pair.deliver_all(2 * NS_PER_S)
    assert pair.server_received[-1] == ("control", NEXT_COMMAND, "query")


def test_another_operators_emergency_stop_does_not_displace_the_active_operators_commands(pair: GatewayPair) -> None:
    """After another operator's emergency stop with the highest sequence, the active operator's next command passes."""
    pair.client.send(Send("control", COMMAND))
    recorded = pair.in_flight.pop().payload
    stop = encoded_command(HIGHEST_SEQUENCE, emergency_stop=1)
    pair.server.receive("control", pair.bob.sign_command(stop), Now(2 * NS_PER_S, 0), None)
    assert [body for _, body, _ in pair.server_received[-1:]] == [stop]
    for _ in range(2 * UNACCEPTABLE_COMMANDS_PER_S):
        pair.server.receive("control", recorded, Now(2 * NS_PER_S, 0), None)
    pair.client.send(Send("control", NEXT_COMMAND))
    pair.deliver_all(2 * NS_PER_S)
    assert pair.server_received[-1] == ("control", NEXT_COMMAND, "query")


def test_a_forged_signature_does_not_displace_the_true_command(pair: GatewayPair) -> None:
    """A copy of a command with a valid MAC but a broken signature does not make the true command a replay."""
    for command in (COMMAND, NEXT_COMMAND):
        pair.client.send(Send("control", command))
    first, following = (pair.in_flight.pop(0).payload for _ in range(2))
    before = len(pair.server_received)
    pair.server.receive("control", following[:-1] + bytes([following[-1] ^ 1]), Now(0, 0), None)
    for _ in range(1000):  # exhaust the rate limit for replays
        pair.server.receive("control", first, Now(0, 0), None)
    pair.server.receive("control", following, Now(0, 0), None)
    assert len(pair.server_received) - before == 1 + UNACCEPTABLE_COMMANDS_PER_S + 1
    assert pair.server_received[-1] == ("control", NEXT_COMMAND, None)


def test_states_of_a_restarted_server_cause_one_request_a_second(pair: GatewayPair) -> None:
    """A client rejects a restarted server's states, and sends it one request a second, until the server answers one."""
    # The first client now talks to a second server, which gets the keys of the first one as if it had restarted.
    restarted = GatewayPair()
    restarted.client, pair.client = pair.client, restarted.client
    restarted_vehicle, vehicle = vars(restarted.server._authenticator), vars(pair.server._authenticator)
    for name in ("_key", "_operators"):
        restarted_vehicle[name] = vehicle[name]
    requests, state_numbers = [], []
    for number in range(100):
        restarted.server.send(Send("state", b"state"))
        state = restarted.in_flight.pop()
        pair.in_flight.clear()
        restarted.client.receive("state", state.payload, Now(number * NS_PER_S // 50, 0), None)
        requests += pair.in_flight
        state_numbers += [number] * len(pair.in_flight)
    assert [send.channel for send in requests] == ["session", "session"]
    assert state_numbers == [0, 50], "there are 50 states a second"
    assert ("state", b"state") not in pair.client_received
    restarted.server.receive("session", requests[-1].payload, Now(0, 0), "query")
    restarted.client.receive("session_reply", restarted.in_flight.pop().payload, Now(0, 0), None)
    restarted.server.send(Send("state", b"state"))
    restarted.client.receive("state", restarted.in_flight.pop().payload, Now(0, 0), None)
    assert pair.client_received[-1] == ("state", b"state")


def test_states_of_a_known_server_cause_no_request(pair: GatewayPair) -> None:
    """A state of a server process that has answered before is delivered and causes no request."""
    pair.server.send(Send("state", b"state"))
    pair.client.receive("state", pair.in_flight.pop().payload, Now(0, 0), None)
    assert pair.client_received[-1] == ("state", b"state")
    assert pair.in_flight == []


@pytest.mark.parametrize("signed", [True, False])
def test_requests_are_rate_limited(pair: GatewayPair, signed: bool) -> None:
    """Of 10000 requests in a second, 100 pass the limit and the others are counted."""
    received: list[bytes] = []
    gateway = (
        pair.server
        if signed
        else ServerGateway(
            lambda _channel, payload, _arrived, _peer: received.append(payload),
            lambda *_: None,
            lambda: (EPOCH, LAST_ACCEPTED_SEQUENCE),
            NullVehicleAuthenticator(),
        )
    )
    for number in range(10_000):
        gateway.receive("session", b"garbage", Now(2 * NS_PER_S, 0), number)
    assert gateway.counts["session_requests_screened_out"] == 10_000 - REQUESTS_PER_S
    assert len(received) == (0 if signed else REQUESTS_PER_S)


def test_the_gateway_is_unlocked_while_the_link_sends(pair: GatewayPair) -> None:
    """A gateway's lock is free while the link sends, also while it sends the reply to a request with an old counter."""
    unlocked: list[bool] = []

    def carry(*sends: Send) -> None:
        unlocked.append(not pair.server._lock.locked() and not pair.client._lock.locked())
        pair.in_flight.extend(sends)

    pair.server._carry = pair.client._carry = carry
    pair.in_flight.append(Send("session", pair.client._authenticator.sign_request("session", b"")))
    pair.deliver_all()
    pair.acquire_control()
    pair.server.send(Send("state", b"state"))
    assert (len(unlocked), all(unlocked)) == (4, True)


def test_a_retry_is_sent_in_another_thread() -> None:
    """The retry of a request is sent from a daemon thread, because Zenoh cannot send in the delivering thread."""
    pair = GatewayPair()
    del pair.client._send_in_thread
    pair.client.send(Send("session", ACQUIRE))
    pair.server.receive("session", pair.in_flight.pop().payload, Now(0, 0), "query")
    sent: queue.SimpleQueue[tuple[threading.Thread, tuple[Send, ...]]] = queue.SimpleQueue()
    pair.client._carry = lambda *sends: sent.put((threading.current_thread(), sends))
    pair.client.receive("session_reply", pair.in_flight.pop().payload, Now(0, 0), None)
    thread, sends = sent.get(timeout=10)
    assert thread is not threading.current_thread()
    assert thread.daemon
    assert [send.channel for send in sends] == ["session"]


def test_states_are_rate_limited(pair: GatewayPair) -> None:
    """Of 10000 forged states in a second, 500 are verified, and the others are counted."""
    for _ in range(10_000):
        pair.client.receive("state", bytes(200), Now(2 * NS_PER_S, 0), None)
    assert pair.client.counts["states_screened_out"] == 10_000 - STATES_PER_S
    assert pair.client.counts["states_forged"] == STATES_PER_S
    assert not [payload for channel, payload in pair.client_received if channel == "state"]


def test_a_flood_does_not_displace_authentic_messages(pair: GatewayPair) -> None:
    """During a flood of forged and replayed states and requests, the next authentic state and request are delivered."""
    now = Now(2 * NS_PER_S, 0)
    pair.server.send(Send("state", b"old"))
    pair.client.send(Send("session", ACQUIRE))
    state, request = pair.in_flight
    pair.deliver_all()
    pair.server.send(Send("session_reply", GRANTED, "query"))
    pair.deliver_all()
    for flooded in (pair.client, pair.server):
        channel, authentic = ("state", state.payload) if flooded is pair.client else ("session", request.payload)
        for number in range(2_000):
            flooded.receive(channel, authentic if number % 2 else authentic[:-80] + bytes(80), now, number)
    pair.in_flight.clear()
    pair.server.send(Send("state", b"new"))
    pair.client.send(Send("session", ACQUIRE))
    before = len(pair.server_received)
    for send in pair.in_flight:
        (pair.client if send.channel == "state" else pair.server).receive(send.channel, send.payload, now, "next")
    assert pair.client_received[-1] == ("state", b"new")
    assert pair.server_received[before:] == [("session", ACQUIRE, "next")]
    assert pair.server.counts["session_requests_screened_out"] > 1_000
    assert pair.client.counts["states_screened_out"] > 1_000


def test_unanswered_requests_are_bounded() -> None:
    """The gateway keeps as many unanswered requests as the link keeps queries of Zenoh, and each gets one reply."""
    carried: list[Send] = []
    gateway = ServerGateway(
        lambda *_: None,
        lambda *sends: carried.extend(sends),
        lambda: (EPOCH, LAST_ACCEPTED_SEQUENCE),
        NullVehicleAuthenticator(),
    )
    for number in range(1000):
        gateway.receive("session", b"request", Now(number * NS_PER_S, 0), number)
    for _ in range(2):
        gateway.send(*(Send("session_reply", b"reply", number) for number in range(1000)))
    assert zenoh_link.MAX_PENDING_QUERIES == MAX_UNANSWERED_REQUESTS
    last_requests = range(1000 - MAX_UNANSWERED_REQUESTS, 1000)
    assert carried == [Send("session_reply", b"reply", number) for number in last_requests]


def test_an_open_gateway_changes_nothing() -> None:
    """Without keys, the operator's gateway passes messages unchanged."""
    delivered: list[Any] = []
    sent: list[Send] = []
    gateway = OpenClientGateway(lambda *message: delivered.append(message), lambda *sends: sent.extend(sends))
    gateway.receive("state", b"state", Now(1, 2), None)
    gateway.send(Send("control", b"command"))
    assert delivered == [("state", b"state", Now(1, 2), None)]
    assert sent == [Send("control", b"command")]


STATE = State(
    sent_wall_ns=1,
    state_mono_ns=5 * NS_PER_S,
    speed_mps=3.5,
    steering_rad=0.1,
    gear="drive",
    safety="driving",
    reason="armed by alice",
    applied_sequence=1,
    rejected="",
    active_operator="alice",
    instance=9,
)
NONCE = bytes(range(16))


def query_info(gateway: ServerGateway, nonce: bytes, mono_ns: int, in_flight: list[Send]) -> list[Send]:
    """Deliver a query for the vehicle's information; return the replies."""
    in_flight.clear()
    gateway.receive("info", nonce, Now(mono_ns, 0), "query")
    return list(in_flight)


@pytest.mark.parametrize("signed", [True, False])
def test_the_vehicle_describes_itself_to_whoever_asks(pair: GatewayPair, signed: bool) -> None:
    """A query for information is answered from the newest state, with its age, and is not delivered to the nodes."""
    gateway = pair.server
    if not signed:
        sent = pair.in_flight
        gateway = ServerGateway(
            lambda *_: None, lambda *sends: sent.extend(sends), lambda: (0, -1), NullVehicleAuthenticator()
        )
    gateway.send(Send("state", b"unreadable"), Send("state", encode(STATE)))
    received = list(pair.server_received)
    (reply,) = query_info(gateway, NONCE, STATE.state_mono_ns + 20 * NS_PER_MS, pair.in_flight)
    assert (reply.channel, reply.peer) == ("info_reply", "query")
    body = verify_info("car", pair.vehicle_key, NONCE, reply.payload) if signed else reply.payload
    assert body is not None
    assert decode(VehicleInfo, body) == VehicleInfo(
        lavt.__version__, "driving", "armed by alice", "alice", 3.5, 20 * NS_PER_MS, 9
    )
    assert pair.server_received == received


def test_information_is_signed_for_one_query_of_one_vehicle(pair: GatewayPair) -> None:
    """Information that is replayed, changed, too long, or of another vehicle or key is not verified."""
    pair.server.send(Send("state", encode(STATE)))
    (reply,) = query_info(pair.server, NONCE, STATE.state_mono_ns, pair.in_flight)
    data, key = reply.payload, pair.vehicle_key
    assert verify_info("car", key, NONCE, data) is not None
    assert verify_info("car", key, bytes(16), data) is None
    assert verify_info("bus", key, NONCE, data) is None
    assert verify_info("car", PrivateKey(Ed25519PrivateKey.generate()).public, NONCE, data) is None
    for bad in (b"", data[:10], data[:-1], b"x" + data, data[:-1] + bytes([data[-1] ^ 1]), bytes(2000)):
        assert verify_info("car", key, NONCE, bad) is None


@pytest.mark.parametrize("nonce", [b"", bytes(15), bytes(17), bytes(2000)])
def test_a_query_for_information_needs_a_nonce(pair: GatewayPair, nonce: bytes) -> None:
    """A query for information with another number of bytes than 16 is counted and not answered."""
    pair.server.send(Send("state", encode(STATE)))
    assert query_info(pair.server, nonce, STATE.state_mono_ns, pair.in_flight) == []
    assert pair.server.counts["info_queries_unreadable"] == 1


def test_without_a_state_there_is_no_information(pair: GatewayPair) -> None:
    """A server that has not sent a state yet does not answer a query for information."""
    assert query_info(pair.server, NONCE, 0, pair.in_flight) == []


def test_queries_for_information_are_rate_limited(pair: GatewayPair) -> None:
    """Of 1000 queries for information in a second, 50 are answered and the others are counted."""
    pair.server.send(Send("state", encode(STATE)))
    replies = [reply for _ in range(1000) for reply in query_info(pair.server, NONCE, 6 * NS_PER_S, pair.in_flight)]
    assert len(replies) == INFO_QUERIES_PER_S
    assert pair.server.counts["info_queries_screened_out"] == 1000 - INFO_QUERIES_PER_S
