"""Address validation of the video path: the client opens the path from behind any NAT before a frame is sent.

The session reply, over Zenoh, gives the client a token. Then, between the client's video socket and the server's:

    client -> server   hello      number, MAC
    server -> client   challenge  number, issued_ns, cookie, MAC cut to 8 bytes
    client -> server   answer     number, issued_ns, cookie, MAC

The number counts the client's hellos; challenge and answer repeat it. MAC is HMAC-SHA256 under the token over all bytes
before it. The cookie is an address-validation cookie (compare RFC 9000, section 8.1): HMAC-SHA256, cut to 16 bytes,
over number, time and the address *from which the server received the hello*, under a secret that never leaves the
server and changes with each token. Behind a NAT or a relay the client cannot know that address, so it returns the
cookie, and the server accepts the cookie only from that address. However many hellos arrive,
the server stores only the highest number and the first four addresses from which the hello with this number came.

These are the possible attacks, and why they fail:

* Aiming the video at a third party: the third party's address must answer a challenge that was sent only there. Even an
  attacker who has the token cannot answer it.
* Redirecting the video by a forged hello or answer: the attacker needs the token. A hello alone neither opens nor
  moves a path: only the answer does. A hello without a valid MAC gets no reply. No reply is longer than the datagram
  that caused it.
* Replaying a hello: a hello with a lower number than the highest gets no challenge. Copies of the newest hello from
  different addresses get up to four challenges, so a copy that arrives first does not prevent the challenge to the
  client. The client answers only the first challenge to each of its hellos.
* Replaying an answer: an answer is valid only from the address in its cookie, for 2 s, and if its challenge is newer
  than the challenge that opened the path. A restart or a new token invalidates all older cookies.
* Forcing either end to change its keys: the server does not change the key of a path that is already open to the
  answer's address, and the client never drops the key in use.
* Not covered: an attacker who reads each hello and whose copy overtakes it can delay the opening of a path, and can
  make the path lead through the attacker's own address. An attacker who can drop datagrams can drop the video as well.

If the video is encrypted, its keys are derived from the token and the challenge that opened the path, so each opening
of the path has its own keys. The client cannot know whether an answer arrives, so it keeps the keys of its last few
answers.

These datagrams begin with b"LAVT". The first byte distinguishes them from RTP and RTCP: its two highest bits are not
the version 2.
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
"""Period of hellos until the first video arrives; under delay this takes a while."""
HELLO_AGAIN_NS: Final = 150 * NS_PER_MS
"""Once video has arrived: time without video until the next hello. It is half of the time after which a vehicle becomes
degraded: a client whose address changes has its video back before the vehicle is stopped."""
CHALLENGE_LIFETIME_NS: Final = 2 * NS_PER_S
"""A challenge must be answered within this time."""
REPORT_TIMEOUT_NS: Final = 2 * NS_PER_S
"""The path closes if no receiver report arrives from its address for longer than this."""

_MAGIC: Final = b"LAVT"
_VERSION: Final = 3
_HELLO: Final = _MAGIC + bytes([1, _VERSION])
_CHALLENGE: Final = _MAGIC + bytes([2, _VERSION])
_ANSWER: Final = _MAGIC + bytes([3, _VERSION])
_HEAD_BYTES: Final = len(_HELLO)
_NUMBER: Final = slice(_HEAD_BYTES, _HEAD_BYTES + 8)
_ISSUED: Final = slice(_NUMBER.stop, _NUMBER.stop + 8)
_COOKIE: Final = slice(_ISSUED.stop, _ISSUED.stop + 16)
_REPEATED: Final = slice(_NUMBER.start, _COOKIE.stop)
"""The parts of a challenge that its answer repeats."""
_MAC_BYTES: Final = 32
_CHALLENGE_MAC_BYTES: Final = 8
_CHALLENGE_BYTES: Final = _COOKIE.stop + _CHALLENGE_MAC_BYTES
_CLIENT_SIZES: Final = {_HELLO: _NUMBER.stop + _MAC_BYTES, _ANSWER: _COOKIE.stop + _MAC_BYTES}
"""Sizes in bytes of the datagrams that a client sends, by their head."""
_MAX_CHALLENGES: Final = 4
"""Largest number of challenges to copies of one hello from different addresses. It is low, because each copy can have a
false address."""
_MAX_CIPHERS: Final = 16
"""Number of ciphers that a client keeps. It is more than the number of hellos in two seconds, and after two seconds the
server accepts no answer."""


def is_path_datagram(datagram: bytes) -> bool:
    """Return whether a datagram on the video's port belongs to the path validation."""
    return datagram.startswith(_MAGIC)


def client_datagram_number(datagram: bytes) -> int | None:
    """Return the number of a hello or an answer, whose MAC is not checked; None for any other datagram."""
    if _CLIENT_SIZES.get(datagram[:_HEAD_BYTES]) != len(datagram):
        return None
    return int.from_bytes(datagram[_NUMBER], "big")


class PathClient:
    """The client's end of the path: it requests the video with the `token` (16 bytes) of its session.

    Raises `UserError` for a token of another length.
    """

    def __init__(self, token: bytes, new_cipher: NewCipher = plain_cipher) -> None:
        _check_token(token)
        self._token = token
        self._new_cipher = new_cipher
        self._cipher = new_cipher(token, b"")
        """The cipher in use: the newest under which a packet has arrived."""
        self._ciphers = [self._cipher]
        """The ciphers of the last answers, newest first, and the cipher in use."""
        self._number = 0
        """Number of the last hello."""
        self._answered_number = 0
        """Number of the hello whose challenge was answered last."""
        self._interval_ns = HELLO_INTERVAL_NS
        self._next_hello_ns = 0

    def hello(self, now_ns: int) -> bytes:
        """Return the datagram that requests a challenge, to be sent to the server at `now_ns`."""
        self._next_hello_ns = now_ns + self._interval_ns
        self._number += 1
        hello = _HELLO + self._number.to_bytes(8, "big")
        return hello + _mac(self._token, hello)

    def answer(self, challenge: bytes) -> bytes | None:
        """Return the answer to a challenge; None unless it is the server's first challenge to a hello of this end."""
        body, mac = challenge[:-_CHALLENGE_MAC_BYTES], challenge[-_CHALLENGE_MAC_BYTES:]
        if len(challenge) != _CHALLENGE_BYTES or not challenge.startswith(_CHALLENGE):
            return None
        number = int.from_bytes(challenge[_NUMBER], "big")
        if not self._answered_number < number <= self._number:
            return None
        if not hmac.compare_digest(mac, _mac(self._token, body)[:_CHALLENGE_MAC_BYTES]):
            return None
        self._answered_number = number
        self._ciphers.insert(0, self._new_cipher(self._token, challenge[_REPEATED]))
        if len(self._ciphers) > _MAX_CIPHERS:
            self._ciphers.remove(next(cipher for cipher in reversed(self._ciphers) if cipher is not self._cipher))
        answer = _ANSWER + challenge[_REPEATED]
        return answer + _mac(self._token, answer)

    def unprotect(self, packet: bytes) -> bytes | None:
        """Return the RTP packet of a received datagram, or None if it is not from the server."""
        return self._try_ciphers(lambda cipher: cipher.unprotect(packet))

    def unprotect_rtcp(self, packet: bytes) -> bytes | None:
        """Return the RTCP packet of a received datagram, or None if it is not from the server."""
        return self._try_ciphers(lambda cipher: cipher.unprotect_rtcp(packet))

    def _try_ciphers(self, unprotect: Callable[[Cipher], bytes | None]) -> bytes | None:
        packet = unprotect(self._cipher)
        if packet is not None:
            return packet
        is_newer = True
        for cipher in self._ciphers:
            if cipher is self._cipher:
                is_newer = False
                continue
            packet = unprotect(cipher)
            if packet is not None:
                if is_newer:
                    self._cipher = cipher
                return packet
        return None

    def protect_rtcp(self, packet: bytes) -> bytes:
        """Return the datagram to send for an RTCP packet."""
        return self._cipher.protect_rtcp(packet)

    def video_arrived(self, now_ns: int) -> None:
        """Postpone the next hello, since video arrived over the path."""
        self._interval_ns = HELLO_AGAIN_NS
        self._next_hello_ns = now_ns + HELLO_AGAIN_NS

    def next_hello_ns(self) -> int:
        """Return when the next hello is due: the first at 0, the next 500 ms after a hello.

        Once video has arrived, a hello is due 150 ms after the last video or hello.
        """
        return self._next_hello_ns


class PathServer:
    """The server's end of the path: it validates the address to which the video is sent, and makes its `cipher`.

    `new_secret` returns 16 or more unpredictable bytes at each call. All times are of the server's monotonic clock.
    Public counters, in datagrams: `malformed` have another format, `wrong_token` have no valid MAC, `wrong_address`
    answer a challenge that this server did not send to that address, `stale` arrive too late or a second time,
    `unneeded` are answers from the address to which the path is already open, `foreign_reports` are reports from an
    address to which no path is open.
    """

    def __init__(self, new_secret: Callable[[], bytes], new_cipher: NewCipher = plain_cipher) -> None:
        self.malformed = 0
        self.wrong_token = 0
        self.wrong_address = 0
        self.stale = 0
        self.unneeded = 0
        self.foreign_reports = 0
        self._new_secret = new_secret
        self._new_cipher = new_cipher
        self.set_token(None)

    token: bytes | None
    """The token of the session; None: there is no session."""

    def set_token(self, token: bytes | None) -> None:
        """Close the path and set the token of a new session, or None for no session.

        Raises `UserError` for a token that is not 16 bytes long.
        """
        if token is not None:
            _check_token(token)
        self.token = token
        self.cipher: Cipher = NoCipher()
        self._secret = self._new_secret()
        self._address: Address | None = None
        self._hello_number = 0
        """The highest number of a hello."""
        self._challenged_addresses: set[Address] = set()
        """The addresses from which the hello with this number came."""
        self._opening_challenge_ns: int | None = None
        """When the challenge was issued whose answer opened the path."""
        self._last_report_ns = 0

    def receive(self, datagram: bytes, address: Address, now_ns: int) -> bytes | None:
        """Handle a datagram from `address`; for a valid and new hello, return the challenge to send to `address`."""
        number = client_datagram_number(datagram)
        if number is None:
            self.malformed += 1
        elif not self.is_authentic(datagram):
            self.wrong_token += 1
        elif datagram.startswith(_ANSWER):
            self._open(datagram, address, now_ns)
        elif not self._admit_hello(number, address):
            self.stale += 1
        else:
            return self._challenge(number, address, now_ns)
        return None

    def open_address(self, now_ns: int) -> Address | None:
        """Return the address to which the video is sent at `now_ns`; None: no path is open."""
        if self._address is not None and now_ns - self._last_report_ns > REPORT_TIMEOUT_NS:
            self._address = None
        return self._address

    def note_report(self, address: Address, now_ns: int) -> None:
        """Note a receiver report from `address`; a report from the address of the path keeps the path open."""
        if self.open_address(now_ns) == address:
            self._last_report_ns = now_ns
        else:
            self.foreign_reports += 1

    def accepts_rtcp_from(self, address: Address) -> bool:
        """Return whether RTCP from `address` is accepted, that is, whether the path is open to it.

        A path that has timed out counts as open until the next call of `open_address`. It is safe to call this from any
        thread.
        """
        return self._address == address

    def _admit_hello(self, number: int, address: Address) -> bool:
        """Note an authentic hello; return whether it gets a challenge."""
        if number > self._hello_number:
            self._hello_number, self._challenged_addresses = number, set()
        if (
            number < self._hello_number
            or address in self._challenged_addresses
            or len(self._challenged_addresses) == _MAX_CHALLENGES
        ):
            return False
        self._challenged_addresses.add(address)
        return True

    def is_open_to_host(self, host: str) -> bool:
        """Return whether the path is open to any port of `host`; see `accepts_rtcp_from` for time-out and threads."""
        address = self._address
        return address is not None and address[0] == host

    def is_authentic(self, datagram: bytes) -> bool:
        """Return whether a datagram ends with a valid MAC under the token; safe to call from any thread."""
        body, mac, token = datagram[:-_MAC_BYTES], datagram[-_MAC_BYTES:], self.token
        return token is not None and hmac.compare_digest(mac, _mac(token, body))

    def _challenge(self, number: int, address: Address, now_ns: int) -> bytes:
        """Return the challenge for `address`."""
        number_and_time = number.to_bytes(8, "big") + now_ns.to_bytes(8, "big", signed=True)
        body = _CHALLENGE + number_and_time + self._cookie(number_and_time, address)
        return body + _mac(self.token or b"", body)[:_CHALLENGE_MAC_BYTES]

    def _open(self, answer: bytes, address: Address, now_ns: int) -> None:
        """Open the path to `address` if `answer`, whose MAC is valid, answers a recent challenge sent to it."""
        number_and_time = answer[_NUMBER.start : _ISSUED.stop]
        if not hmac.compare_digest(answer[_COOKIE], self._cookie(number_and_time, address)):
            self.wrong_address += 1
            return
        issued_ns = int.from_bytes(answer[_ISSUED], "big", signed=True)
        is_used = self._opening_challenge_ns is not None and issued_ns <= self._opening_challenge_ns
        if is_used or now_ns - issued_ns > CHALLENGE_LIFETIME_NS:
            self.stale += 1
            return
        if self.open_address(now_ns) == address:
            self.unneeded += 1
            return
        self._address = address
        self.cipher = self._new_cipher(self.token or b"", answer[_REPEATED])
        self._opening_challenge_ns = issued_ns
        self._last_report_ns = now_ns

    def _cookie(self, number_and_time: bytes, address: Address) -> bytes:
        """Return the cookie that binds a challenge's number and time to the address to which it is sent."""
        host, port = address
        signed = number_and_time + port.to_bytes(2, "big") + host.encode()
        return hmac.digest(self._secret, signed, "sha256")[: _COOKIE.stop - _COOKIE.start]


def _mac(token: bytes, body: bytes) -> bytes:
    """Return the MAC of `body` under `token`. `body` begins with the kind of datagram, which the MAC covers, too."""
    return hmac.digest(token, body, "sha256")


def _check_token(token: bytes) -> None:
    """Raise `UserError` for a token of a wrong length."""
    if len(token) != TOKEN_BYTES:
        raise UserError(f"a video token has {TOKEN_BYTES} bytes, not {len(token)}: use the token of the session reply")
