"""SRTP and SRTCP (RFC 3711, AES-GCM of RFC 7714): encryption and authentication of the video's packets.

This is the only module that imports pylibsrtp (libsrtp), of the extra `secure`. The profile is AEAD_AES_128_GCM: an RTP
packet becomes 16 bytes longer, an RTCP packet 20. The SSRC is part of the initialisation vector, and media and repair
packets have different SSRCs, so they can share one key. Each session and each direction needs a fresh key: two packets
encrypted with the same key and vector would break GCM.

The packet index has 48 bits, of which a packet carries 16; both ends count the rest, from 0 under a new key. So under a
new key a stream should start at a sequence number below 2^15 (RFC 3711, 3.3.1). If it starts at 65535, a receiver that
misses the first packet accepts no later packet. A receiver that misses 2^15 consecutive packets needs a new key.

A packet of 1200 bytes takes 2.5 us to protect, 2.5 us to unprotect, and 2.5 us to reject if a bit is wrong (medians of
7 times 20 000 consecutive packets; Python 3.11, pylibsrtp 1.0.0, one core of a virtual machine).
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, Final

from lavt.errors import UserError, WorkError

KEY_BYTES: Final = 28
"""The master key, 16 bytes, then the master salt, 12 bytes."""
MAX_PACKET_BYTES: Final = 1352
"""Longest packet to protect: with everything that libsrtp can add, it fits into pylibsrtp's buffer of 1500 bytes."""
WINDOW_PACKETS: Final = 4096
"""Replay window: a packet that is fewer than this many packets behind the newest of its SSRC is accepted. At 50 Mb/s in
packets of 460 bytes or more, the window covers at least 0.3 s."""


class Protector:
    """An encryptor and authenticator of sent packets under the key of one session and direction; for one thread."""

    def __init__(self, key_and_salt: bytes) -> None:
        library = _import_pylibsrtp()
        self._error = library.Error
        self._session = _new_session(library, key_and_salt, library.Policy.SSRC_ANY_OUTBOUND)

    def protect(self, packet: bytes) -> bytes:
        """Return the SRTP packet of an RTP packet, 16 bytes longer.

        Each packet of an SSRC is protected once, in the order of the sequence numbers. Raises `UserError` for a packet
        longer than `MAX_PACKET_BYTES`. Raises `WorkError` for bytes that are not an RTP packet, and for an index that
        was used before: two texts encrypted under one index would allow an attacker to forge packets.
        """
        return self._protect(self._session.protect, packet)

    def protect_rtcp(self, packet: bytes) -> bytes:
        """Return the SRTCP packet of a compound RTCP packet, 20 bytes longer; errors as of `protect`."""
        return self._protect(self._session.protect_rtcp, packet)

    def _protect(self, protect: Callable[[bytes], bytes], packet: bytes) -> bytes:
        if len(packet) > MAX_PACKET_BYTES:
            raise UserError(
                f"SRTP takes packets of up to {MAX_PACKET_BYTES} bytes, not {len(packet)}: send smaller packets"
            )
        try:
            return protect(packet)
        except self._error as error:
            raise WorkError(f"a packet cannot be encrypted: {error}") from error


class Unprotector:
    """A verifier and decryptor of received packets, of any SSRC under the key; for one thread.

    `replayed` counts packets whose index was received before or is `WINDOW_PACKETS` or more behind the newest. libsrtp
    checks the index first, so forgeries with an old index are counted there, too. `rejected` counts all other packets
    that are not authentic.
    """

    def __init__(self, key_and_salt: bytes) -> None:
        self._library = _import_pylibsrtp()
        self._session = _new_session(self._library, key_and_salt, self._library.Policy.SSRC_ANY_INBOUND)
        self._replays = frozenset(text for text in self._library.ERRORS if text.startswith("replay check failed"))
        self.rejected = 0
        self.replayed = 0

    def unprotect(self, packet: bytes) -> bytes | None:
        """Return the RTP packet of an SRTP packet, or None if it is not authentic or was received before."""
        return self._unprotect(self._session.unprotect, packet)

    def unprotect_rtcp(self, packet: bytes) -> bytes | None:
        """Return the RTCP packet of an SRTCP packet, or None as `unprotect` does."""
        return self._unprotect(self._session.unprotect_rtcp, packet)

    def _unprotect(self, unprotect: Callable[[bytes], bytes], packet: bytes) -> bytes | None:
        try:
            return unprotect(packet)
        except self._library.Error as error:
            if str(error) in self._replays:
                self.replayed += 1
            else:
                self.rejected += 1
        except ValueError:  # longer than any protected packet
            self.rejected += 1
        return None


def check_srtp() -> None:
    """Raise `UserError` if pylibsrtp is not installed."""
    _import_pylibsrtp()


def _import_pylibsrtp() -> Any:
    try:
        return import_module("pylibsrtp")  # an extra
    except ImportError as error:
        raise UserError(f"encryption needs pylibsrtp ({error}): pip install -e '.[secure]' in the clone") from error


def _new_session(library: Any, key_and_salt: bytes, direction: int) -> Any:
    if len(key_and_salt) != KEY_BYTES:
        raise UserError(f"an SRTP key with its salt has {KEY_BYTES} bytes, not {len(key_and_salt)}: give all of them")
    profile = library.Policy.SRTP_PROFILE_AEAD_AES_128_GCM
    policy = library.Policy(key=key_and_salt, ssrc_type=direction, srtp_profile=profile)
    policy.window_size = WINDOW_PACKETS
    return library.Session(policy)
