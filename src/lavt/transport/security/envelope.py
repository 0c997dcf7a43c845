"""Signed envelopes for the messages that cross Zenoh, with protection against replays. Formats: `docs/wire.md`.

A router's access list knows the neighbour that passed a message on, but not its origin: any process that reaches the
operator's router could publish. Commands and requests therefore carry the operator's signature (Ed25519), which the
vehicle verifies. States and replies carry the vehicle's signature, which the operator verifies. Commands, requests and
states also carry a MAC under the session's token, which is cheaper to verify. This module has no input, output or
clock; callers do the locking.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

from lavt.domain import Command, NetemRequest, RunRequest, SessionReply, SessionRequest
from lavt.errors import BadMessage
from lavt.transport.messages import MAX_MESSAGE_BYTES, MAX_RUN_REPLY_BYTES, decode
from lavt.transport.security.keys import (
    PUBLIC_KEY_BYTES,
    SIGNATURE_BYTES,
    KeyAgreement,
    PrivateKey,
    PublicKey,
    decrypt,
    encrypt,
)
from lavt.transport.security.verified import VerifiedReply, VerifiedRequest, VerifiedState

MAC_BYTES: Final = 16
"""Size of a MAC, which costs a fiftieth of a signature: it separates the active operator's messages from a flood."""
TRAILER_BYTES: Final = MAC_BYTES + SIGNATURE_BYTES
"""MAC and signature, which follow the signed part."""
REPLAY_COUNTER_BYTES: Final = 16
"""A random number of the server's process and a counter within that process, 8 bytes each."""
DIGEST_BYTES: Final = 16
MAX_ENVELOPE_BYTES: Final = MAX_MESSAGE_BYTES + 256
MAX_RUN_REPLY_ENVELOPE_BYTES: Final = MAX_RUN_REPLY_BYTES + 256
MAX_PENDING_REQUESTS: Final = 8
MAX_AGREEMENTS: Final = 8

REQUESTS: Final[dict[str, Any]] = {"session": SessionRequest, "netem": NetemRequest, "run": RunRequest}
"""Request classes by channel."""

_NO_MAC: Final = bytes(MAC_BYTES)
_ANSWER, _RETRY = b"\0", b"\1"
"""Kinds of replies: an answer, or a demand to send the request again with the replay counter that is in the reply."""
_NAME_BYTES: Final = 32


def _signing_context(purpose: str, vehicle: str) -> bytes:
    """Return the prefix of signed data, which makes a signature valid for one kind of message and one vehicle only."""
    return f"LAVT 1 {purpose} {vehicle}\0".encode()


class _SessionMacs:
    """The MACs of one session, with a key that only its two ends know; without a session, zeros that never verify."""

    def __init__(self, token: bytes = b"") -> None:
        self._key = hmac.digest(token, b"LAVT 1 codes", "sha256") if token else b""

    def compute(self, channel: str, signed: bytes) -> bytes:
        """Return the MAC of the signed part of an envelope."""
        return hmac.digest(self._key, channel.encode() + signed, "sha256")[:MAC_BYTES] if self._key else _NO_MAC

    def verify(self, channel: str, data: bytes) -> bool:
        """Return whether the MAC of an envelope is valid."""
        if not self._key or len(data) > MAX_ENVELOPE_BYTES:
            return False
        mac = data[-TRAILER_BYTES:-SIGNATURE_BYTES]
        return hmac.compare_digest(self.compute(channel, data[:-TRAILER_BYTES]), mac)


def _signed_part(data: bytes) -> bytes:
    """Return the part before MAC and signature, unverified; empty, which nobody signs, if the size is wrong."""
    return data[:-TRAILER_BYTES] if len(data) <= MAX_ENVELOPE_BYTES else b""


class NullVehicleAuthenticator:
    """The vehicle's authenticator if nothing is signed: it accepts every message and signs none."""

    counts: Mapping[str, int] = {}

    def unverified_body(self, data: bytes) -> bytes:
        """Return the command in an envelope without verifying it."""
        return data

    def is_from_active_operator(self, _data: bytes) -> bool:
        """Return True: without MACs every command could come from the active operator."""
        return True

    def is_active_operators_next_request(self, _channel: str, _data: bytes) -> bool:
        """Return False: without MACs nothing shows that a request comes from the active operator."""
        return False

    def verify_command(self, data: bytes) -> bytes | None:
        """Return the command."""
        return data

    def verify_request(self, channel: str, data: bytes) -> VerifiedRequest | None:
        """Return the request."""
        return VerifiedRequest(channel, "", data, b"", b"", b"", must_retry=False)

    def sign_state(self, body: bytes) -> bytes:
        """Return the state unchanged."""
        return body

    def sign_reply(self, _request: VerifiedRequest, body: bytes) -> bytes:
        """Return the reply unchanged."""
        return body

    def sign_info(self, _nonce: bytes, body: bytes) -> bytes:
        """Return the information unchanged."""
        return body


class VehicleAuthenticator(NullVehicleAuthenticator):
    """The vehicle's authenticator; `operators` maps the names of the permitted operators to their public keys."""

    def __init__(self, vehicle: str, key: PrivateKey, operators: Mapping[str, PublicKey]) -> None:
        self.counts = self._counts = Counter[str]()
        self._vehicle = vehicle
        self._key = key
        self._operators = dict(operators)
        self._instance = secrets.token_bytes(8)
        self._states = 0
        self._accepted_requests: Counter[tuple[str, str]] = Counter()
        """Number of requests that had the next replay counter, by channel and operator."""
        self._agreements: dict[bytes, tuple[bytes, bytes]] = {}
        """Secret and public key of this end, by the client's public key."""
        self._active_operator = ""
        self._macs = _SessionMacs()

    # Received messages.

    def unverified_body(self, data: bytes) -> bytes:
        """Return the command in an envelope without verifying it."""
        return _signed_part(data)

    def is_from_active_operator(self, data: bytes) -> bool:
        """Return whether the MAC of a command is valid, which is cheap to check."""
        return self._macs.verify("control", data)

    def is_active_operators_next_request(self, channel: str, data: bytes) -> bool:
        """Return whether a request has the active operator's next replay counter and a valid MAC; a cheap check."""
        counter = self._replay_counter(channel, self._active_operator)
        return data.startswith(counter) and self._macs.verify(channel, data)

    def verify_command(self, data: bytes) -> bytes | None:
        """Return the command if the active operator signed it, or if any operator signed an emergency stop."""
        body, signature = _signed_part(data), data[-SIGNATURE_BYTES:]
        signed = _signing_context("control", self._vehicle) + body
        active_operator = self._operators.get(self._active_operator)
        if active_operator is not None and active_operator.verify(signature, signed):
            return body
        if self._has_emergency_stop(body) and any(
            key.verify(signature, signed) for name, key in self._operators.items() if name != self._active_operator
        ):
            return body
        self._counts["commands_forged"] += 1
        return None

    def _has_emergency_stop(self, body: bytes) -> bool:
        try:
            return decode(Command, body).emergency_stop != 0
        except BadMessage:
            return False

    def verify_request(self, channel: str, data: bytes) -> VerifiedRequest | None:
        """Return the request if the operator that it names signed it, otherwise None."""
        signed, signature = _signed_part(data), data[-SIGNATURE_BYTES:]
        name_begin = REPLAY_COUNTER_BYTES + PUBLIC_KEY_BYTES
        body_begin = name_begin + _NAME_BYTES
        counter, public = signed[:REPLAY_COUNTER_BYTES], signed[REPLAY_COUNTER_BYTES:name_begin]
        operator = signed[name_begin:body_begin].rstrip(b"\0").decode("ascii", "replace")
        body = signed[body_begin:]
        key = self._operators.get(operator)
        if key is None or not key.verify(signature, _signing_context(channel, self._vehicle) + signed):
            self._counts[f"{channel}_requests_forged"] += 1
            return None
        agreed = self._agree_on_secret(public)
        if agreed is None or not self._is_in_own_name(channel, operator, body):
            self._counts[f"{channel}_requests_forged"] += 1
            return None
        is_next = counter == self._replay_counter(channel, operator)
        self._accepted_requests[channel, operator] += is_next
        # An emergency stop cannot wait for a second request; the vehicle executes each number once, also in replays.
        must_retry = body == b"" or not (is_next or _is_emergency_stop(channel, body))
        self._counts[f"{channel}_requests_with_wrong_counter"] += must_retry and body != b""
        secret, own_public = agreed
        return VerifiedRequest(channel, operator, body, _digest(data), secret, own_public, must_retry)

    def _is_in_own_name(self, channel: str, operator: str, body: bytes) -> bool:
        """Return whether a request names the operator that signed it; an empty request passes."""
        try:
            return body == b"" or bool(decode(REQUESTS[channel], body).who == operator)
        except BadMessage:
            return False

    def _replay_counter(self, channel: str, operator: str) -> bytes:
        """Return the replay counter that the operator's next request must have."""
        return self._instance + self._accepted_requests[channel, operator].to_bytes(8, "big")

    def _agree_on_secret(self, public: bytes) -> tuple[bytes, bytes] | None:
        """Return the secret shared with the owner of `public` and the public key of this end; None for a bad key."""
        if public not in self._agreements:
            agreement = KeyAgreement()
            context = _signing_context("secret", self._vehicle) + public + agreement.public
            secret = agreement.derive_secret(public, context)
            if secret is None:
                return None
            self._agreements[public] = secret, agreement.public
            if len(self._agreements) > MAX_AGREEMENTS:
                self._agreements.pop(next(iter(self._agreements)))
        return self._agreements[public]

    # Sent messages.

    def sign_state(self, body: bytes) -> bytes:
        """Add a number, a MAC and a signature to a state."""
        self._states += 1
        signed = self._instance + self._states.to_bytes(8, "big") + body
        signature = self._key.sign(_signing_context("state", self._vehicle) + signed)
        return signed + self._macs.compute("state", signed) + signature

    def sign_reply(self, request: VerifiedRequest, body: bytes) -> bytes:
        """Encrypt and sign the reply to `request`; `body` is empty if the reply demands the request again."""
        if not request.must_retry:
            self._update_session(request, body)
        counter = self._replay_counter(request.channel, request.operator)
        encrypted = encrypt(request.secret, body, request.digest)
        signed = request.digest + (_RETRY if request.must_retry else _ANSWER) + counter + request.public + encrypted
        return signed + self._key.sign(_signing_context(f"{request.channel} reply", self._vehicle) + signed)

    def sign_info(self, nonce: bytes, body: bytes) -> bytes:
        """Sign the information about the vehicle for the query with this nonce, so that it cannot be replayed."""
        return body + self._key.sign(_signing_context("info", self._vehicle) + nonce + body)

    def _update_session(self, request: VerifiedRequest, body: bytes) -> None:
        """Update the active operator and the session's MACs from a reply that is about to be sent."""
        if request.channel != "session":
            return
        reply, operation = decode(SessionReply, body), decode(SessionRequest, request.body).operation
        if reply.granted and operation == "release":
            self._active_operator, self._macs = "", _SessionMacs()
        elif reply.granted and reply.token:
            self._active_operator, self._macs = request.operator, _SessionMacs(reply.token)


class OperatorAuthenticator:
    """The operator's authenticator; `operator` is its name and `vehicle_key` the vehicle's public key."""

    def __init__(self, vehicle: str, operator: str, key: PrivateKey, vehicle_key: PublicKey) -> None:
        self.counts: Counter[str] = Counter()
        self._vehicle = vehicle
        self._operator = operator.encode().ljust(_NAME_BYTES, b"\0")
        self._key = key
        self._vehicle_key = vehicle_key
        self._agreement = KeyAgreement()
        self._replay_counters: dict[str, bytes] = dict.fromkeys(REQUESTS, bytes(REPLAY_COUNTER_BYTES))
        self._pending: dict[bytes, tuple[str, bytes]] = {}
        """Channel and body of the requests without a reply, by digest, oldest first."""
        self._macs = _SessionMacs()
        self._newest_state_number = bytes(REPLAY_COUNTER_BYTES)
        """The random number of the server's process and the number of its newest state, 8 bytes each."""

    # Sent messages.

    def sign_command(self, body: bytes) -> bytes:
        """Append MAC and signature to a command."""
        signature = self._key.sign(_signing_context("control", self._vehicle) + body)
        return body + self._macs.compute("control", body) + signature

    def sign_request(self, channel: str, body: bytes) -> bytes:
        """Sign a request; an empty body requests only the next replay counter."""
        signed = self._replay_counters[channel] + self._agreement.public + self._operator + body
        signature = self._key.sign(_signing_context(channel, self._vehicle) + signed)
        data = signed + self._macs.compute(channel, signed) + signature
        self._pending[_digest(data)] = channel, body
        if len(self._pending) > MAX_PENDING_REQUESTS:
            self._pending.pop(next(iter(self._pending)))
        return data

    # Received messages.

    def verify_reply(self, channel: str, data: bytes) -> VerifiedReply:
        """Return the vehicle's reply to a pending request; each reply is accepted once."""
        digest, kind = data[:DIGEST_BYTES], data[DIGEST_BYTES : DIGEST_BYTES + 1]
        counter_begin = DIGEST_BYTES + 1
        public_begin = counter_begin + REPLAY_COUNTER_BYTES
        body_begin = public_begin + PUBLIC_KEY_BYTES
        counter, public = data[counter_begin:public_begin], data[public_begin:body_begin]
        signed, signature = data[:-SIGNATURE_BYTES], data[-SIGNATURE_BYTES:]
        pending_channel, pending_body = self._pending.get(digest, ("", b""))
        if (
            pending_channel != channel
            or len(data) > (MAX_RUN_REPLY_ENVELOPE_BYTES if channel == "run" else MAX_ENVELOPE_BYTES)
            or not self._vehicle_key.verify(signature, _signing_context(f"{channel} reply", self._vehicle) + signed)
        ):
            return self._reject_forged_reply(channel)
        context = _signing_context("secret", self._vehicle) + self._agreement.public + public
        secret = self._agreement.derive_secret(public, context)
        body = None if secret is None else decrypt(secret, signed[body_begin:], digest)
        if body is None:
            return self._reject_forged_reply(channel)
        self._drop_pending(channel, digest)
        self._store_replay_counter(channel, counter)
        if kind == _RETRY:
            return VerifiedReply(None, self.sign_request(channel, pending_body) if pending_body else None)
        if channel == "session":
            self._update_session(body)
        return VerifiedReply(body, None)

    def _drop_pending(self, channel: str, answered: bytes) -> None:
        """Drop an answered request and the earlier requests on its channel: replies to them would be out of date."""
        for digest, (pending_channel, _) in list(self._pending.items()):
            if pending_channel == channel:
                del self._pending[digest]
            if digest == answered:
                return

    def _reject_forged_reply(self, channel: str) -> VerifiedReply:
        self.counts[f"{channel}_replies_forged"] += 1
        return VerifiedReply(None, None)

    def _store_replay_counter(self, channel: str, counter: bytes) -> None:
        self._replay_counters[channel] = counter
        if counter[:8] != self._newest_state_number[:8]:  # another process of the server: its first state has number 1
            self._newest_state_number = counter[:8] + bytes(8)

    def _update_session(self, body: bytes) -> None:
        try:
            reply = decode(SessionReply, body)
        except BadMessage:
            return
        if reply.granted and reply.token:
            self._macs = _SessionMacs(reply.token)

    def is_next_state(self, data: bytes) -> bool:
        """Return whether a state is newer than the last and has a valid MAC; a cheap check.

        Only the active operator has the token that it needs.
        """
        return data[:REPLAY_COUNTER_BYTES] > self._newest_state_number and self._macs.verify("state", data)

    def verify_state(self, data: bytes) -> VerifiedState:
        """Return the state if the vehicle signed it and it is newer than all previous states."""
        signed, signature = _signed_part(data), data[-SIGNATURE_BYTES:]
        number = signed[:REPLAY_COUNTER_BYTES]
        is_known_instance = number[:8] == self._newest_state_number[:8]
        if is_known_instance and number <= self._newest_state_number:
            self.counts["states_replayed"] += 1
            return VerifiedState(None, client_must_request=False)
        if not self._vehicle_key.verify(signature, _signing_context("state", self._vehicle) + signed):
            self.counts["states_forged"] += 1
            return VerifiedState(None, client_must_request=False)
        if not is_known_instance:
            self.counts["states_of_unknown_process"] += 1
            return VerifiedState(None, client_must_request=True)
        self._newest_state_number = number
        return VerifiedState(signed[REPLAY_COUNTER_BYTES:], client_must_request=False)


def verify_info(vehicle: str, key: PublicKey, nonce: bytes, data: bytes) -> bytes | None:
    """Return the information that a vehicle has signed for the query with this nonce, otherwise None."""
    body, signature = data[:-SIGNATURE_BYTES], data[-SIGNATURE_BYTES:]
    is_signed = key.verify(signature, _signing_context("info", vehicle) + nonce + body)
    return body if len(data) <= MAX_ENVELOPE_BYTES and is_signed else None


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()[:DIGEST_BYTES]


def _is_emergency_stop(channel: str, body: bytes) -> bool:
    return channel == "session" and decode(SessionRequest, body).operation == "emergency_stop"
