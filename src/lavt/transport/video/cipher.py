"""Encryption of the video's packets: none, or SRTP with keys that are used for one path only.

The keys are derived from the session token and from the challenge that opened the path. So each time the path is
opened, each direction gets a new key, and a packet index that starts at 0. The token is secret only if messages are
signed.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from typing import Final, Literal, Protocol

from lavt.transport.rtp.srtp import KEY_BYTES, Protector, Unprotector

End = Literal["server", "client"]

_LABELS: Final = {"server": b"LAVT 1 SRTP server to client", "client": b"LAVT 1 SRTP client to server"}


class Cipher(Protocol):
    """The encryption of an open path in both directions, at one end."""

    def protect(self, packet: bytes) -> bytes:
        """Return the datagram to send for an RTP packet."""
        ...

    def protect_rtcp(self, packet: bytes) -> bytes:
        """Return the datagram to send for an RTCP packet."""
        ...

    def unprotect(self, packet: bytes) -> bytes | None:
        """Return the RTP packet of a received datagram, or None if it is not from the other end."""
        ...

    def unprotect_rtcp(self, packet: bytes) -> bytes | None:
        """Return the RTCP packet of a received datagram, or None if it is not from the other end."""
        ...


NewCipher = Callable[[bytes, bytes], Cipher]
"""Makes a cipher from the token and the challenge."""


class NoCipher:
    """A cipher that leaves every packet unchanged."""

    def protect(self, packet: bytes) -> bytes:
        """Return the packet."""
        return packet

    protect_rtcp = unprotect = unprotect_rtcp = protect


class SrtpCipher:
    """SRTP and SRTCP (RFC 3711, AES-GCM of RFC 7714)."""

    def __init__(self, end: End, token: bytes, challenge: bytes) -> None:
        other: End = "client" if end == "server" else "server"
        protector = Protector(_derive_key(end, token, challenge))
        unprotector = Unprotector(_derive_key(other, token, challenge))
        self.protect, self.protect_rtcp = protector.protect, protector.protect_rtcp
        self.unprotect, self.unprotect_rtcp = unprotector.unprotect, unprotector.unprotect_rtcp


def plain_cipher(_token: bytes, _challenge: bytes) -> Cipher:
    """Return the cipher of a path without encryption."""
    return NoCipher()


def _derive_key(sender: End, token: bytes, challenge: bytes) -> bytes:
    """Derive the key of one direction.

    The token is random, so HKDF's first step (extraction) is not needed, and its second step (expansion) is one
    HMAC-SHA256 (RFC 5869, section 3.3).
    """
    return hmac.digest(token, _LABELS[sender] + challenge, "sha256")[:KEY_BYTES]
