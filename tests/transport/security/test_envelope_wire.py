"""Check the bytes of signed messages against `docs/wire.md`, as another implementation would have to send them."""

from __future__ import annotations

import hashlib
import hmac

import pytest
from msgspec.structs import replace

from lavt.domain import SessionReply, SessionRequest
from lavt.transport.messages import MAX_MESSAGE_BYTES, encode
from lavt.transport.security.envelope import MAX_ENVELOPE_BYTES, OperatorAuthenticator, VehicleAuthenticator

pytest.importorskip("cryptography", reason="an extra: pip install -e '.[secure]'")

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PublicKey

from lavt.transport.security.keys import KeyAgreement, PrivateKey, decrypt

TOKEN = bytes(range(16))
ACQUIRE = encode(SessionRequest("acquire", "alice", 5, 0))
GRANTED = encode(SessionReply(True, "", 77, TOKEN, 5600, "kernel", 0))
VEHICLE, ALICE = (PrivateKey(Ed25519PrivateKey.generate()) for _ in range(2))


class Session:
    """A vehicle, and an operator who has control of it."""

    def __init__(self) -> None:
        self.vehicle = VehicleAuthenticator("car", VEHICLE, {"alice": ALICE.public})
        self.operator = OperatorAuthenticator("car", "alice", ALICE, VEHICLE.public)
        data = self.operator.sign_request("session", ACQUIRE)
        for body in (b"", GRANTED):
            request = self.vehicle.verify_request("session", data)
            assert request is not None
            data = self.operator.verify_reply("session", self.vehicle.sign_reply(request, body)).repeated_request or b""


@pytest.fixture
def session() -> Session:
    return Session()


def signed_part(key: PrivateKey, purpose: str, envelope: bytes, trailer_bytes: int) -> bytes:
    """Verify the signature of an envelope as `docs/wire.md` describes it; return the part before the trailer."""
    signed = envelope[:-trailer_bytes]
    assert key.public.verify(envelope[-64:], b"LAVT 1 " + purpose.encode() + b" car\0" + signed)
    return signed


def expected_mac(channel: bytes, signed: bytes) -> bytes:
    """Return the MAC that `docs/wire.md` describes."""
    key = hmac.digest(TOKEN, b"LAVT 1 codes", "sha256")
    return hmac.digest(key, channel + signed, "sha256")[:16]


def test_bytes_of_commands_states_and_requests(session: Session) -> None:
    """Commands, states and requests carry a MAC and a signature, as `docs/wire.md` describes."""
    command = session.operator.sign_command(b"command")
    assert signed_part(ALICE, "control", command, 80) == b"command"
    assert command[-80:-64] == expected_mac(b"control", b"command")
    states = [session.vehicle.sign_state(b"state") for _ in range(2)]
    first, second = (signed_part(VEHICLE, "state", state, 80) for state in states)
    assert (first[8:], second[8:]) == (bytes(7) + b"\1state", bytes(7) + b"\2state")
    assert first[:8] == second[:8]
    assert states[0][-80:-64] == expected_mac(b"state", first)
    for channel, counter in (("session", first[:8] + bytes(7) + b"\1"), ("netem", bytes(16))):
        request = session.operator.sign_request(channel, b"request")
        signed = signed_part(ALICE, channel, request, 80)
        assert (signed[:16], signed[48:]) == (counter, b"alice".ljust(32, b"\0") + b"request")
        assert request[-80:-64] == expected_mac(channel.encode(), signed)


@pytest.mark.parametrize("must_retry", [False, True])
def test_bytes_of_a_reply(session: Session, *, must_retry: bool) -> None:
    """A reply carries a signature and no MAC, as `docs/wire.md` describes."""
    client_agreement = session.operator._agreement = KeyAgreement()
    data = session.operator.sign_request("session", ACQUIRE)
    request = session.vehicle.verify_request("session", data)
    assert request is not None
    reply = session.vehicle.sign_reply(replace(request, must_retry=must_retry), GRANTED)
    signed = signed_part(VEHICLE, "session reply", reply, 64)
    digest = hashlib.sha256(data).digest()[:16]
    counter = session.vehicle.sign_state(b"")[:8] + bytes(7) + b"\2"
    assert (signed[:16], signed[16:17], signed[17:33]) == (digest, b"\1" if must_retry else b"\0", counter)
    server_public = signed[33:65]
    shared = client_agreement._key.exchange(X25519PublicKey.from_public_bytes(server_public))
    extracted = hmac.digest(bytes(32), shared, "sha256")  # RFC 5869 with 32 zeros as salt
    context = b"LAVT 1 secret car\0" + client_agreement.public + server_public
    secret = hmac.digest(extracted, context + b"\1", "sha256")
    assert decrypt(secret, signed[65:], digest) == GRANTED


def test_the_largest_message_fits_into_every_envelope(session: Session) -> None:
    """An envelope around the largest message does not exceed the maximum size of an envelope."""
    largest = bytes(MAX_MESSAGE_BYTES)
    request = session.vehicle.verify_request("netem", session.operator.sign_request("netem", b""))
    assert request is not None
    signed = [
        session.operator.sign_command(largest),
        session.operator.sign_request("session", largest),
        session.vehicle.sign_state(largest),
        session.vehicle.sign_reply(request, largest),
    ]
    assert max(map(len, signed)) <= MAX_ENVELOPE_BYTES
