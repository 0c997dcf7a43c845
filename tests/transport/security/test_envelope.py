# ruff: noqa: D102 (test helpers with self-explanatory methods)

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from lavt.domain import (
    PATH_POINTS,
    Command,
    NetemReply,
    NetemRequest,
    SessionReply,
    SessionRequest,
)
from lavt.transport.messages import decode, encode

pytest.importorskip("cryptography", reason="an extra: pip install -e '.[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from lavt.transport.security.envelope import (
    TRAILER_BYTES,
    NullVehicleAuthenticator,
    OperatorAuthenticator,
    VehicleAuthenticator,
)
from lavt.transport.security.keys import PrivateKey
from lavt.transport.security.verified import VerifiedReply, VerifiedState

MAX_ENTRIES, MAX_ENVELOPE_BYTES = 8, 1280
"""The design's limits on pending requests, on key agreements and on the size of an envelope, repeated here: a change of
the code's limits must change these, too."""
COMMAND = Command(77, 3, 1, 2, 3, 0.1, 0.2, 0.0, (0.0,) * PATH_POINTS, "drive", 0)
TOKEN = bytes(range(16))
GRANTED = SessionReply(True, "", 77, TOKEN, 5600, "kernel", 0)


def new_key() -> PrivateKey:
    return PrivateKey(Ed25519PrivateKey.generate())


VEHICLE, ALICE, BOB, MALLORY = (new_key() for _ in range(4))
OPERATORS = {"alice": ALICE.public, "bob": BOB.public}


class Pair:
    """A vehicle's and an operator's authenticator that exchange bytes."""

    def __init__(
        self, who: str = "alice", key: PrivateKey = ALICE, vehicle: VehicleAuthenticator | None = None
    ) -> None:
        self.who = who
        self.vehicle = vehicle or VehicleAuthenticator("car", VEHICLE, OPERATORS)
        self.operator = OperatorAuthenticator("car", who, key, VEHICLE.public)

    def signed_request(self, operation: str = "acquire", number: int = 0) -> bytes:
        request = SessionRequest(operation, self.who, 5, number)  # type: ignore[arg-type]
        return self.operator.sign_request("session", encode(request))

    def exchange(self, data: bytes, reply: SessionReply = GRANTED) -> tuple[bytes, bytes | None]:
        """Deliver a request and its reply; return the reply's envelope, and its body or the retry."""
        request = self.vehicle.verify_request("session", data)
        assert request is not None
        signed = self.vehicle.sign_reply(request, b"" if request.must_retry else encode(reply))
        verified = self.operator.verify_reply("session", signed)
        return signed, verified.repeated_request if request.must_retry else verified.body

    def acquire_control(self) -> None:
        _, retry = self.exchange(self.signed_request())
        assert retry is not None
        _, body = self.exchange(retry)
        assert body == encode(GRANTED)

    def signed_command(self, command: Command = COMMAND) -> bytes:
        return self.operator.sign_command(encode(command))


@pytest.fixture
def pair() -> Pair:
    return Pair()


def test_the_first_request_must_be_retried(pair: Pair) -> None:
    """A server that has just started rejects the first request; its reply has the replay counter for the retry."""
    request = pair.vehicle.verify_request("session", pair.signed_request())
    assert request is not None
    assert request.must_retry
    pair.acquire_control()


def test_a_command_of_the_active_operator_is_accepted(pair: Pair) -> None:
    """The active operator's command has a valid MAC and is returned unchanged."""
    pair.acquire_control()
    assert pair.vehicle.is_from_active_operator(pair.signed_command())
    assert pair.vehicle.verify_command(pair.signed_command()) == encode(COMMAND)


def test_a_command_of_another_operator_is_rejected(pair: Pair) -> None:
    """A command of another known operator, or signed with an unknown key, is rejected."""
    pair.acquire_control()
    for other in (Pair("bob", BOB), Pair("alice", MALLORY)):
        assert not pair.vehicle.is_from_active_operator(other.signed_command())
        assert pair.vehicle.verify_command(other.signed_command()) is None
    assert pair.vehicle.counts["commands_forged"] == 2


def test_any_known_operator_may_send_an_emergency_stop(pair: Pair) -> None:
    """A command with an emergency stop is accepted from every known operator, and from nobody else."""
    pair.acquire_control()
    stop = replace(COMMAND, emergency_stop=9)
    assert pair.vehicle.verify_command(Pair("bob", BOB).signed_command(stop)) == encode(stop)
    assert pair.vehicle.verify_command(Pair("bob", MALLORY).signed_command(stop)) is None
    assert pair.vehicle.verify_command(Pair("bob", BOB).operator.sign_command(b"garbage")) is None


def test_without_a_session_no_mac_is_valid(pair: Pair) -> None:
    """Before a session starts MACs are zeros, and zeros are not a valid MAC."""
    assert pair.signed_command()[-TRAILER_BYTES:-64] == bytes(16)
    assert not pair.vehicle.is_from_active_operator(pair.signed_command())
    assert not pair.vehicle.is_active_operators_next_request("session", pair.signed_request())
    assert not pair.operator.is_next_state(pair.vehicle.sign_state(b"state"))


def test_after_a_release_commands_are_rejected(pair: Pair) -> None:
    """After the active operator has released the vehicle, this operator's commands are rejected."""
    pair.acquire_control()
    pair.exchange(pair.signed_request("release"), SessionReply(True, "", 0, b"", 5600, "kernel", 0))
    assert not pair.vehicle.is_from_active_operator(pair.signed_command())
    assert pair.vehicle.verify_command(pair.signed_command()) is None


def test_an_altered_command_is_rejected(pair: Pair) -> None:
    """A command with one altered byte fails its MAC check, its signature check, or both."""
    pair.acquire_control()
    signed = pair.signed_command()
    for position in range(len(signed)):
        altered = signed[:position] + bytes([signed[position] ^ 1]) + signed[position + 1 :]
        before_signature = position < len(signed) - 64
        assert not (before_signature and pair.vehicle.is_from_active_operator(altered))
        in_mac = len(signed) - TRAILER_BYTES <= position < len(signed) - 64
        assert (pair.vehicle.verify_command(altered) is None) != in_mac


def test_a_mac_is_valid_for_one_channel_and_one_message(pair: Pair) -> None:
    """A MAC is not valid on another channel, nor for a request or a state that was accepted before."""
    pair.acquire_control()
    request = pair.signed_request()
    assert pair.vehicle.is_active_operators_next_request("session", request)
    assert not pair.vehicle.is_active_operators_next_request("netem", request)
    assert not pair.vehicle.is_from_active_operator(request)
    pair.exchange(request)
    assert not pair.vehicle.is_active_operators_next_request("session", request)
    state = pair.vehicle.sign_state(b"state")
    assert pair.operator.is_next_state(state)
    assert pair.operator.verify_state(state).body == b"state"
    assert not pair.operator.is_next_state(state)


def test_a_command_for_another_vehicle_is_rejected(pair: Pair) -> None:
    """A command signed for another vehicle is rejected."""
    pair.acquire_control()
    truck_operator = OperatorAuthenticator("truck", "alice", ALICE, VEHICLE.public)
    assert pair.vehicle.verify_command(truck_operator.sign_command(encode(COMMAND))) is None


def test_a_replayed_request_is_not_executed(pair: Pair) -> None:
    """A request that is sent a second time must be sent again with the next replay counter, and is counted."""
    pair.acquire_control()
    data = pair.signed_request("release")
    pair.exchange(data)
    replayed = pair.vehicle.verify_request("session", data)
    assert replayed is not None
    assert replayed.must_retry
    assert pair.vehicle.counts["session_requests_with_wrong_counter"] == 2


def test_a_request_to_an_earlier_process_of_the_server_is_stale(pair: Pair) -> None:
    """A request that was signed for the server before its restart is stale afterwards."""
    pair.acquire_control()
    data = pair.signed_request("acquire")
    request = VehicleAuthenticator("car", VEHICLE, OPERATORS).verify_request("session", data)
    assert request is not None
    assert request.must_retry


@pytest.mark.parametrize("number", [0, 7, 2**63 - 1])
def test_an_emergency_stop_needs_no_retry(pair: Pair, number: int) -> None:
    """A request for an emergency stop is never stale, whatever its number."""
    request = pair.vehicle.verify_request("session", pair.signed_request("emergency_stop", number))
    assert request is not None
    assert not request.must_retry


def test_an_empty_request_only_asks_for_the_replay_counter(pair: Pair) -> None:
    """An empty request is stale even with the next replay counter, and is not counted as a replay."""
    pair.acquire_control()
    before = pair.vehicle.counts["session_requests_with_wrong_counter"]
    request = pair.vehicle.verify_request("session", pair.operator.sign_request("session", b""))
    assert request is not None
    assert request.must_retry
    assert pair.vehicle.counts["session_requests_with_wrong_counter"] == before


def test_a_request_with_an_impossible_key_is_rejected(pair: Pair) -> None:
    """A signed request with an invalid X25519 key is counted as a forgery."""
    pair.operator._agreement.public = bytes(32)
    assert pair.vehicle.verify_request("session", pair.signed_request()) is None
    assert pair.vehicle.counts["session_requests_forged"] == 1


def test_a_reply_without_a_token_does_not_end_the_session(pair: Pair) -> None:
    """After a request that is granted without a token, such as an emergency stop, commands are still accepted."""
    pair.acquire_control()
    pair.exchange(pair.signed_request("emergency_stop", 7), SessionReply(True, "", 0, b"", 5600, "kernel", 7))
    assert pair.vehicle.is_from_active_operator(pair.signed_command())
    assert pair.vehicle.verify_command(pair.signed_command()) == encode(COMMAND)


def test_a_request_in_another_name_is_rejected(pair: Pair) -> None:
    """A request in the name of another or an unknown operator is rejected."""
    for name, key in (("alice", BOB), ("alice", MALLORY), ("mallory", MALLORY)):
        assert pair.vehicle.verify_request("session", Pair(name, key).signed_request()) is None
    forged = pair.operator.sign_request("session", encode(SessionRequest("acquire", "bob", 5, 0)))
    assert pair.vehicle.verify_request("session", forged) is None
    assert pair.vehicle.counts["session_requests_forged"] == 4


@pytest.mark.parametrize("channel", ["session", "netem"])
def test_a_signed_request_that_cannot_be_decoded_is_rejected(pair: Pair, channel: str) -> None:
    """A signed request that cannot be decoded is counted as a forgery and raises nothing."""
    pair.acquire_control()
    assert pair.vehicle.verify_request(channel, pair.operator.sign_request(channel, b"garbage")) is None
    assert pair.vehicle.counts[f"{channel}_requests_forged"] == 1


def test_only_the_client_that_requested_can_read_the_token(pair: Pair) -> None:
    """A reply contains the token encrypted, and another client of the same operator cannot read it."""
    _, retry = pair.exchange(pair.signed_request())
    assert retry is not None
    signed, _ = pair.exchange(retry)
    assert TOKEN not in signed
    assert Pair().operator.verify_reply("session", signed).body is None


def test_a_reply_is_accepted_once(pair: Pair) -> None:
    """A reply is accepted once; an altered reply, another vehicle's, or one on the wrong channel is rejected."""
    pair.acquire_control()
    signed, body = pair.exchange(pair.signed_request())
    assert body is not None
    assert pair.operator.verify_reply("session", signed).body is None
    data = pair.signed_request()
    request = pair.vehicle.verify_request("session", data)
    assert request is not None
    signed = pair.vehicle.sign_reply(request, encode(GRANTED))
    for position in range(len(signed)):
        altered = signed[:position] + bytes([signed[position] ^ 1]) + signed[position + 1 :]
        assert pair.operator.verify_reply("session", altered).body is None
    other = VehicleAuthenticator("car", MALLORY, OPERATORS)
    other_request = other.verify_request("session", data)
    assert other_request is not None
    assert pair.operator.verify_reply("session", other.sign_reply(other_request, b"")).repeated_request is None
    assert pair.operator.verify_reply("netem", signed).body is None
    assert pair.operator.verify_reply("session", signed).body == encode(GRANTED)


@pytest.mark.parametrize("changes", [{"secret": bytes(32)}, {"public": bytes(32)}], ids=["secret", "key"])
def test_a_reply_that_cannot_be_decrypted_is_a_forgery(pair: Pair, changes: dict[str, Any]) -> None:
    """A signed reply that cannot be decrypted is counted as a forgery, and the request stays pending."""
    pair.acquire_control()
    request = pair.vehicle.verify_request("session", pair.signed_request())
    assert request is not None
    unreadable = pair.vehicle.sign_reply(replace(request, **changes), encode(GRANTED))
    assert pair.operator.verify_reply("session", unreadable) == VerifiedReply(None, None)
    assert pair.operator.counts["session_replies_forged"] == 1
    assert pair.operator.verify_reply("session", pair.vehicle.sign_reply(request, encode(GRANTED))).body is not None


def test_a_reply_to_an_earlier_request_is_rejected(pair: Pair) -> None:
    """A reply that arrives after the reply to a later request is rejected."""
    pair.acquire_control()
    replies = []
    for number in range(2):
        request = pair.vehicle.verify_request("session", pair.signed_request("acquire", number))
        assert request is not None
        replies.append(pair.vehicle.sign_reply(request, b"" if request.must_retry else encode(GRANTED)))
    assert pair.operator.verify_reply("session", replies[1]).repeated_request is not None
    assert pair.operator.verify_reply("session", replies[0]) == VerifiedReply(None, None)
    assert pair.operator.verify_reply("session", replies[1]) == VerifiedReply(None, None)


def test_replayed_and_forged_states_are_rejected(pair: Pair) -> None:
    """A state that is not newer than the last, or not signed by the vehicle, is rejected and causes no request."""
    pair.acquire_control()
    first, second = pair.vehicle.sign_state(b"first"), pair.vehicle.sign_state(b"second")
    assert pair.operator.verify_state(second).body == b"second"
    for old in (second, first):
        assert pair.operator.verify_state(old) == VerifiedState(None, client_must_request=False)
    assert pair.operator.counts["states_replayed"] == 2
    forged = VehicleAuthenticator("car", MALLORY, OPERATORS)
    forged._instance = pair.vehicle._instance
    forged._states = 100
    assert pair.operator.verify_state(forged.sign_state(b"forged")) == VerifiedState(None, client_must_request=False)
    assert pair.operator.counts["states_forged"] == 1


def test_after_a_reply_old_states_are_still_replays(pair: Pair) -> None:
    """After a reply of the same process of the server, earlier states are still rejected as replays."""
    pair.acquire_control()
    state = pair.vehicle.sign_state(b"state")
    assert pair.operator.verify_state(state).body == b"state"
    pair.exchange(pair.signed_request())
    assert not pair.operator.is_next_state(state)
    assert pair.operator.verify_state(state) == VerifiedState(None, client_must_request=False)
    assert pair.operator.counts["states_replayed"] == 1


def test_states_of_a_restarted_server_are_accepted_after_its_first_reply(pair: Pair) -> None:
    """States of a restarted server are rejected until it has answered a request."""
    pair.acquire_control()
    restarted = VehicleAuthenticator("car", VEHICLE, OPERATORS)
    state = pair.operator.verify_state(restarted.sign_state(b"new"))
    assert state.body is None
    assert state.client_must_request
    assert pair.operator.counts["states_of_unknown_process"] == 1
    pair.vehicle = restarted
    pair.exchange(pair.operator.sign_request("session", b""))
    assert pair.operator.verify_state(restarted.sign_state(b"newer")).body == b"newer"


def test_each_channel_has_its_own_replay_counter(pair: Pair) -> None:
    """A request on the netem channel does not make a session request stale."""
    pair.acquire_control()
    session = pair.signed_request()
    netem = encode(NetemRequest("alice", 5, "L4", 0, 0.0, 0.0, 0.0, "uniform", 0.0, 1.0, 0, 0.0, 0.0))
    request = pair.vehicle.verify_request("netem", pair.operator.sign_request("netem", netem))
    assert request is not None
    retry = pair.operator.verify_reply("netem", pair.vehicle.sign_reply(request, b"")).repeated_request
    assert retry is not None
    request = pair.vehicle.verify_request("netem", retry)
    assert request is not None
    reply = pair.operator.verify_reply("netem", pair.vehicle.sign_reply(request, encode(NetemReply(True, ""))))
    assert decode(NetemReply, reply.body or b"").granted
    request = pair.vehicle.verify_request("session", session)
    assert request is not None
    assert not request.must_retry


def test_pending_requests_are_bounded(pair: Pair) -> None:
    """The operator keeps the newest 8 pending requests and rejects replies to earlier ones."""
    pair.acquire_control()
    requests = [pair.vehicle.verify_request("netem", pair.operator.sign_request("netem", b""))]
    requests += [
        pair.vehicle.verify_request("session", pair.signed_request("acquire", number))
        for number in range(3 * MAX_ENTRIES)
    ]
    assert len(pair.operator._pending) == MAX_ENTRIES
    replies = [pair.vehicle.sign_reply(request, encode(GRANTED)) for request in requests if request is not None]
    assert pair.operator.verify_reply("netem", replies[0]) == VerifiedReply(None, None)
    assert pair.operator.verify_reply("session", replies[-MAX_ENTRIES - 1]) == VerifiedReply(None, None)
    assert len(pair.operator._pending) == MAX_ENTRIES
    assert pair.operator.verify_reply("session", replies[-MAX_ENTRIES]) != VerifiedReply(None, None)


def test_key_agreements_are_bounded(pair: Pair) -> None:
    """The vehicle keeps the key agreements with the newest 8 clients."""
    requests = [Pair().signed_request() for _ in range(3 * MAX_ENTRIES)]
    publics = [request.public for data in requests if (request := pair.vehicle.verify_request("session", data))]
    assert len(set(publics)) == 3 * MAX_ENTRIES
    assert len(pair.vehicle._agreements) == MAX_ENTRIES
    remembered = pair.vehicle.verify_request("session", requests[-MAX_ENTRIES])
    assert remembered is not None
    assert remembered.public == publics[-MAX_ENTRIES]
    forgotten = pair.vehicle.verify_request("session", requests[0])
    assert forgotten is not None
    assert forgotten.public != publics[0]


@pytest.mark.parametrize(("more_bytes", "accepted"), [(0, True), (1, False)])
def test_envelopes_have_a_maximum_size(pair: Pair, more_bytes: int, *, accepted: bool) -> None:
    """A signed envelope of the maximum size is accepted; one that is a byte longer is counted as a forgery."""
    pair.acquire_control()
    command = bytes(MAX_ENVELOPE_BYTES - TRAILER_BYTES + more_bytes)
    signed = pair.operator.sign_command(command)
    assert len(signed) == MAX_ENVELOPE_BYTES + more_bytes
    assert pair.vehicle.unverified_body(signed) == (command if accepted else b"")
    assert pair.vehicle.is_from_active_operator(signed) == accepted
    assert pair.vehicle.verify_command(signed) == (command if accepted else None)
    state = bytes(MAX_ENVELOPE_BYTES - TRAILER_BYTES - 16 + more_bytes)
    signed = pair.vehicle.sign_state(state)
    assert pair.operator.is_next_state(signed) == accepted
    assert pair.operator.verify_state(signed).body == (state if accepted else None)
    request = pair.vehicle.verify_request("netem", pair.operator.sign_request("netem", b""))
    assert request is not None
    reply = bytes(MAX_ENVELOPE_BYTES - len(pair.vehicle.sign_reply(request, b"")) + more_bytes)
    fresh = replace(request, must_retry=False)
    assert pair.operator.verify_reply("netem", pair.vehicle.sign_reply(fresh, reply)).body == (
        reply if accepted else None
    )
    rejected = 0 if accepted else 1
    assert pair.vehicle.counts["commands_forged"] == rejected
    assert pair.operator.counts == Counter(states_forged=rejected, netem_replies_forged=rejected)


@given(st.binary(max_size=1400))
def test_arbitrary_bytes_are_rejected(data: bytes) -> None:
    """Arbitrary bytes are rejected as command, request, reply or state and raise nothing."""
    pair = Pair()
    assert not pair.vehicle.is_from_active_operator(data)
    assert pair.vehicle.verify_command(data) is None
    assert pair.vehicle.verify_request("session", data) is None
    assert pair.vehicle.verify_request("netem", data) is None
    assert pair.operator.verify_reply("session", data).body is None
    assert pair.operator.verify_state(data) == VerifiedState(None, client_must_request=False)


def test_without_keys_messages_are_unchanged() -> None:
    """Without keys messages are accepted and sent unchanged."""
    authenticator = NullVehicleAuthenticator()
    request = authenticator.verify_request("session", b"request")
    assert request is not None
    assert {
        authenticator.unverified_body(b"x"),
        authenticator.verify_command(b"x"),
        authenticator.sign_state(b"x"),
        authenticator.sign_reply(request, b"x"),
    } == {b"x"}
    assert request.body == b"request"
    assert authenticator.is_from_active_operator(b"x")
