"""The path of the video: opened by the client from behind any NAT, and proven before a single frame takes it.

The session reply, over Zenoh, gives the client a token. Then, between the client's video socket and the server's:

    client -> server   hello      proof(token, "hello")
    server -> client   challenge  issued_ns, seal, proof(token, "challenge", issued_ns, seal) cut to 8 bytes
    client -> server   answer     issued_ns, seal, proof(token, "answer", issued_ns, seal)

proof is HMAC-SHA256 under the token. seal is HMAC-SHA256, cut to 16 bytes, over the time and the address *the server
saw the hello come from*, under a secret that never leaves the server and changes with each token. The client cannot
know that address behind a NAT or a relay, so it proves the sealed one, and the server lets the seal count only for an
answer that comes from there. The server keeps nothing for a hello, however many come.

* Aim the video at a third party: its address must answer a challenge that was sent to it and nowhere else, even when
  the attacker holds the token.
* Steal the video by a forged hello or answer: needs the token. A hello opens and moves nothing, and one without proof
  gets no reply. No reply is longer than what it replies to.
* Steal it by replay: an answer counts only from the address in its seal, within 2 s, and only when its challenge is
  newer than the one that opened the path. A restart or a new token makes all older seals worthless.
* Make the client take another path for open: a challenge counts only with its proof, and newer than any before.
* Not covered without encryption: who reads, sends and swallows datagrams on the way can do so with the video itself.

Where the video is encrypted, its keys are made of the token and of the challenge that opened the path: each opening has
its own. So the client, which cannot know whether its answer arrives, keeps those of its last few answers.

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
"""Until the first video comes, which under delay takes a while."""
HELLO_AGAIN_NS: Final = 150 * NS_PER_MS
"""Without video, once it came. Half of what a vehicle waits for commands: a client whose address changes has its video
back before the vehicle is stopped."""
CHALLENGE_LIFETIME_NS: Final = 2 * NS_PER_S
REPORT_TIMEOUT_NS: Final = 2 * NS_PER_S

_MAGIC: Final = b"LAVT"
_VERSION: Final = 2
_HELLO: Final = _MAGIC + bytes([1, _VERSION])
_CHALLENGE: Final = _MAGIC + bytes([2, _VERSION])
_ANSWER: Final = _MAGIC + bytes([3, _VERSION])
_TIME_BYTES: Final = 8
_TAG_BYTES: Final = 16
_PROOF_BYTES: Final = 32
_CLIENT_PROOF_BYTES: Final = 8
_CIPHERS_KEPT: Final = 16
"""Two seconds of hellos: after that the server takes no answer to them."""


def is_path_datagram(datagram: bytes) -> bool:
    """Tell whether a datagram on the video's port belongs to the opening of its path."""
    return datagram.startswith(_MAGIC)


class PathClient:
    """The client's end: asks for the video with the `token` (16 bytes) of its session.

    Raises `UserError` for a token of another length.
    """

    def __init__(self, token: bytes, new_cipher: NewCipher = plain_cipher) -> None:
        _check_token(token)
        self._token = token
        self._new_cipher = new_cipher
        self._ciphers = [new_cipher(token, b"")]
        """The one that is in use first, then those that may come into use, or were; one without a challenge is none."""
        self._answered_ns: int | None = None
        self._interval_ns = HELLO_INTERVAL_NS
        self._next_hello_ns = 0

    def hello(self, now_ns: int) -> bytes:
        """Write the datagram that asks for a challenge, to be sent to the server at `now_ns`."""
        self._next_hello_ns = now_ns + self._interval_ns
        return _HELLO + _proof(self._token, _HELLO)

    def answer(self, challenge_datagram: bytes) -> bytes | None:
        """Write the answer to a challenge, to be sent to the server; None when it is none of the server's, or old."""
        said, proof = challenge_datagram[:-_CLIENT_PROOF_BYTES], challenge_datagram[-_CLIENT_PROOF_BYTES:]
        if len(said) != len(_CHALLENGE) + _TIME_BYTES + _TAG_BYTES or not said.startswith(_CHALLENGE):
            return None
        if not hmac.compare_digest(proof, _proof(self._token, said)[:_CLIENT_PROOF_BYTES]):
            return None
        challenge = said[len(_CHALLENGE) :]
        issued_ns = int.from_bytes(challenge[:_TIME_BYTES], "big", signed=True)
        if self._answered_ns is not None and issued_ns <= self._answered_ns:
            return None
        self._answered_ns = issued_ns
        self._ciphers = [self._new_cipher(self._token, challenge), *self._ciphers[: _CIPHERS_KEPT - 1]]
        answer = _ANSWER + challenge
        return answer + _proof(self._token, answer)

    def unprotect(self, packet: bytes) -> bytes | None:
        """Give the RTP packet of what came from the server; None where it is not the server's."""
        return self._first(lambda cipher: cipher.unprotect(packet))

    def unprotect_rtcp(self, packet: bytes) -> bytes | None:
        """Give the RTCP packet of what came from the server; None where it is not the server's."""
        return self._first(lambda cipher: cipher.unprotect_rtcp(packet))

    def _first(self, opened: Callable[[Cipher], bytes | None]) -> bytes | None:
        for cipher in self._ciphers:
            packet = opened(cipher)
            if packet is not None:
                if cipher is not self._ciphers[0]:
                    self._ciphers = [cipher, *(each for each in self._ciphers if each is not cipher)]
                return packet
        return None

    def protect_rtcp(self, packet: bytes) -> bytes:
        """Make what is sent of an RTCP packet."""
        return self._ciphers[0].protect_rtcp(packet)

    def video_arrived(self, now_ns: int) -> None:
        """Note that the path works: no hello is needed for a while."""
        self._interval_ns = HELLO_AGAIN_NS
        self._next_hello_ns = now_ns + HELLO_AGAIN_NS

    def next_hello_ns(self) -> int:
        """Tell when the next hello is due: at first 0, at once; then 500 ms later, or 150 ms after video or a hello."""
        return self._next_hello_ns


class PathServer:
    """The server's end: finds out where to send the video, and under which `cipher`.

    `new_secret` gives 16 or more unpredictable bytes at each call. All times are of the server's monotonic clock.
    Public counters, in datagrams: `malformed` are not ours, `wrong_token` have no valid proof, `wrong_address` answer
    a challenge that this server did not send to that address, `stale` come too late or a second time,
    `foreign_reports` are reports from where no path is open.
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
        """Take the token of a new session, or None for no session; whatever path there was is closed.

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
        """Take a datagram from `address`; return what to send back there, if anything: a challenge to a hello."""
        if datagram.startswith(_HELLO) and len(datagram) == len(_HELLO) + _PROOF_BYTES:
            return self._challenge(address, now_ns) if self._proven(datagram) else None
        if datagram.startswith(_ANSWER) and len(datagram) == len(_ANSWER) + _TIME_BYTES + _TAG_BYTES + _PROOF_BYTES:
            if self._proven(datagram):
                self._open(datagram, address, now_ns)
        else:
            self.malformed += 1
        return None

    def open_address(self, now_ns: int) -> Address | None:
        """Tell where the video goes at `now_ns`; None: nowhere."""
        if self._address is not None and now_ns - self._last_report_ns > REPORT_TIMEOUT_NS:
            self._address = None
        return self._address

    def report(self, address: Address, now_ns: int) -> None:
        """Note that a receiver report came from `address`: from where the path is open, it keeps it open."""
        if self.open_address(now_ns) == address:
            self._last_report_ns = now_ns
        else:
            self.foreign_reports += 1

    def accepts_rtcp_from(self, address: Address) -> bool:
        """Tell whether RTCP from `address` counts: the path was open to there when last looked at."""
        return self._address == address

    def _proven(self, datagram: bytes) -> bool:
        """Tell whether a datagram ends with the proof of its sender's knowing the token."""
        said, proof = datagram[:-_PROOF_BYTES], datagram[-_PROOF_BYTES:]
        if self._token is not None and hmac.compare_digest(proof, _proof(self._token, said)):
            return True
        self.wrong_token += 1
        return False

    def _challenge(self, address: Address, now_ns: int) -> bytes:
        """Write the challenge for `address`."""
        issued = now_ns.to_bytes(_TIME_BYTES, "big", signed=True)
        said = _CHALLENGE + issued + self._tag(issued, address)
        return said + _proof(self._token or b"", said)[:_CLIENT_PROOF_BYTES]

    def _open(self, answer: bytes, address: Address, now_ns: int) -> None:
        """Open the path to `address` if `answer`, whose proof is right, is to a challenge sent there just now."""
        issued = answer[len(_ANSWER) : len(_ANSWER) + _TIME_BYTES]
        tag = answer[len(_ANSWER) + _TIME_BYTES : -_PROOF_BYTES]
        if not hmac.compare_digest(tag, self._tag(issued, address)):
            self.wrong_address += 1
            return
        issued_ns = int.from_bytes(issued, "big", signed=True)
        used = self._opened_by_ns is not None and issued_ns <= self._opened_by_ns
        if used or now_ns - issued_ns > CHALLENGE_LIFETIME_NS:
            self.stale += 1
            return
        self._address = address
        self.cipher = self._new_cipher(self._token or b"", answer[len(_ANSWER) : -_PROOF_BYTES])
        self._opened_by_ns = issued_ns
        self._last_report_ns = now_ns

    def _tag(self, issued: bytes, address: Address) -> bytes:
        """Bind a challenge to its time and to the address it is sent to."""
        host, port = address
        signed = issued + port.to_bytes(2, "big") + host.encode()
        return hmac.digest(self._secret, signed, "sha256")[:_TAG_BYTES]


def _proof(token: bytes, said: bytes) -> bytes:
    """Prove the knowledge of `token`; `said` begins with its kind, so that no proof serves for another."""
    return hmac.digest(token, said, "sha256")


def _check_token(token: bytes) -> None:
    """Raise `UserError` for what is not a token."""
    if len(token) != TOKEN_BYTES:
        raise UserError(f"a video token has {TOKEN_BYTES} bytes, this one {len(token)}: take that of the session reply")
