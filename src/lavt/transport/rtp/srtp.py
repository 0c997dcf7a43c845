"""SRTP and SRTCP (RFC 3711, AES-GCM of RFC 7714): what leaves on the video's port is encrypted and authentic.

The only module that knows pylibsrtp (libsrtp), of the extra `secure`. The profile is AEAD_AES_128_GCM: 16 more bytes in
an RTP packet, 20 in an RTCP packet. The SSRC is part of the initialisation vector, so media and repair packets, each
with an SSRC and sequence numbers of their own, share one key. Nothing else may: each session and each direction needs
a fresh key, or two packets would be encrypted with the same vector, which breaks GCM.

A packet's number has 48 bits, of which it carries 16; both ends count the rest, from 0 under a new key. So under a new
key a stream should go on from a sequence number below 2^15 (RFC 3711, 3.3.1): of one that begins at 65535, a receiver
that misses the first packet takes no other. And one that misses 2^15 packets in a row needs a new key.

A packet of 1200 bytes takes 2.5 us to protect, 2.5 us to unprotect, and 2.5 us to refuse where a bit is wrong (medians
of 7 times 20 000 packets one after the other; Python 3.11, pylibsrtp 1.0.0, one core of a virtual machine).
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, Final

from lavt.errors import UserError, WorkError

KEY_BYTES: Final = 28
"""16 of the master key, then 12 of the master salt."""
MAX_PACKET_BYTES: Final = 1352
"""Of a packet to protect: what libsrtp adds at most must fit into pylibsrtp's buffer of 1500 bytes beside it."""
WINDOW_PACKETS: Final = 4096
"""A packet less far behind the newest of its SSRC is still taken: 0.3 s of 50 Mb/s in packets of 460 bytes or more."""


class Protector:
    """Encrypts and signs what one end sends, under the key of one session and one direction; for one thread."""

    def __init__(self, key_and_salt: bytes) -> None:
        library = _library()
        self._error = library.Error
        self._session = _session(library, key_and_salt, library.Policy.SSRC_ANY_OUTBOUND)

    def protect(self, packet: bytes) -> bytes:
        """Make an SRTP packet of an RTP packet, 16 bytes longer.

        Each packet of an SSRC once, in the order of its sequence numbers. Raises `UserError` for one of more than
        `MAX_PACKET_BYTES`, and `WorkError` for what is no RTP packet or was protected before: two texts encrypted
        under one number would give away what is needed to forge others.
        """
        return self._protected(self._session.protect, packet)

    def protect_rtcp(self, packet: bytes) -> bytes:
        """Make an SRTCP packet of a compound RTCP packet, 20 bytes longer; errors as of `protect`."""
        return self._protected(self._session.protect_rtcp, packet)

    def _protected(self, protected: Callable[[bytes], bytes], packet: bytes) -> bytes:
        if len(packet) > MAX_PACKET_BYTES:
            raise UserError(
                f"SRTP takes packets of up to {MAX_PACKET_BYTES} bytes, not {len(packet)}: send smaller ones"
            )
        try:
            return protected(packet)
        except self._error as error:
            raise WorkError(f"a packet cannot be encrypted: {error}") from error


class Unprotector:
    """Checks and decrypts what one end receives, of any SSRC under the key; for one thread.

    `replayed` counts packets whose number was taken before or is `WINDOW_PACKETS` or more behind (libsrtp looks at the
    number first, so forgeries with an old number count here too); `rejected` the others that are not authentic.
    """

    def __init__(self, key_and_salt: bytes) -> None:
        self._library = _library()
        self._session = _session(self._library, key_and_salt, self._library.Policy.SSRC_ANY_INBOUND)
        self._replays = frozenset(text for text in self._library.ERRORS if text.startswith("replay check failed"))
        self.rejected = 0
        self.replayed = 0

    def unprotect(self, packet: bytes) -> bytes | None:
        """Give the RTP packet of an SRTP packet, or None for anything that is not authentic or came before."""
        return self._taken(self._session.unprotect, packet)

    def unprotect_rtcp(self, packet: bytes) -> bytes | None:
        """Give the RTCP packet of an SRTCP packet, or None as `unprotect` does."""
        return self._taken(self._session.unprotect_rtcp, packet)

    def _taken(self, unprotected: Callable[[bytes], bytes], packet: bytes) -> bytes | None:
        try:
            return unprotected(packet)
        except self._library.Error as error:
            if str(error) in self._replays:
                self.replayed += 1
            else:
                self.rejected += 1
        except ValueError:  # longer than anything protected can be
            self.rejected += 1
        return None


def check_srtp() -> None:
    """Raise `UserError` where pylibsrtp is missing."""
    _library()


def _library() -> Any:
    try:
        return import_module("pylibsrtp")  # an extra
    except ImportError as error:
        raise UserError(f"encrypted video needs pylibsrtp ({error}): pip install 'lavt[secure]'") from error


def _session(library: Any, key_and_salt: bytes, direction: int) -> Any:
    if len(key_and_salt) != KEY_BYTES:
        raise UserError(f"an SRTP key with its salt has {KEY_BYTES} bytes, not {len(key_and_salt)}")
    profile = library.Policy.SRTP_PROFILE_AEAD_AES_128_GCM
    policy = library.Policy(key=key_and_salt, ssrc_type=direction, srtp_profile=profile)
    policy.window_size = WINDOW_PACKETS
    return library.Session(policy)
