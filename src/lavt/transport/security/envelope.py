"""Envelopes that say who sent a message, around what crosses Zenoh; replays are refused. Formats: `docs/wire.md`.

Access lists of routers see the neighbour and not the origin, and whoever reaches the operator's router could publish.
So commands and queries are signed with the operator's key, which the vehicle knows, and states and replies with the
vehicle's, which the operator knows (Ed25519). No input, output or clock here; whoever calls from several threads locks.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

from lavt.domain import Command, NetemRequest, SessionReply, SessionRequest
from lavt.errors import BadMessage
from lavt.transport.messages import MAX_MESSAGE_BYTES, decode
from lavt.transport.security.keys import (
    PUBLIC_KEY_BYTES,
    SIGNATURE_BYTES,
    KeyAgreement,
    PrivateKey,
    PublicKey,
    decrypt,
    encrypt,
)
from lavt.value import value

CODE_BYTES: Final = 16
"""Of the authentication code of who holds the vehicle, which costs a fiftieth of a signature and so answers a flood."""
TRAILER_BYTES: Final = CODE_BYTES + SIGNATURE_BYTES
"""After what is signed."""
PLACE_BYTES: Final = 16
"""Instance of the server's process and a number that counts within it, 8 bytes each."""
DIGEST_BYTES: Final = 16
LONGEST_BYTES: Final = MAX_MESSAGE_BYTES + 256
KEPT: Final = 8
"""So many requests wait for their replies, and so many agreements are remembered."""

REQUESTS: Final[dict[str, type[SessionRequest | NetemRequest]]] = {"session": SessionRequest, "netem": NetemRequest}
"""By the channel of the query."""

_NOBODY: Final = bytes(CODE_BYTES)
_HERE, _AGAIN = b"\0", b"\1"
"""A reply says: here is the answer; or: ask again with this place."""
_WHO_BYTES: Final = 32


def _context(what: str, vehicle: str) -> bytes:
    """Begin what is signed: no signature serves for another kind of message or another vehicle."""
    return f"LAVT 1 {what} {vehicle}\0".encode()


class _SessionMacs:
    """The codes of one session, which its two ends can make and nobody else; before there is one, of nobody."""

    def __init__(self, token: bytes = b"") -> None:
        self._key = hmac.digest(token, b"LAVT 1 codes", "sha256") if token else b""

    def of(self, channel: str, signed: bytes) -> bytes:
        """Make the code of what is signed."""
        return hmac.digest(self._key, channel.encode() + signed, "sha256")[:CODE_BYTES] if self._key else _NOBODY

    def fit(self, channel: str, data: bytes) -> bool:
        """Tell whether the code of an envelope is right."""
        if not self._key or len(data) > LONGEST_BYTES:
            return False
        code = data[-TRAILER_BYTES:-SIGNATURE_BYTES]
        return hmac.compare_digest(self.of(channel, data[:-TRAILER_BYTES]), code)


def _signed(data: bytes) -> bytes:
    """Return what is signed in an envelope, unchecked; empty, which nobody signs, where it is too short or too long."""
    return data[:-TRAILER_BYTES] if len(data) <= LONGEST_BYTES else b""


@value
class VerifiedRequest:
    """A query that is authentic and new: from whom, and what its reply needs to know of it."""

    channel: str
    who: str
    body: bytes
    """Empty: it only asks for the place of the next."""
    digest: bytes
    secret: bytes
    public: bytes
    """The server's end of the agreement."""
    is_stale: bool
    """It has not the place that is next, so it may be a replay: nobody looks at it, and who sent it may ask again."""


class NullVehicleAuthenticator:
    """The vehicle's end where nothing is signed: everything is taken to be authentic."""

    counts: Mapping[str, int] = {}

    def body(self, data: bytes) -> bytes:
        """Give the command in an envelope, unchecked."""
        return data

    def is_from_active_operator(self, _data: bytes) -> bool:
        """Tell whether a command comes from who holds the vehicle: nobody knows."""
        return True

    def is_next_of_active_operator(self, _channel: str, _data: bytes) -> bool:
        """Tell whether a query is the next of who holds the vehicle: nobody knows."""
        return False

    def open_command(self, data: bytes) -> bytes | None:
        """Give the command in an envelope."""
        return data

    def open_request(self, channel: str, data: bytes) -> VerifiedRequest | None:
        """Give the query in an envelope."""
        return VerifiedRequest(channel, "", data, b"", b"", b"", is_stale=False)

    def sign_state(self, body: bytes) -> bytes:
        """Give the state as it is."""
        return body

    def sign_reply(self, _request: VerifiedRequest, body: bytes) -> bytes:
        """Give the reply as it is."""
        return body


class VehicleAuthenticator(NullVehicleAuthenticator):
    """The vehicle's end: `operators` are the names and keys of who may drive."""

    def __init__(self, vehicle: str, key: PrivateKey, operators: Mapping[str, PublicKey]) -> None:
        self.counts = self._counts = Counter[str]()
        self._vehicle = vehicle
        self._key = key
        self._operators = dict(operators)
        self._instance = secrets.token_bytes(8)
        self._states = 0
        self._requested: Counter[tuple[str, str]] = Counter()
        """By channel and operator: how many requests were taken."""
        self._agreements: dict[bytes, tuple[bytes, bytes]] = {}
        """By the client's public key: the secret, and the public key of this end."""
        self._active_operator = ""
        self._codes = _SessionMacs()

    # What comes in.

    def body(self, data: bytes) -> bytes:
        """Give the command in an envelope, unchecked."""
        return _signed(data)

    def is_from_active_operator(self, data: bytes) -> bool:
        """Tell by its code, which is cheap, whether a command comes from who holds the vehicle."""
        return self._codes.fit("control", data)

    def is_next_of_active_operator(self, channel: str, data: bytes) -> bool:
        """Tell by place and code, which is cheap, whether a query is the next of who holds the vehicle."""
        return data.startswith(self._place(channel, self._active_operator)) and self._codes.fit(channel, data)

    def open_command(self, data: bytes) -> bytes | None:
        """Give the command in an envelope that the holder has signed; of other operators only an emergency stop."""
        body, signature = _signed(data), data[-SIGNATURE_BYTES:]
        said = _context("control", self._vehicle) + body
        active_operator = self._operators.get(self._active_operator)
        if active_operator is not None and active_operator.verifies(signature, said):
            return body
        if self._asks_for_emergency_stop(body) and any(
            key.verifies(signature, said) for name, key in self._operators.items() if name != self._active_operator
        ):
            return body
        self._counts["commands_forged"] += 1
        return None

    def _asks_for_emergency_stop(self, body: bytes) -> bool:
        try:
            return decode(Command, body).emergency_stop != 0
        except BadMessage:
            return False

    def open_request(self, channel: str, data: bytes) -> VerifiedRequest | None:
        """Give the query in an envelope that one of the operators has signed in his own name; None for any other."""
        signed, signature = _signed(data), data[-SIGNATURE_BYTES:]
        at = PLACE_BYTES + PUBLIC_KEY_BYTES + _WHO_BYTES
        place, public = signed[:PLACE_BYTES], signed[PLACE_BYTES : at - _WHO_BYTES]
        who, body = signed[at - _WHO_BYTES : at].rstrip(b"\0").decode("ascii", "replace"), signed[at:]
        key = self._operators.get(who)
        if key is None or not key.verifies(signature, _context(channel, self._vehicle) + signed):
            self._counts[f"{channel}_requests_forged"] += 1
            return None
        agreed = self._agree(public)
        if agreed is None or not self._is_own(channel, who, body):
            self._counts[f"{channel}_requests_forged"] += 1
            return None
        next_in_place = place == self._place(channel, who)
        self._requested[channel, who] += next_in_place
        # An emergency stop has a number of its own, and no time to ask twice.
        stale = body == b"" or not (next_in_place or _is_emergency_stop(channel, body))
        self._counts[f"{channel}_requests_of_another_time"] += stale and body != b""
        return VerifiedRequest(channel, who, body, _digest(data), *agreed, stale)

    def _is_own(self, channel: str, who: str, body: bytes) -> bool:
        """Whether a request is in the name of who has signed it; an empty one only asks for the place."""
        kind: Any = REQUESTS[channel]
        try:
            return body == b"" or bool(decode(kind, body).who == who)
        except BadMessage:
            return False

    def _place(self, channel: str, who: str) -> bytes:
        return self._instance + self._requested[channel, who].to_bytes(8, "big")

    def _agree(self, public: bytes) -> tuple[bytes, bytes] | None:
        """Agree on a secret with whoever has this public key: the secret and the public key of this end."""
        if public not in self._agreements:
            agreement = KeyAgreement()
            secret = agreement.secret(public, _context("secret", self._vehicle) + public + agreement.public)
            if secret is None:
                return None
            self._agreements[public] = secret, agreement.public
            if len(self._agreements) > KEPT:
                self._agreements.pop(next(iter(self._agreements)))
        return self._agreements[public]

    # What goes out.

    def sign_state(self, body: bytes) -> bytes:
        """Sign a state, and number it."""
        self._states += 1
        signed = self._instance + self._states.to_bytes(8, "big") + body
        return signed + self._codes.of("state", signed) + self._key.sign(_context("state", self._vehicle) + signed)

    def sign_reply(self, request: VerifiedRequest, body: bytes) -> bytes:
        """Sign the reply to `request`, encrypted for who asked; of a stale one `body` is empty."""
        if not request.is_stale:
            self._note_session(request, body)
        place = self._place(request.channel, request.who)
        encrypted = encrypt(request.secret, body, request.digest)
        signed = request.digest + (_AGAIN if request.is_stale else _HERE) + place + request.public + encrypted
        return signed + self._key.sign(_context(f"{request.channel} reply", self._vehicle) + signed)

    def _note_session(self, request: VerifiedRequest, body: bytes) -> None:
        """Follow who holds the vehicle: whose commands are admitted, and by which codes."""
        if request.channel != "session":
            return
        reply, operation = decode(SessionReply, body), decode(SessionRequest, request.body).operation
        if reply.granted and operation == "release":
            self._active_operator, self._codes = "", _SessionMacs()
        elif reply.granted and reply.token:
            self._active_operator, self._codes = request.who, _SessionMacs(reply.token)


@value
class VerifiedReply:
    """What a reply says: a `body`, or that the request must be sent `again`, in these bytes; or neither."""

    body: bytes | None
    again: bytes | None


@value
class VerifiedState:
    """A state, or None where it is not to be shown."""

    body: bytes | None
    ask: bool
    """It is the vehicle's, and may be old: of a server's process that has not answered a request yet. So ask it."""


class OperatorAuthenticator:
    """The operator's end; `vehicle_key` is the vehicle's."""

    def __init__(self, vehicle: str, who: str, key: PrivateKey, vehicle_key: PublicKey) -> None:
        self.counts: Counter[str] = Counter()
        self._vehicle = vehicle
        self._who = who.encode().ljust(_WHO_BYTES, b"\0")
        self._key = key
        self._vehicle_key = vehicle_key
        self._agreement = KeyAgreement()
        self._places: dict[str, bytes] = dict.fromkeys(REQUESTS, bytes(PLACE_BYTES))
        self._requested: dict[bytes, tuple[str, bytes]] = {}
        """By digest: the channel and the body of requests that wait for a reply."""
        self._codes = _SessionMacs()
        self._newest_state = bytes(PLACE_BYTES)

    # What goes out.

    def sign_command(self, body: bytes) -> bytes:
        """Sign a command."""
        return body + self._codes.of("control", body) + self._key.sign(_context("control", self._vehicle) + body)

    def sign_request(self, channel: str, body: bytes) -> bytes:
        """Sign a query; an empty one only asks for the place of the next."""
        signed = self._places[channel] + self._agreement.public + self._who + body
        data = signed + self._codes.of(channel, signed) + self._key.sign(_context(channel, self._vehicle) + signed)
        self._requested[_digest(data)] = channel, body
        if len(self._requested) > KEPT:
            self._requested.pop(next(iter(self._requested)))
        return data

    # What comes in.

    def open_reply(self, channel: str, data: bytes) -> VerifiedReply:
        """Give the answer of the vehicle to a request of ours; each is taken once."""
        digest, reason = data[:DIGEST_BYTES], data[DIGEST_BYTES : DIGEST_BYTES + 1]
        at = DIGEST_BYTES + 1
        place, public = data[at : at + PLACE_BYTES], data[at + PLACE_BYTES : at + PLACE_BYTES + PUBLIC_KEY_BYTES]
        signed, signature = data[:-SIGNATURE_BYTES], data[-SIGNATURE_BYTES:]
        requested = self._requested.get(digest)
        said = _context(f"{channel} reply", self._vehicle) + signed
        if (
            requested is None
            or requested[0] != channel
            or len(data) > LONGEST_BYTES
            or not self._vehicle_key.verifies(signature, said)
        ):
            return self._forged(f"{channel}_replies_forged")
        own = self._agreement.public
        secret = self._agreement.secret(public, _context("secret", self._vehicle) + own + public)
        encrypted = signed[at + PLACE_BYTES + PUBLIC_KEY_BYTES :]
        body = None if secret is None else decrypt(secret, encrypted, digest)
        if body is None:
            return self._forged(f"{channel}_replies_forged")
        self._forget(channel, digest)
        self._note_place(channel, place)
        if reason == _AGAIN:
            return VerifiedReply(None, self.sign_request(channel, requested[1]) if requested[1] else None)
        if channel == "session":
            self._note_session(body)
        return VerifiedReply(body, None)

    def _forget(self, channel: str, answered: bytes) -> None:
        """Take no reply any more to a request, nor to those of its kind from before it: what they say is older."""
        for digest in list(self._requested):
            if self._requested[digest][0] == channel:
                del self._requested[digest]
            if digest == answered:
                return

    def _forged(self, name: str) -> VerifiedReply:
        self.counts[name] += 1
        return VerifiedReply(None, None)

    def _note_place(self, channel: str, place: bytes) -> None:
        self._places[channel] = place
        if place[:8] != self._newest_state[:8]:  # another process of the server: its states are counted anew
            self._newest_state = place[:8] + bytes(8)

    def _note_session(self, body: bytes) -> None:
        try:
            reply = decode(SessionReply, body)
        except BadMessage:
            return
        if reply.granted and reply.token:
            self._codes = _SessionMacs(reply.token)

    def is_next_state(self, data: bytes) -> bool:
        """Tell by number and code, which is cheap, whether a state is a newer one for who holds the vehicle."""
        return data[:PLACE_BYTES] > self._newest_state and self._codes.fit("state", data)

    def open_state(self, data: bytes) -> VerifiedState:
        """Give a state that the vehicle has signed, newer than any before."""
        signed, signature = _signed(data), data[-SIGNATURE_BYTES:]
        place = signed[:PLACE_BYTES]
        known = place[:8] == self._newest_state[:8]
        if known and place <= self._newest_state:
            self.counts["states_replayed"] += 1
            return VerifiedState(None, ask=False)
        if not self._vehicle_key.verifies(signature, _context("state", self._vehicle) + signed):
            self.counts["states_forged"] += 1
            return VerifiedState(None, ask=False)
        if not known:
            self.counts["states_of_another_time"] += 1
            return VerifiedState(None, ask=True)
        self._newest_state = place
        return VerifiedState(signed[PLACE_BYTES:], ask=False)


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()[:DIGEST_BYTES]


def _is_emergency_stop(channel: str, body: bytes) -> bool:
    return channel == "session" and body != b"" and decode(SessionRequest, body).operation == "emergency_stop"
