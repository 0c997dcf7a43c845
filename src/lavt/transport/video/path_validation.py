"""Address validation of the video path: the client opens the path from behind any NAT before a frame is sent.

The session reply, over Zenoh, gives the client a token. Then, between the client's video socket and the server's:

    client -> server   hello      MAC(token, "hello")
    server -> client   challenge  issued_ns, cookie, MAC(token, "challenge", issued_ns, cookie) cut to 8 bytes
    client -> server   answer     issued_ns, cookie, MAC(token, "answer", issued_ns, cookie)

MAC is HMAC-SHA256 under the token. The cookie is an address-validation cookie (compare RFC 9000, section 8.1):
HMAC-SHA256, cut to 16 bytes, over the time and the address *from which the server received the hello*, under a secret
that never leaves the server and changes with each token. Behind a NAT or a relay the client cannot know that address,
so it returns the cookie, and the server accepts the cookie only from that address. The server keeps no state for a
hello, however many arrive.

* Aiming the video at a third party: its address must answer a challenge that was sent only there, even if the attacker
  has the token.
* Redirecting the video by a forged hello or answer: needs the token. A hello opens or moves no path, and one without a
  valid MAC gets no reply. No reply is longer than the datagram it replies to.
* Redirecting it by replay: an answer is valid only from the address in its cookie, within 2 s, and if its challenge is
  newer than the one that opened the path. A restart or a new token invalidates all older cookies.
* Making the client accept another path: a challenge is valid only with its MAC, and if it is newer than all before.
* Not covered without encryption: an attacker who reads, sends and drops datagrams on the path can do so with the video.

If the video is encrypted, its keys are derived from the token and the challenge that opened the path, so each opening
has its own. The client cannot know whether its answer arrives, so it keeps the keys of its last few answers.

These datagrams begin with b"LAVT"; the first byte tells them from RTP and RTCP, whose version there is 2.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.transport.video.cipher import Cipher, NewCipher, NoCipher, plain_cipher

Address = tuple[str, int]

TOKEN_BYTES: Final = 16
HELLO_INTERVAL_NS: Final = 500 * NS_PER_MS
"""Period of hellos until the first video arrives, which takes a while under delay."""
HELLO_AGAIN_NS: Final = 150 * NS_PER_MS
"""Time without video, after it had arrived, until the next hello. It is half of a vehicle's command timeout: a client
whose address changes has its video back before the vehicle is stopped."""
CHALLENGE_LIFETIME_NS: Final = 2 * NS_PER_S
REPORT_TIMEOUT_NS: Final = 2 * NS_PER_S

_MAGIC: Final = b"LAVT"
_VERSION: Final = 2
_HELLO: Final = _MAGIC + bytes([1, _VERSION])
_CHALLENGE: Final = _MAGIC + bytes([2, _VERSION])
_ANSWER: Final = _MAGIC + bytes([3, _VERSION])
_TIME_BYTES: Final = 8
_COOKIE_BYTES: Final = 16
_MAC_BYTES: Final = 32
_CHALLENGE_MAC_BYTES: Final = 8
_MAX_CIPHERS: Final = 16
"""Two seconds of hellos: after that the server accepts no answer to them."""


def is_path_datagram(datagram: bytes) -> bool:
    """Return whether a datagram on the video's port belongs to the path validation."""
    return datagram.startswith(_MAGIC)


class PathClient:
    """The client's end of the path: it requests the video with the `token` (16 bytes) of its session.

    Raises `UserError` for a token of another length.
    """

    def __init__(self, token: bytes, new_cipher: NewCipher = plain_cipher) -> None:
        _check_token(token)
        self._token = token
        self._new_cipher = new_cipher
        self._ciphers = [new_cipher(token, b"")]
        """The current cipher first, then those that the server may use instead."""
        self._answered_ns: int | None = None
        self._interval_ns = HELLO_INTERVAL_NS
        self._next_hello_ns = 0

    def hello(self, now_ns: int) -> bytes:
        """Return the datagram that requests a challenge, to be sent to the server at `now_ns`."""
        self._next_hello_ns = now_ns + self._interval_ns
        return _HELLO + _mac(self._token, _HELLO)

    def answer(self, challenge_datagram: bytes) -> bytes | None:
        """Return the answer to a challenge, or None if the challenge is not from the server or is old."""
        body, mac = challenge_datagram[:-_CHALLENGE_MAC_BYTES], challenge_datagram[-_CHALLENGE_MAC_BYTES:]
        if len(body) != len(_CHALLENGE) + _TIME_BYTES + _COOKIE_BYTES or not body.startswith(_CHALLENGE):
            return None
        if not hmac.compare_digest(mac, _mac(self._token, body)[:_CHALLENGE_MAC_BYTES]):
            return None
        challenge = body[len(_CHALLENGE) :]
        issued_ns = int.from_bytes(challenge[:_TIME_BYTES], "big", signed=True)
        if self._answered_ns is not None and issued_ns <= self._answered_ns:
            return None
        self._answered_ns = issued_ns
        self._ciphers = [self._new_cipher(self._token, challenge), *self._ciphers[: _MAX_CIPHERS - 1]]
        answer = _ANSWER + challenge
        return answer + _mac(self._token, answer)

    def unprotect(self, packet: bytes) -> bytes | None:
        """Return the RTP packet of a received datagram, or None if it is not from the server."""
        return self._try_ciphers(lambda cipher: cipher.unprotect(packet))

    def unprotect_rtcp(self, packet: bytes) -> bytes | None:
        """Return the RTCP packet of a received datagram, or None if it is not from the server."""
        return self._try_ciphers(lambda cipher: cipher.unprotect_rtcp(packet))

    def _try_ciphers(self, unprotect: Callable[[Cipher], bytes | None]) -> bytes | None:
        for cipher in self._ciphers:
            packet = unprotect(cipher)
            if packet is not None:
                if cipher is not self._ciphers[0]:
                    self._ciphers = [cipher, *(each for each in self._ciphers if each is not cipher)]
                return packet
        return None

    def protect_rtcp(self, packet: bytes) -> bytes:
        """Return the datagram to send for an RTCP packet."""
        return self._ciphers[0].protect_rtcp(packet)

    def video_arrived(self, now_ns: int) -> None:
        """Postpone the next hello, since video arrived over the path."""
        self._interval_ns = HELLO_AGAIN_NS
        self._next_hello_ns = now_ns + HELLO_AGAIN_NS

    def next_hello_ns(self) -> int:
        """Return when the next hello is due: first at 0, then 500 ms after a hello.

        Once video has arrived, it is 150 ms after the last video or hello.
        """
        return self._next_hello_ns


class PathServer:
    """The server's end of the path: it validates the address to which the video is sent, and makes its `cipher`.

    `new_secret` returns 16 or more unpredictable bytes at each call. All times are of the server's monotonic clock.
    Public counters, in datagrams: `malformed` have another format, `wrong_token` have no valid MAC, `wrong_address`
    answer a challenge that this server did not send to that address, `stale` arrive too late or a second time,
    `foreign_reports` are reports from an address to which no path is open.
    """

    def __init__(self, new_secret: Callable[[], bytes], new_cipher: NewCipher = plain_cipher) -> None:
        self.malformed = 0
        self.wrong_token = 0
        self.wrong_address = 0
        self.stale = 0
        self.foreign_reports = 0
        self._new_secret = new_secret
        self._new_cipher = new_cipher
        self.set_token(None)

    def set_token(self, token: bytes | None) -> None:
        """Close the path and set the token of a new session, or None for no session.

        Raises `UserError` for a token that is not 16 bytes long.
        """
        if token is not None:
            _check_token(token)
        self._token = token
        self.cipher: Cipher = NoCipher()
        self._secret = self._new_secret()
        self._address: Address | None = None
        self._opened_by_ns: int | None = None
        self._last_report_ns = 0

    def receive(self, datagram: bytes, address: Address, now_ns: int) -> bytes | None:
        """Handle a datagram from `address`; return the challenge to send there if it is a valid hello."""
        if datagram.startswith(_HELLO) and len(datagram) == len(_HELLO) + _MAC_BYTES:
            return self._challenge(address, now_ns) if self._verify_mac(datagram) else None
        if datagram.startswith(_ANSWER) and len(datagram) == len(_ANSWER) + _TIME_BYTES + _COOKIE_BYTES + _MAC_BYTES:
            if self._verify_mac(datagram):
                self._open(datagram, address, now_ns)
        else:
            self.malformed += 1
        return None

    def open_address(self, now_ns: int) -> Address | None:
        """Return the address to which the video is sent at `now_ns`; None: no path is open."""
        if self._address is not None and now_ns - self._last_report_ns > REPORT_TIMEOUT_NS:
            self._address = None
        return self._address

    def report(self, address: Address, now_ns: int) -> None:
        """Note a receiver report from `address`; from the address of the path, it keeps the path open."""
        if self.open_address(now_ns) == address:
            self._last_report_ns = now_ns
        else:
            self.foreign_reports += 1

    def accepts_rtcp_from(self, address: Address) -> bool:
        """Return whether RTCP from `address` is accepted: the path was open to it at the last check."""
        return self._address == address

    def _verify_mac(self, datagram: bytes) -> bool:
        """Return whether a datagram ends with a valid MAC under the token; count it if not."""
        body, mac = datagram[:-_MAC_BYTES], datagram[-_MAC_BYTES:]
        if self._token is not None and hmac.compare_digest(mac, _mac(self._token, body)):
            return True
        self.wrong_token += 1
        return False

    def _challenge(self, address: Address, now_ns: int) -> bytes:
        """Return the challenge for `address`."""
        issued = now_ns.to_bytes(_TIME_BYTES, "big", signed=True)
        body = _CHALLENGE + issued + self._cookie(issued, address)
        return body + _mac(self._token or b"", body)[:_CHALLENGE_MAC_BYTES]

    def _open(self, answer: bytes, address: Address, now_ns: int) -> None:
        """Open the path to `address` if `answer`, whose MAC is valid, answers a recent challenge sent to it."""
        issued = answer[len(_ANSWER) : len(_ANSWER) + _TIME_BYTES]
        cookie = answer[len(_ANSWER) + _TIME_BYTES : -_MAC_BYTES]
        if not hmac.compare_digest(cookie, self._cookie(issued, address)):
            self.wrong_address += 1
            return
        issued_ns = int.from_bytes(issued, "big", signed=True)
        used = self._opened_by_ns is not None and issued_ns <= self._opened_by_ns
        if used or now_ns - issued_ns > CHALLENGE_LIFETIME_NS:
            self.stale += 1
            return
        self._address = address
        self.cipher = self._new_cipher(self._token or b"", answer[len(_ANSWER) : -_MAC_BYTES])
        self._opened_by_ns = issued_ns
        self._last_report_ns = now_ns

    def _cookie(self, issued: bytes, address: Address) -> bytes:
        """Return the cookie that binds a challenge to its time and to the address it is sent to."""
        host, port = address
        signed = issued + port.to_bytes(2, "big") + host.encode()
        return hmac.digest(self._secret, signed, "sha256")[:_COOKIE_BYTES]


def _mac(token: bytes, body: bytes) -> bytes:
    """Return the MAC of `body` under `token`; `body` begins with its kind, so that no MAC is valid for another kind."""
    return hmac.digest(token, body, "sha256")


def _check_token(token: bytes) -> None:
    """Raise `UserError` for a token of a wrong length."""
    if len(token) != TOKEN_BYTES:
        raise UserError(f"a video token has {TOKEN_BYTES} bytes, not {len(token)}: use the token of the session reply")
