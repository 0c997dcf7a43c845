"""Signed messages against `docs/wire.md`: what a client or a vehicle of another make would have to send."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import replace

import pytest

from lavt.domain import SessionReply, SessionRequest
from lavt.transport.messages import MAX_MESSAGE_BYTES, encode
from lavt.transport.security.envelope import LONGEST_BYTES, OperatorAuthenticator, VehicleAuthenticator

pytest.importorskip("cryptography", reason="an extra: pip install 'lavt[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from lavt.transport.security.keys import KeyAgreement, PrivateKey, decrypt

TOKEN = bytes(range(16))
HOLD = encode(SessionRequest("hold", "alice", 5, 0))
GRANTED = encode(SessionReply(True, "", 77, TOKEN, 5600, "kernel", 0))
VEHICLE, ALICE = (PrivateKey(Ed25519PrivateKey.generate()) for _ in range(2))


class Session:
    """A vehicle, and an operator who has control of it."""

    def __init__(self) -> None:
        self.vehicle = VehicleAuthenticator("car", VEHICLE, {"alice": ALICE.public})
        self.operator = OperatorAuthenticator("car", "alice", ALICE, VEHICLE.public)
        data = self.operator.sign_request("session", HOLD)
        for body in (b"", GRANTED):
            request = self.vehicle.open_request("session", data)
            assert request is not None
            data = self.operator.open_reply("session", self.vehicle.sign_reply(request, body)).again or b""


@pytest.fixture
def session() -> Session:
    return Session()


def signed_by(key: PrivateKey, what: str, signed: bytes, trailer_bytes: int) -> bytes:
    """Check the signature of an envelope against `docs/wire.md`; return what stands before its trailer."""
    signed = signed[:-trailer_bytes]
    assert key.public.verifies(signed[-64:], b"LAVT 1 " + what.encode() + b" car\0" + signed)
    return signed


def code_of(channel: bytes, signed: bytes) -> bytes:
    """Return the code that `docs/wire.md` describes."""
    key = hmac.digest(TOKEN, b"LAVT 1 codes", "sha256")
    return hmac.digest(key, channel + signed, "sha256")[:16]


def test_bytes_of_what_is_signed_and_carries_a_code(session: Session) -> None:
    """Commands, states and queries have the bytes that `docs/wire.md` describes."""
    command = session.operator.sign_command(b"command")
    assert signed_by(ALICE, "control", command, 80) == b"command"
    assert command[7:23] == code_of(b"control", b"command")
    states = [session.vehicle.sign_state(b"state") for _ in range(2)]
    first, second = (signed_by(VEHICLE, "state", state, 80) for state in states)
    assert (first[8:], second[8:]) == (bytes(7) + b"\1state", bytes(7) + b"\2state")
    assert first[:8] == second[:8]
    assert states[0][-80:-64] == code_of(b"state", first)
    for channel, taken in (("session", first[:8] + bytes(7) + b"\1"), ("netem", bytes(16))):
        query = session.operator.sign_request(channel, b"query")
        signed = signed_by(ALICE, channel, query, 80)
        assert (signed[:16], signed[48:]) == (taken, b"alice".ljust(32, b"\0") + b"query")
        assert query[-80:-64] == code_of(channel.encode(), signed)


@pytest.mark.parametrize("stale", [False, True])
def test_bytes_of_a_reply(session: Session, *, stale: bool) -> None:
    """A reply has the bytes that `docs/wire.md` describes, and a client of another make reads it."""
    client = session.operator._agreement = KeyAgreement()
    query = session.operator.sign_request("session", HOLD)
    request = session.vehicle.open_request("session", query)
    assert request is not None
    signed = session.vehicle.sign_reply(replace(request, is_stale=stale), GRANTED)
    signed = signed_by(VEHICLE, "session reply", signed, 64)
    digest = hashlib.sha256(query).digest()[:16]
    place = session.vehicle.sign_state(b"")[:8] + bytes(7) + b"\2"
    assert (signed[:16], signed[16:17], signed[17:33]) == (digest, b"\1" if stale else b"\0", place)
    server = signed[33:65]
    secret = client.secret(server, b"LAVT 1 secret car\0" + client.public + server)
    assert secret is not None
    assert decrypt(secret, signed[65:], digest) == GRANTED


def test_the_largest_message_fits_into_every_envelope(session: Session) -> None:
    """What an envelope adds to the largest message leaves it within the largest size of an envelope."""
    largest = bytes(MAX_MESSAGE_BYTES)
    request = session.vehicle.open_request("netem", session.operator.sign_request("netem", b""))
    assert request is not None
    signed = [
        session.operator.sign_command(largest),
        session.operator.sign_request("session", largest),
        session.vehicle.sign_state(largest),
        session.vehicle.sign_reply(request, largest),
    ]
    assert max(map(len, signed)) <= LONGEST_BYTES
