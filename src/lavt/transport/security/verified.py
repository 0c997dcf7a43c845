"""The results of verifying envelopes."""

from __future__ import annotations

from msgspec import Struct


class VerifiedRequest(Struct, frozen=True):
    """A request with a valid signature, and the data that its reply needs."""

    channel: str
    operator: str
    body: bytes
    """The request itself; empty: it requests only the next replay counter."""
    digest: bytes
    """Digest of the request's envelope, which the reply repeats."""
    secret: bytes
    """The secret shared with the client, with which the reply is encrypted."""
    public: bytes
    """The server's public key of the agreement on the secret."""
    must_retry: bool
    """The body is ignored, and the reply demands the request again, with the replay counter in that reply. The request
    had a wrong counter, so it could be a replay, or it was empty."""


class VerifiedReply(Struct, frozen=True):
    """The result of verifying a reply: its body, or the envelope of the request to send again, or neither."""

    body: bytes | None
    repeated_request: bytes | None


class VerifiedState(Struct, frozen=True):
    """The result of verifying a state; `body` is None if the state must be dropped."""

    body: bytes | None
    client_must_request: bool
    """Whether the client must send a request: the server's process that signed the state has not answered a request of
    this client yet, so the state could be a replay."""
