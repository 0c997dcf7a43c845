from __future__ import annotations

import queue
import threading
from typing import Any

import pytest

from lavt.domain import NS_PER_S, PATH_POINTS, Command, Now, SessionReply, SessionRequest
from lavt.node import Send
from lavt.transport import zenoh_link
from lavt.transport.messages import encode
from lavt.transport.security.envelope import NullVehicleAuthenticator, OperatorAuthenticator, VehicleAuthenticator
from lavt.transport.security.gateway import ClientGateway, OpenClientGateway, ServerGateway

pytest.importorskip("cryptography", reason="an extra: pip install 'lavt[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from lavt.transport.security.keys import PrivateKey

OTHERS_PER_S, QUERIES_PER_S, STATES_PER_S, QUERIES_KEPT = 200, 100, 500, 64
"""The design's limits, in numbers of our own: whoever changes the code's must change these."""
HOLD = encode(SessionRequest("hold", "alice", 5, 0))
GRANTED = encode(SessionReply(True, "", 7, bytes(range(16)), 5600, "kernel", 0))
COMMAND = encode(Command(7, 3, 1, 2, 3, 0.1, 0.2, 0.0, (0.0,) * PATH_POINTS, "drive", 0))
NEXT_COMMAND = encode(Command(7, 4, 1, 2, 3, 0.1, 0.2, 0.0, (0.0,) * PATH_POINTS, "drive", 0))


class Both:
    """Two doors with a wire between them: what goes out of one comes to the other, when the test says so."""

    def __init__(self) -> None:
        vehicle, alice = PrivateKey(Ed25519PrivateKey.generate()), PrivateKey(Ed25519PrivateKey.generate())
        self.outside: list[Send] = []
        self.in_the_car: list[tuple[str, bytes, Any]] = []
        self.at_the_desk: list[tuple[str, bytes]] = []
        self.car = ServerGateway(
            lambda channel, payload, _arrived, peer: self.in_the_car.append((channel, payload, peer)),
            lambda *sends: self.outside.extend(sends),
            lambda: (7, 2),
            VehicleAuthenticator("car", vehicle, {"alice": alice.public}),
        )
        self.desk = ClientGateway(
            lambda channel, payload, _arrived, _peer: self.at_the_desk.append((channel, payload)),
            lambda *sends: self.outside.extend(sends),
            OperatorAuthenticator("car", "alice", alice, vehicle.public),
        )
        self.desk._send_soon = lambda send: self.outside.append(send)  # type: ignore[method-assign]  # no thread

    def carry(self, mono_ns: int = 0) -> None:
        """Carry everything that is outside, and what that leads to."""
        while self.outside:
            send = self.outside.pop(0)
            gateway = self.desk if send.channel in ("state", "session_reply", "netem_reply") else self.car
            gateway.receive(send.channel, send.payload, Now(mono_ns, 0), send.peer or "query")

    def hold(self) -> None:
        """Get the vehicle for the one at the desk."""
        self.desk.send(Send("session", HOLD))
        self.carry()
        self.car.send(Send("session_reply", GRANTED, "query"))
        self.carry()


@pytest.fixture
def both() -> Both:
    doors = Both()
    doors.hold()
    return doors


def test_behind_the_doors_messages_are_what_was_meant(both: Both) -> None:
    """A request that had to be made twice arrives once, and is answered as if there were no doors."""
    both.desk.send(Send("control", COMMAND))
    both.car.send(Send("state", b"state"))
    both.carry()
    assert both.in_the_car == [("session", HOLD, "query"), ("control", COMMAND, "query")]
    assert both.at_the_desk == [("session_reply", GRANTED), ("state", b"state")]


def test_a_replayed_message_does_not_get_in(both: Both) -> None:
    """What was recorded outside and comes a second time is counted and goes no further, but for old commands."""
    recorded = []
    for channel, payload in (("session", HOLD), ("control", COMMAND)):
        both.desk.send(Send(channel, payload))
        recorded += both.outside
        both.carry()
    both.car.send(Send("session_reply", GRANTED, "query"))
    both.carry()
    both.car.send(Send("state", b"state"))
    recorded += both.outside
    both.carry()
    inside, shown = list(both.in_the_car), list(both.at_the_desk)
    both.outside = list(recorded)
    both.carry()
    assert both.in_the_car[len(inside) :] == [("control", COMMAND, "query")]  # its sequence is refused by the gate
    assert both.at_the_desk == shown
    assert both.car.counts["session_requests_of_another_time"] == 2  # the very first one, and the replayed one
    assert both.desk.counts["states_replayed"] == 1


def test_a_command_that_the_vehicle_rejected_is_no_flood(both: Both) -> None:
    """Sent again by somebody ten thousand times it gets in as seldom as an old one, and what the holder says next does.

    The vehicle does not count a command that it refused, so its sequence stays newer than that of the last one obeyed.
    """
    both.desk.send(Send("control", COMMAND))
    rejected, before = both.outside.pop().payload, len(both.in_the_car)
    for _ in range(10_000):
        both.car.receive("control", rejected, Now(2 * NS_PER_S, 0), None)
    assert len(both.in_the_car) - before == 1 + OTHERS_PER_S
    both.desk.send(Send("control", NEXT_COMMAND))
    both.carry(2 * NS_PER_S)
    assert both.in_the_car[-1] == ("control", NEXT_COMMAND, "query")


def test_a_command_under_a_broken_signature_hides_no_true_one(both: Both) -> None:
    """Who is faster than the holder's own command, with its code but not its signature, does not make it an old one."""
    for command in (COMMAND, NEXT_COMMAND):
        both.desk.send(Send("control", command))
    first, following = (both.outside.pop(0).payload for _ in range(2))
    inside = len(both.in_the_car)
    both.car.receive("control", following[:-1] + bytes([following[-1] ^ 1]), Now(0, 0), None)
    for _ in range(1000):  # nothing is left of what old commands may take
        both.car.receive("control", first, Now(0, 0), None)
    both.car.receive("control", following, Now(0, 0), None)
    assert len(both.in_the_car) - inside == 1 + OTHERS_PER_S + 1
    assert both.in_the_car[-1] == ("control", NEXT_COMMAND, None)


def test_a_server_started_anew_is_requested_once_a_second(both: Both) -> None:
    """States of an unknown process of the server are not shown before it has answered, and do not cause a flood."""
    anew = Both()
    anew.desk, both.desk = both.desk, anew.desk
    ours, theirs = vars(anew.car._authenticator), vars(both.car._authenticator)
    ours["_key"], ours["_operators"] = theirs["_key"], theirs["_operators"]
    requested, times = [], []
    for number in range(100):
        anew.car.send(Send("state", b"state"))
        state = anew.outside.pop()
        both.outside.clear()
        anew.desk.receive("state", state.payload, Now(number * NS_PER_S // 50, 0), None)
        requested += both.outside
        times += [number] * len(both.outside)
    assert [each.channel for each in requested] == ["session", "session"]
    assert times == [0, 50]
    assert ("state", b"state") not in both.at_the_desk
    anew.car.receive("session", requested[-1].payload, Now(0, 0), "query")
    anew.desk.receive("session_reply", anew.outside.pop().payload, Now(0, 0), None)
    anew.car.send(Send("state", b"state"))
    anew.desk.receive("state", anew.outside.pop().payload, Now(0, 0), None)
    assert both.at_the_desk[-1] == ("state", b"state")


def test_states_of_a_known_server_cause_no_query(both: Both) -> None:
    """A state of the server's process that has answered is delivered, and nothing is asked because of it."""
    both.car.send(Send("state", b"state"))
    both.desk.receive("state", both.outside.pop().payload, Now(0, 0), None)
    assert both.at_the_desk[-1] == ("state", b"state")
    assert both.outside == []


@pytest.mark.parametrize("signed", [True, False])
def test_a_flood_of_queries_is_screened(both: Both, signed: bool) -> None:
    """Of ten thousand queries in a second as many are looked at as one client could ever ask."""
    heard: list[bytes] = []
    gateway = (
        both.car
        if signed
        else ServerGateway(
            lambda _channel, payload, _arrived, _peer: heard.append(payload),
            lambda *_: None,
            lambda: (7, 2),
            NullVehicleAuthenticator(),
        )
    )
    for number in range(10_000):
        gateway.receive("session", b"garbage", Now(2 * NS_PER_S, 0), number)
    assert gateway.counts["session_requests_screened_out"] == 10_000 - QUERIES_PER_S
    assert len(heard) == (0 if signed else QUERIES_PER_S)


def test_nobody_waits_at_the_gateway_for_the_link(both: Both) -> None:
    """While the link carries something out, the answer to a stale request too, the door can be used by others."""
    free: list[bool] = []

    def carry(*sends: Send) -> None:
        free.append(not both.car._turn.locked() and not both.desk._turn.locked())
        both.outside.extend(sends)

    both.car._carry = both.desk._carry = carry
    both.outside.append(Send("session", both.desk._authenticator.sign_request("session", b"")))
    both.carry()
    both.hold()
    both.car.send(Send("state", b"state"))
    assert (len(free), all(free)) == (4, True)


def test_a_delivered_message_is_answered_in_another_thread() -> None:
    """A query that a reply asks for again is sent in a thread of its own, since Zenoh sends none while it delivers."""
    both = Both()
    del both.desk._send_soon
    both.desk.send(Send("session", HOLD))
    both.car.receive("session", both.outside.pop().payload, Now(0, 0), "query")
    sent: queue.SimpleQueue[tuple[threading.Thread, tuple[Send, ...]]] = queue.SimpleQueue()
    both.desk._carry = lambda *sends: sent.put((threading.current_thread(), sends))
    both.desk.receive("session_reply", both.outside.pop().payload, Now(0, 0), None)
    thread, sends = sent.get(timeout=10)
    assert thread is not threading.current_thread()
    assert thread.daemon
    assert [each.channel for each in sends] == ["session"]


def test_a_flood_of_states_is_screened(both: Both) -> None:
    """Of a flood of states no more signatures are verified than a few vehicles could make."""
    for _ in range(10_000):
        both.desk.receive("state", bytes(200), Now(2 * NS_PER_S, 0), None)
    assert both.desk.counts["states_screened_out"] == 10_000 - STATES_PER_S
    assert both.desk.counts["states_forged"] == STATES_PER_S
    assert not [each for each in both.at_the_desk if each[0] == "state"]


def test_a_flood_does_not_hide_what_is_the_holders(both: Both) -> None:
    """In a flood of forged and old states and queries, the vehicle's next state and the holder's next query go on."""
    now = Now(2 * NS_PER_S, 0)
    both.car.send(Send("state", b"old"))
    both.desk.send(Send("session", HOLD))
    state, query = both.outside
    both.carry()
    both.car.send(Send("session_reply", GRANTED, "query"))
    both.carry()
    for flooded in (both.desk, both.car):
        channel, true = ("state", state.payload) if flooded is both.desk else ("session", query.payload)
        for number in range(2_000):
            flooded.receive(channel, true if number % 2 else true[:-80] + bytes(80), now, number)
    both.outside.clear()
    both.car.send(Send("state", b"new"))
    both.desk.send(Send("session", HOLD))
    inside = len(both.in_the_car)
    for send in both.outside:
        (both.desk if send.channel == "state" else both.car).receive(send.channel, send.payload, now, "next")
    assert both.at_the_desk[-1] == ("state", b"new")
    assert both.in_the_car[inside:] == [("session", HOLD, "next")]
    assert both.car.counts["session_requests_screened_out"] > 1_000
    assert both.desk.counts["states_screened_out"] > 1_000


def test_requests_that_are_never_answered_are_forgotten() -> None:
    """The door remembers the newest requests, as many as a link keeps queries, and answers each of them once."""
    carried: list[Send] = []
    gateway = ServerGateway(
        lambda *_: None, lambda *sends: carried.extend(sends), lambda: (7, 2), NullVehicleAuthenticator()
    )
    for number in range(1000):
        gateway.receive("session", b"request", Now(number * NS_PER_S, 0), number)
    for _ in range(2):
        gateway.send(*(Send("session_reply", b"reply", number) for number in range(1000)))
    assert zenoh_link.QUERIES_KEPT == QUERIES_KEPT
    assert carried == [Send("session_reply", b"reply", number) for number in range(1000 - QUERIES_KEPT, 1000)]


def test_an_open_gateway_changes_nothing() -> None:
    """Where nothing is signed the operator's door is none."""
    delivered: list[Any] = []
    sent: list[Send] = []
    gateway = OpenClientGateway(lambda *message: delivered.append(message), lambda *sends: sent.extend(sends))
    gateway.receive("state", b"state", Now(1, 2), None)
    gateway.send(Send("control", b"command"))
    assert delivered == [("state", b"state", Now(1, 2), None)]
    assert sent == [Send("control", b"command")]
