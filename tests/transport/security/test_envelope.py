# ruff: noqa: D102 (a helper of tests: short methods say themselves what they do)

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import PATH_POINTS, Command, NetemReply, NetemRequest, SessionReply, SessionRequest
from lavt.transport.messages import decode, encode

pytest.importorskip("cryptography", reason="an extra: pip install 'lavt[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from lavt.transport.security.envelope import (
    TRAILER_BYTES,
    NullVehicleAuthenticator,
    OperatorAuthenticator,
    VehicleAuthenticator,
    VerifiedReply,
    VerifiedState,
)
from lavt.transport.security.keys import PrivateKey

KEPT, LONGEST_BYTES = 8, 1280
"""The design's limits, in numbers of our own: whoever changes the code's must change these."""
COMMAND = Command(77, 3, 1, 2, 3, 0.1, 0.2, 0.0, (0.0,) * PATH_POINTS, "drive", 0)
TOKEN = bytes(range(16))
GRANTED = SessionReply(True, "", 77, TOKEN, 5600, "kernel", 0)


def new_key() -> PrivateKey:
    return PrivateKey(Ed25519PrivateKey.generate())


VEHICLE, ALICE, BOB, MALLORY = (new_key() for _ in range(4))
OPERATORS = {"alice": ALICE.public, "bob": BOB.public}


class Pair:
    """A vehicle and an operator, and nothing between them but bytes."""

    def __init__(
        self, who: str = "alice", key: PrivateKey = ALICE, vehicle: VehicleAuthenticator | None = None
    ) -> None:
        self.who = who
        self.vehicle = vehicle or VehicleAuthenticator("car", VEHICLE, OPERATORS)
        self.operator = OperatorAuthenticator("car", who, key, VEHICLE.public)

    def request(self, operation: str = "hold", number: int = 0) -> bytes:
        request = SessionRequest(operation, self.who, 5, number)  # type: ignore[arg-type]
        return self.operator.sign_request("session", encode(request))

    def ask(self, data: bytes, reply: SessionReply = GRANTED) -> tuple[bytes, bytes | None]:
        """Let the vehicle take a request: its reply's bytes, and what the operator reads in it."""
        request = self.vehicle.open_request("session", data)
        assert request is not None
        signed = self.vehicle.sign_reply(request, b"" if request.is_stale else encode(reply))
        opened = self.operator.open_reply("session", signed)
        return signed, opened.again if request.is_stale else opened.body

    def hold(self) -> None:
        _, again = self.ask(self.request())
        assert again is not None
        _, body = self.ask(again)
        assert body == encode(GRANTED)

    def command(self, command: Command = COMMAND) -> bytes:
        return self.operator.sign_command(encode(command))


@pytest.fixture
def pair() -> Pair:
    return Pair()


def test_the_first_request_is_requested_again_and_then_granted(pair: Pair) -> None:
    """A server that has just started takes no request but with a place of its own, which its reply tells."""
    request = pair.vehicle.open_request("session", pair.request())
    assert request is not None
    assert request.is_stale
    pair.hold()


def test_a_command_of_the_active_operator_is_opened(pair: Pair) -> None:
    """What the holder has signed comes out as it went in, and its code says cheaply that it is the holder's."""
    pair.hold()
    assert pair.vehicle.is_from_active_operator(pair.command())
    assert pair.vehicle.open_command(pair.command()) == encode(COMMAND)


def test_nobody_but_the_active_operator_commands(pair: Pair) -> None:
    """Another operator's command is refused, though his key is known; so is that of a key nobody knows."""
    pair.hold()
    for other in (Pair("bob", BOB), Pair("alice", MALLORY)):
        assert not pair.vehicle.is_from_active_operator(other.command())
        assert pair.vehicle.open_command(other.command()) is None
    assert pair.vehicle.counts["commands_forged"] == 2


def test_any_operator_stops_the_vehicle(pair: Pair) -> None:
    """An emergency stop in a command is heard from every operator whose key is known, and from nobody else."""
    pair.hold()
    stop = replace(COMMAND, emergency_stop=9)
    assert pair.vehicle.open_command(Pair("bob", BOB).command(stop)) == encode(stop)
    assert pair.vehicle.open_command(Pair("bob", MALLORY).command(stop)) is None
    assert pair.vehicle.open_command(Pair("bob", BOB).operator.sign_command(b"garbage")) is None


def test_before_a_session_no_command_has_a_valid_code(pair: Pair) -> None:
    """Before there is a session its codes are zeros, and the vehicle accepts no zeros as a code."""
    assert pair.command()[-TRAILER_BYTES:-64] == bytes(16)
    assert not pair.vehicle.is_from_active_operator(pair.command())
    assert not pair.vehicle.is_next_of_active_operator("session", pair.request())
    assert not pair.operator.is_next_state(pair.vehicle.sign_state(b"state"))


def test_after_a_release_nobody_commands(pair: Pair) -> None:
    """When the holder has released the vehicle his commands are no longer his to give."""
    pair.hold()
    pair.ask(pair.request("release"), SessionReply(True, "", 0, b"", 5600, "kernel", 0))
    assert not pair.vehicle.is_from_active_operator(pair.command())
    assert pair.vehicle.open_command(pair.command()) is None


def test_an_altered_command_is_rejected(pair: Pair) -> None:
    """A change of any byte of a command, its code or its signature makes it a forgery; the code shows it cheaply."""
    pair.hold()
    signed = pair.command()
    for at in range(len(signed)):
        altered = signed[:at] + bytes([signed[at] ^ 1]) + signed[at + 1 :]
        within = at < len(signed) - 64
        assert not (within and pair.vehicle.is_from_active_operator(altered))
        in_the_code = len(signed) - 80 <= at < len(signed) - 64
        assert (pair.vehicle.open_command(altered) is None) != in_the_code


def test_the_code_of_one_kind_serves_for_no_other(pair: Pair) -> None:
    """What the holder has sent as one kind of message is cheaply told from another, as is the next from one before."""
    pair.hold()
    request = pair.request()
    assert pair.vehicle.is_next_of_active_operator("session", request)
    assert not pair.vehicle.is_next_of_active_operator("netem", request)
    assert not pair.vehicle.is_from_active_operator(request)
    pair.ask(request)
    assert not pair.vehicle.is_next_of_active_operator("session", request)
    state = pair.vehicle.sign_state(b"state")
    assert pair.operator.is_next_state(state)
    assert pair.operator.open_state(state).body == b"state"
    assert not pair.operator.is_next_state(state)


def test_a_command_for_another_vehicle_is_rejected(pair: Pair) -> None:
    """A signature serves for one vehicle only."""
    pair.hold()
    elsewhere = OperatorAuthenticator("truck", "alice", ALICE, VEHICLE.public)
    assert pair.vehicle.open_command(elsewhere.sign_command(encode(COMMAND))) is None


def test_a_replayed_request_is_not_looked_at(pair: Pair) -> None:
    """The same bytes once more are stale: nothing is decided on them, and nobody else can read what is answered."""
    pair.hold()
    data = pair.request("release")
    pair.ask(data)
    again = pair.vehicle.open_request("session", data)
    assert again is not None
    assert again.is_stale
    assert pair.vehicle.counts["session_requests_of_another_time"] == 2


def test_a_request_to_another_process_of_the_server_is_not_looked_at(pair: Pair) -> None:
    """What was asked of a server before it was started anew is stale after it."""
    pair.hold()
    data = pair.request("hold")
    anew = VehicleAuthenticator("car", VEHICLE, OPERATORS).open_request("session", data)
    assert anew is not None
    assert anew.is_stale


def test_an_emergency_stop_is_not_requested_twice(pair: Pair) -> None:
    """An emergency stop counts at once, whatever its place: its own number refuses a replay."""
    request = pair.vehicle.open_request("session", pair.request("emergency_stop", 7))
    assert request is not None
    assert not request.is_stale


def test_a_request_without_a_body_only_asks_for_the_place(pair: Pair) -> None:
    """An empty request is never decided on, though its place is the next, and is not counted as a replay."""
    pair.hold()
    before = pair.vehicle.counts["session_requests_of_another_time"]
    request = pair.vehicle.open_request("session", pair.operator.sign_request("session", b""))
    assert request is not None
    assert request.is_stale
    assert pair.vehicle.counts["session_requests_of_another_time"] == before


def test_a_request_with_an_impossible_key_is_rejected(pair: Pair) -> None:
    """A request whose X25519 key gives no secret is counted as a forgery, whoever has signed it."""
    pair.operator._agreement.public = bytes(32)
    assert pair.vehicle.open_request("session", pair.request()) is None
    assert pair.vehicle.counts["session_requests_forged"] == 1


def test_a_reply_without_a_token_leaves_the_codes_as_they_are(pair: Pair) -> None:
    """A request that is granted without a token, as an emergency stop is, does not end the holder's session."""
    pair.hold()
    pair.ask(pair.request("emergency_stop", 7), SessionReply(True, "", 0, b"", 5600, "kernel", 7))
    assert pair.vehicle.is_from_active_operator(pair.command())
    assert pair.vehicle.open_command(pair.command()) == encode(COMMAND)


def test_a_request_in_another_name_is_rejected(pair: Pair) -> None:
    """Nobody asks in the name of another operator, nor without a name that is known."""
    for name, key in (("alice", BOB), ("alice", MALLORY), ("mallory", MALLORY)):
        assert pair.vehicle.open_request("session", Pair(name, key).request()) is None
    forged = pair.operator.sign_request("session", encode(SessionRequest("hold", "bob", 5, 0)))
    assert pair.vehicle.open_request("session", forged) is None
    assert pair.vehicle.counts["session_requests_forged"] == 4


@pytest.mark.parametrize("channel", ["session", "netem"])
def test_a_signed_request_that_is_no_message_is_rejected(pair: Pair, channel: str) -> None:
    """A request that an operator has signed, but that cannot be decoded, is counted and raises nothing."""
    pair.hold()
    assert pair.vehicle.open_request(channel, pair.operator.sign_request(channel, b"garbage")) is None
    assert pair.vehicle.counts[f"{channel}_requests_forged"] == 1


def test_the_token_is_read_by_who_requested_only(pair: Pair) -> None:
    """A reply holds the token encrypted, for whoever has asked and nobody else."""
    _, again = pair.ask(pair.request())
    assert again is not None
    signed, _ = pair.ask(again)
    assert TOKEN not in signed
    assert Pair().operator.open_reply("session", signed).body is None


def test_a_reply_counts_once(pair: Pair) -> None:
    """A reply of the vehicle is taken once; one to no request of ours, altered or of another vehicle never."""
    pair.hold()
    signed, body = pair.ask(pair.request())
    assert body is not None
    assert pair.operator.open_reply("session", signed).body is None
    data = pair.request()
    request = pair.vehicle.open_request("session", data)
    assert request is not None
    signed = pair.vehicle.sign_reply(request, encode(GRANTED))
    for at in range(len(signed)):
        assert (
            pair.operator.open_reply("session", signed[:at] + bytes([signed[at] ^ 1]) + signed[at + 1 :]).body is None
        )
    other = VehicleAuthenticator("car", MALLORY, OPERATORS)
    requested = other.open_request("session", data)
    assert requested is not None
    assert pair.operator.open_reply("session", other.sign_reply(requested, b"")).again is None
    assert pair.operator.open_reply("netem", signed).body is None
    assert pair.operator.open_reply("session", signed).body == encode(GRANTED)


@pytest.mark.parametrize("changes", [{"secret": bytes(32)}, {"public": bytes(32)}], ids=["secret", "key"])
def test_a_reply_that_cannot_be_decrypted_is_a_forgery(pair: Pair, changes: dict[str, Any]) -> None:
    """A signed reply that the operator cannot decrypt is counted, and the request goes on waiting for its reply."""
    pair.hold()
    request = pair.vehicle.open_request("session", pair.request())
    assert request is not None
    unreadable = pair.vehicle.sign_reply(replace(request, **changes), encode(GRANTED))
    assert pair.operator.open_reply("session", unreadable) == VerifiedReply(None, None)
    assert pair.operator.counts["session_replies_forged"] == 1
    assert pair.operator.open_reply("session", pair.vehicle.sign_reply(request, encode(GRANTED))).body is not None


def test_a_reply_from_before_another_is_not_taken(pair: Pair) -> None:
    """A reply that comes after that to a later query says what is no longer so: it is dropped."""
    pair.hold()
    replies = []
    for number in range(2):
        request = pair.vehicle.open_request("session", pair.request("hold", number))
        assert request is not None
        replies.append(pair.vehicle.sign_reply(request, b"" if request.is_stale else encode(GRANTED)))
    assert pair.operator.open_reply("session", replies[1]).again is not None
    assert pair.operator.open_reply("session", replies[0]) == VerifiedReply(None, None)
    assert pair.operator.open_reply("session", replies[1]) == VerifiedReply(None, None)


def test_states_are_the_vehicles_and_grow_newer(pair: Pair) -> None:
    """A state is shown once, in order, and only where the vehicle has signed it; any other causes no query."""
    pair.hold()
    first, second = pair.vehicle.sign_state(b"first"), pair.vehicle.sign_state(b"second")
    assert pair.operator.open_state(second).body == b"second"
    for old in (second, first):
        assert pair.operator.open_state(old) == VerifiedState(None, ask=False)
    assert pair.operator.counts["states_replayed"] == 2
    forged = VehicleAuthenticator("car", MALLORY, OPERATORS)
    forged._instance = pair.vehicle._instance
    forged._states = 100
    assert pair.operator.open_state(forged.sign_state(b"forged")) == VerifiedState(None, ask=False)
    assert pair.operator.counts["states_forged"] == 1


def test_a_reply_makes_no_old_state_new(pair: Pair) -> None:
    """After a reply of the same process of the server, states from before are still replays."""
    pair.hold()
    state = pair.vehicle.sign_state(b"state")
    assert pair.operator.open_state(state).body == b"state"
    pair.ask(pair.request())
    assert not pair.operator.is_next_state(state)
    assert pair.operator.open_state(state) == VerifiedState(None, ask=False)
    assert pair.operator.counts["states_replayed"] == 1


def test_states_of_a_server_started_anew_are_shown_when_it_has_answered(pair: Pair) -> None:
    """A state of a server's process that has not answered a request may be a recorded one: it is asked first."""
    pair.hold()
    anew = VehicleAuthenticator("car", VEHICLE, OPERATORS)
    opened = pair.operator.open_state(anew.sign_state(b"new"))
    assert opened.body is None
    assert opened.ask
    assert pair.operator.counts["states_of_another_time"] == 1
    pair.vehicle = anew
    pair.ask(pair.operator.sign_request("session", b""))
    assert pair.operator.open_state(anew.sign_state(b"newer")).body == b"newer"


def test_each_kind_of_query_has_its_own_order(pair: Pair) -> None:
    """Requests for a condition do not make those of the session stale."""
    pair.hold()
    session = pair.request()
    netem = encode(NetemRequest("alice", 5, "L4", 0, 0.0, 0.0, 0.0, "uniform", 0.0, 1.0, 0, 0.0, 0.0))
    requested = pair.vehicle.open_request("netem", pair.operator.sign_request("netem", netem))
    assert requested is not None
    again = pair.operator.open_reply("netem", pair.vehicle.sign_reply(requested, b"")).again
    assert again is not None
    requested = pair.vehicle.open_request("netem", again)
    assert requested is not None
    reply = pair.operator.open_reply("netem", pair.vehicle.sign_reply(requested, encode(NetemReply(True, ""))))
    assert decode(NetemReply, reply.body or b"").granted
    request = pair.vehicle.open_request("session", session)
    assert request is not None
    assert not request.is_stale


def test_requests_without_replies_are_bounded(pair: Pair) -> None:
    """Of requests that wait for a reply only the newest are kept: their replies are accepted, those before are not."""
    pair.hold()
    requests = [pair.vehicle.open_request("netem", pair.operator.sign_request("netem", b""))]
    requests += [pair.vehicle.open_request("session", pair.request("hold", number)) for number in range(3 * KEPT)]
    assert len(pair.operator._requested) == KEPT
    replies = [pair.vehicle.sign_reply(request, encode(GRANTED)) for request in requests if request is not None]
    assert pair.operator.open_reply("netem", replies[0]) == VerifiedReply(None, None)
    assert pair.operator.open_reply("session", replies[-KEPT - 1]) == VerifiedReply(None, None)
    assert len(pair.operator._requested) == KEPT
    assert pair.operator.open_reply("session", replies[-KEPT]) != VerifiedReply(None, None)


def test_agreements_with_clients_are_bounded(pair: Pair) -> None:
    """Of clients that come and go the vehicle remembers the newest, and what it has agreed on with them."""
    requests = [Pair().request() for _ in range(3 * KEPT)]
    publics = [request.public for each in requests if (request := pair.vehicle.open_request("session", each))]
    assert len(set(publics)) == 3 * KEPT
    assert len(pair.vehicle._agreements) == KEPT
    remembered = pair.vehicle.open_request("session", requests[-KEPT])
    assert remembered is not None
    assert remembered.public == publics[-KEPT]
    forgotten = pair.vehicle.open_request("session", requests[0])
    assert forgotten is not None
    assert forgotten.public != publics[0]


@pytest.mark.parametrize(("more_bytes", "accepted"), [(0, True), (1, False)])
def test_envelopes_have_a_largest_size(pair: Pair, more_bytes: int, *, accepted: bool) -> None:
    """An envelope of the largest size is opened; one that is a byte longer is a forgery, whoever has signed it."""
    pair.hold()
    command = bytes(LONGEST_BYTES - TRAILER_BYTES + more_bytes)
    signed = pair.operator.sign_command(command)
    assert len(signed) == LONGEST_BYTES + more_bytes
    assert pair.vehicle.body(signed) == (command if accepted else b"")
    assert pair.vehicle.is_from_active_operator(signed) == accepted
    assert pair.vehicle.open_command(signed) == (command if accepted else None)
    state = bytes(LONGEST_BYTES - TRAILER_BYTES - 16 + more_bytes)
    signed = pair.vehicle.sign_state(state)
    assert pair.operator.is_next_state(signed) == accepted
    assert pair.operator.open_state(signed).body == (state if accepted else None)
    request = pair.vehicle.open_request("netem", pair.operator.sign_request("netem", b""))
    assert request is not None
    reply = bytes(LONGEST_BYTES - len(pair.vehicle.sign_reply(request, b"")) + more_bytes)
    fresh = replace(request, is_stale=False)
    assert pair.operator.open_reply("netem", pair.vehicle.sign_reply(fresh, reply)).body == (
        reply if accepted else None
    )
    rejected = 0 if accepted else 1
    assert pair.vehicle.counts["commands_forged"] == rejected
    assert pair.operator.counts == Counter(states_forged=rejected, netem_replies_forged=rejected)


@given(st.binary(max_size=1400))
def test_any_bytes_are_counted_and_raise_nothing(data: bytes) -> None:
    """Whatever comes in at any of the openings is refused without an error."""
    pair = Pair()
    assert not pair.vehicle.is_from_active_operator(data)
    assert pair.vehicle.open_command(data) is None
    assert pair.vehicle.open_request("session", data) is None
    assert pair.vehicle.open_request("netem", data) is None
    assert pair.operator.open_reply("session", data).body is None
    assert pair.operator.open_state(data) == VerifiedState(None, ask=False)


def test_without_keys_everything_is_as_it_is() -> None:
    """Where nothing is signed, bytes go in and out unchanged."""
    authenticator = NullVehicleAuthenticator()
    request = authenticator.open_request("session", b"request")
    assert request is not None
    assert {
        authenticator.body(b"x"),
        authenticator.open_command(b"x"),
        authenticator.sign_state(b"x"),
        authenticator.sign_reply(request, b"x"),
    } == {b"x"}
    assert request.body == b"request"
    assert authenticator.is_from_active_operator(b"x")
