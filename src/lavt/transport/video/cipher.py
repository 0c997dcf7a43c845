"""What happens to the video's packets on their way: nothing, or SRTP under keys of this path alone.

The keys are made of the session's token, which only the two ends know where messages are signed, and of the challenge
that opened the path: so every opening has fresh ones, for each direction its own, and counts packets from 0.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from typing import Final, Literal, Protocol

from lavt.transport.rtp.srtp import KEY_BYTES, Protector, Unprotector

End = Literal["server", "client"]

_LABELS: Final = {"server": b"LAVT 1 SRTP server to client", "client": b"LAVT 1 SRTP client to server"}


class Cipher(Protocol):
    """Both directions of an open path, as one end has them."""

    def protect(self, packet: bytes) -> bytes:
        """Make what is sent of an RTP packet."""
        ...

    def protect_control(self, packet: bytes) -> bytes:
        """Make what is sent of an RTCP packet."""
        ...

    def open(self, packet: bytes) -> bytes | None:
        """Give the RTP packet of what came; None where it is not the other end's."""
        ...

    def open_control(self, packet: bytes) -> bytes | None:
        """Give the RTCP packet of what came; None where it is not the other end's."""
        ...


NewCipher = Callable[[bytes, bytes], Cipher]
"""Of the token and the challenge."""


class NoCipher:
    """Leaves every packet as it is."""

    def protect(self, packet: bytes) -> bytes:
        """Give the packet."""
        return packet

    protect_control = open = open_control = protect


class SrtpCipher:
    """SRTP and SRTCP (RFC 3711, AES-GCM of RFC 7714)."""

    def __init__(self, end: End, token: bytes, challenge: bytes) -> None:
        other: End = "client" if end == "server" else "server"
        protector, unprotector = Protector(_key(end, token, challenge)), Unprotector(_key(other, token, challenge))
        self.protect, self.protect_control = protector.protect, protector.protect_control
        self.open, self.open_control = unprotector.unprotect, unprotector.unprotect_control


def plain_cipher(_token: bytes, _challenge: bytes) -> Cipher:
    """Make the cipher of a path where nothing is encrypted."""
    return NoCipher()


def _key(sender: End, token: bytes, challenge: bytes) -> bytes:
    """Derive the key of a direction: the token is as good as random, so one step of HMAC-SHA256 will do (RFC 5869)."""
    return hmac.digest(token, _LABELS[sender] + challenge, "sha256")[:KEY_BYTES]
