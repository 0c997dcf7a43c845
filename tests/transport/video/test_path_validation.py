from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_S
from lavt.errors import UserError
from lavt.transport.rtp.rtcp import is_rtcp
from lavt.transport.video.cipher import SrtpCipher
from lavt.transport.video.path_validation import (
    CHALLENGE_LIFETIME_NS,
    HELLO_AGAIN_NS,
    HELLO_INTERVAL_NS,
    REPORT_TIMEOUT_NS,
    PathClient,
    PathServer,
    is_path_datagram,
)

TOKEN = bytes(range(16))
OTHER_TOKEN = bytes(16)
HOME = ("192.0.2.1", 5004)
ELSEWHERE = ("198.51.100.7", 5004)
OTHER_PORT = ("192.0.2.1", 5005)
T0 = 5 * NS_PER_S


def new_secrets() -> Callable[[], bytes]:
    numbers = count()
    return lambda: next(numbers).to_bytes(16, "big")


def new_server(token: bytes | None = TOKEN) -> PathServer:
    server = PathServer(new_secrets())
    server.set_token(token)
    return server


def answer_for(server: PathServer, address: tuple[str, int], now_ns: int = T0, *, number: int = 1) -> bytes:
    """Send a client's hello with this number from `address`; return the client's answer to the challenge."""
    client = PathClient(TOKEN)
    hellos = [client.hello(now_ns) for _ in range(number)]
    challenge = server.receive(hellos[-1], address, now_ns)
    assert challenge is not None
    answer = client.answer(challenge)
    assert answer is not None
    return answer


def server_with_open_path(address: tuple[str, int] = HOME, now_ns: int = T0) -> PathServer:
    server = new_server()
    assert server.receive(answer_for(server, address, now_ns), address, now_ns) is None
    assert server.open_address(now_ns) == address
    return server


def rejections(server: PathServer) -> dict[str, int]:
    names = ("malformed", "wrong_token", "wrong_address", "stale", "unneeded", "foreign_reports")
    return {name: getattr(server, name) for name in names if getattr(server, name)}


def test_opening() -> None:
    """Hello, challenge and answer open the path to the client's address, and not before the answer arrives."""
    server, client = new_server(), PathClient(TOKEN)
    assert server.open_address(T0) is None
    challenge = server.receive(client.hello(T0), HOME, T0)
    assert challenge is not None
    assert server.open_address(T0) is None
    assert not server.accepts_rtcp_from(HOME)
    answer = client.answer(challenge)
    assert answer is not None
    assert server.receive(answer, HOME, T0 + 1) is None
    assert server.open_address(T0 + 1) == HOME
    assert server.accepts_rtcp_from(HOME)
    assert not server.accepts_rtcp_from(OTHER_PORT)
    assert rejections(server) == {}


def test_no_amplification() -> None:
    """The server's reply to an address that is not validated is not longer than the hello."""
    server, client = new_server(), PathClient(TOKEN)
    hello = client.hello(T0)
    challenge = server.receive(hello, HOME, T0)
    assert challenge is not None
    assert len(challenge) <= len(hello)


def test_path_datagrams_are_neither_rtp_nor_rtcp() -> None:
    """The datagrams of the path validation are neither RTP nor RTCP."""
    server, client = new_server(), PathClient(TOKEN)
    hello = client.hello(T0)
    challenge = server.receive(hello, HOME, T0)
    assert challenge is not None
    for datagram in (hello, challenge, client.answer(challenge) or b""):
        assert is_path_datagram(datagram)
        assert not is_rtcp(datagram)


def test_wrong_token() -> None:
    """A peer with a wrong token gets no challenge, and an answer without a valid MAC does not open the path."""
    server = new_server()
    stranger, client = PathClient(OTHER_TOKEN), PathClient(TOKEN)
    assert server.receive(stranger.hello(T0), HOME, T0) is None
    challenge = server.receive(client.hello(T0), HOME, T0)
    assert challenge is not None
    assert stranger.answer(challenge) is None
    right = client.answer(challenge)
    assert right is not None
    server.receive(right[:-32] + bytes(32), HOME, T0)
    assert server.open_address(T0) is None
    assert rejections(server) == {"wrong_token": 2}


def test_no_session() -> None:
    """Without a session there is no token, and a hello is rejected."""
    server = new_server(None)
    assert server.receive(PathClient(TOKEN).hello(T0), HOME, T0) is None
    assert rejections(server) == {"wrong_token": 1}


@pytest.mark.parametrize("address", [ELSEWHERE, OTHER_PORT])
def test_answer_from_another_address(address: tuple[str, int]) -> None:
    """A copied answer that is sent from another address neither opens nor moves the path."""
    server = new_server()
    answer = answer_for(server, HOME)
    server.receive(answer, address, T0)
    assert server.open_address(T0) is None
    server.receive(answer, HOME, T0)
    server.receive(answer, address, T0)
    assert server.open_address(T0) == HOME
    assert rejections(server) == {"wrong_address": 2}


def test_third_party() -> None:
    """A peer that has the token cannot open the path to another address by answering a challenge to its own address."""
    server = new_server()
    answer = answer_for(server, ELSEWHERE)
    server.receive(answer, HOME, T0)
    assert server.open_address(T0) is None


def test_stale_challenge() -> None:
    """A challenge is valid for 2 s and not longer."""
    server = new_server()
    answer = answer_for(server, HOME, T0)
    server.receive(answer, HOME, T0 + CHALLENGE_LIFETIME_NS + 1)
    assert server.open_address(T0 + CHALLENGE_LIFETIME_NS + 1) is None
    assert rejections(server) == {"stale": 1}
    server.receive(answer, HOME, T0 + CHALLENGE_LIFETIME_NS)
    assert server.open_address(T0 + CHALLENGE_LIFETIME_NS) == HOME


def test_spoofed_hello() -> None:
    """A hello from another address, with or without the token, does not move an open path."""
    server = server_with_open_path()
    assert server.receive(PathClient(TOKEN).hello(T0), ELSEWHERE, T0) is not None
    server.receive(PathClient(OTHER_TOKEN).hello(T0), ELSEWHERE, T0)
    assert server.open_address(T0) == HOME


def test_new_address() -> None:
    """A client with a new address is challenged there, and its answer moves the path."""
    server = server_with_open_path()
    answer = answer_for(server, ELSEWHERE, T0 + 1, number=2)
    assert server.open_address(T0 + 1) == HOME
    server.receive(answer, ELSEWHERE, T0 + 1)
    assert server.open_address(T0 + 1) == ELSEWHERE
    assert not server.accepts_rtcp_from(HOME)


def test_replay_after_a_move() -> None:
    """An answer that opened the path once does not move it back, not even from its own address."""
    server = new_server()
    first = answer_for(server, HOME, T0)
    server.receive(first, HOME, T0)
    server.receive(answer_for(server, ELSEWHERE, T0 + 1, number=2), ELSEWHERE, T0 + 1)
    server.receive(first, HOME, T0 + 2)
    assert server.open_address(T0 + 2) == ELSEWHERE
    assert rejections(server) == {"stale": 1}


def test_replay_does_not_keep_the_path_open() -> None:
    """A repeated answer does not replace receiver reports."""
    server = new_server()
    answer = answer_for(server, HOME, T0)
    server.receive(answer, HOME, T0)
    server.receive(answer, HOME, T0 + CHALLENGE_LIFETIME_NS)
    assert server.open_address(T0 + REPORT_TIMEOUT_NS + 1) is None


def test_no_reports() -> None:
    """A path stays open for 2 s after the last receiver report, and is then closed."""
    server = server_with_open_path()
    server.note_report(HOME, T0 + REPORT_TIMEOUT_NS)
    assert server.open_address(T0 + 2 * REPORT_TIMEOUT_NS) == HOME
    assert server.open_address(T0 + 2 * REPORT_TIMEOUT_NS + 1) is None
    assert not server.accepts_rtcp_from(HOME)


def test_report_too_late() -> None:
    """A report does not reopen a closed path; an answer to a new challenge does."""
    server = server_with_open_path()
    late_ns = T0 + REPORT_TIMEOUT_NS + 1
    server.note_report(HOME, late_ns)
    assert server.open_address(late_ns) is None
    assert rejections(server) == {"foreign_reports": 1}
    server.receive(answer_for(server, HOME, late_ns, number=2), HOME, late_ns)
    assert server.open_address(late_ns) == HOME


def test_report_from_elsewhere() -> None:
    """Reports from another address do not keep the path open."""
    server = server_with_open_path()
    server.note_report(ELSEWHERE, T0 + REPORT_TIMEOUT_NS)
    assert server.open_address(T0 + REPORT_TIMEOUT_NS + 1) is None
    assert rejections(server) == {"foreign_reports": 1}


def test_forged_and_old_challenges_are_not_answered() -> None:
    """The client answers no forged challenge, no second one to the same hello, and none to an earlier hello."""
    server, client = new_server(), PathClient(TOKEN)
    challenge = server.receive(client.hello(T0), HOME, T0)
    hello = client.hello(T0 + 1)
    newer, copied = server.receive(hello, HOME, T0 + 1), server.receive(hello, ELSEWHERE, T0 + 1)
    assert challenge is not None
    assert copied is not None
    assert newer is not None
    for position in range(len(challenge)):
        forged = challenge[:position] + bytes([challenge[position] ^ 1]) + challenge[position + 1 :]
        assert client.answer(forged) is None
    assert client.answer(newer) is not None
    assert client.answer(newer) is None
    assert client.answer(copied) is None
    assert client.answer(challenge) is None


def test_a_challenge_to_a_hello_that_was_not_sent_is_not_answered() -> None:
    """A challenge with a higher number than the client's last hello is not answered."""
    server, client, other = new_server(), PathClient(TOKEN), PathClient(TOKEN)
    client.hello(T0)
    other.hello(T0)
    challenge = server.receive(other.hello(T0), HOME, T0)
    assert challenge is not None
    assert client.answer(challenge) is None
    client.hello(T0)
    assert client.answer(challenge) is not None


def test_replayed_hello() -> None:
    """The newest hello gets one challenge at each of two addresses; older hellos get none."""
    server, client = new_server(), PathClient(TOKEN)
    old, new = client.hello(T0), client.hello(T0)
    assert server.receive(new, ELSEWHERE, T0) is not None
    assert server.receive(new, HOME, T0) is not None
    assert server.receive(new, HOME, T0) is None
    assert server.receive(old, HOME, T0) is None
    assert server.receive(old, ELSEWHERE, T0) is None
    assert rejections(server) == {"stale": 3}


def test_few_copies_of_a_hello_get_a_challenge() -> None:
    """Copies of the newest hello from many addresses get four challenges, and the next hello gets its own."""
    server, client = new_server(), PathClient(TOKEN)
    hello = client.hello(T0)
    challenges = [server.receive(hello, ("198.51.100.7", port), T0) for port in range(100)]
    assert sum(challenge is not None for challenge in challenges) == 4
    assert server.receive(client.hello(T0), HOME, T0) is not None


def test_an_open_path_keeps_its_cipher() -> None:
    """A second answer from the path's address changes no key while the path is open, and reopens a closed path."""
    server, client = new_server(), PathClient(TOKEN)
    open_path(server, client, HOME, T0)
    cipher = server.cipher
    for now_ns in (T0 + 1, T0 + REPORT_TIMEOUT_NS):
        open_path(server, client, HOME, now_ns)
        assert server.cipher is cipher
    assert rejections(server) == {"unneeded": 2}
    open_path(server, client, HOME, T0 + REPORT_TIMEOUT_NS + 1)
    assert server.cipher is not cipher


def encrypted_pair() -> tuple[PathServer, PathClient]:
    pytest.importorskip("pylibsrtp", reason="an extra: pip install -e '.[secure]'")
    server = PathServer(new_secrets(), partial(SrtpCipher, "server"))
    server.set_token(TOKEN)
    return server, PathClient(TOKEN, partial(SrtpCipher, "client"))


def open_path(server: PathServer, client: PathClient, address: tuple[str, int], now_ns: int) -> None:
    challenge = server.receive(client.hello(now_ns), address, now_ns)
    assert challenge is not None
    server.receive(client.answer(challenge) or b"", address, now_ns)
    assert server.open_address(now_ns) == address


RTP = bytes.fromhex("80600001000000010000000a") + b"a picture"
RTCP = bytes.fromhex("80c900010000000b")


def test_an_encrypted_path_carries_video_down_and_reports_up() -> None:
    """Each end unprotects the packets that the other protects, and their payload is encrypted."""
    server, client = encrypted_pair()
    open_path(server, client, HOME, T0)
    protected = server.cipher.protect(RTP)
    assert b"a picture" not in protected
    assert client.unprotect(protected) == RTP
    assert client.unprotect(protected) is None
    assert client.unprotect(RTP) is None
    assert client.unprotect_rtcp(server.cipher.protect_rtcp(RTCP)) == RTCP
    assert server.cipher.unprotect_rtcp(client.protect_rtcp(RTCP)) == RTCP
    assert server.cipher.unprotect_rtcp(RTCP) is None


def test_each_opening_has_keys_of_its_own() -> None:
    """At a new address the keys are new, and the client still unprotects packets under the previous keys."""
    server, client = encrypted_pair()
    open_path(server, client, HOME, T0)
    before = server.cipher.protect(RTP)
    late = server.cipher.protect(RTP.replace(b"\x00\x01", b"\x00\x02", 1))
    open_path(server, client, ELSEWHERE, T0 + 1)
    after = server.cipher.protect(RTP)
    assert after != before
    assert client.unprotect(after) == RTP
    assert client.unprotect(late) is not None
    assert client.unprotect(before) == RTP
    assert client.unprotect(before) is None
    assert server.cipher.unprotect_rtcp(client.protect_rtcp(RTCP)) == RTCP


def test_lost_answers_do_no_harm() -> None:
    """A client whose newer answers are lost, however many, unprotects and protects packets under the keys in use."""
    server, client = encrypted_pair()
    open_path(server, client, HOME, T0)
    assert client.unprotect(server.cipher.protect(RTP)) == RTP
    for later_ns in range(1, 100):
        challenge = server.receive(client.hello(T0 + later_ns), HOME, T0 + later_ns)
        assert client.answer(challenge or b"") is not None
    assert client.unprotect(server.cipher.protect(RTP.replace(b"\x00\x01", b"\x00\x02", 1))) is not None
    assert server.cipher.unprotect_rtcp(client.protect_rtcp(RTCP)) == RTCP


@pytest.mark.parametrize("token", [OTHER_TOKEN, TOKEN, None])
def test_new_token(token: bytes | None) -> None:
    """A new token closes the path and invalidates older challenges."""
    server = server_with_open_path()
    before = answer_for(server, HOME, T0 + 1, number=2)
    server.set_token(token)
    assert server.open_address(T0 + 1) is None
    assert not server.accepts_rtcp_from(HOME)
    server.receive(before, HOME, T0 + 1)
    assert server.open_address(T0 + 1) is None


def test_bad_token() -> None:
    """A token that is not 16 bytes long is rejected at both ends."""
    with pytest.raises(UserError, match="16 bytes"):
        PathClient(b"short")
    with pytest.raises(UserError, match="16 bytes"):
        new_server(b"")


def test_a_lost_path_is_requested_long_before_the_command_timeout() -> None:
    """If the video is lost, a hello follows within half of the 300 ms after which a vehicle is degraded."""
    assert HELLO_AGAIN_NS <= 300_000_000 // 2


def test_times_of_hellos() -> None:
    """A hello is due immediately, then every 500 ms; after the first video, whenever none has arrived for 150 ms."""
    client = PathClient(TOKEN)
    assert client.next_hello_ns() == 0
    client.hello(T0)
    assert client.next_hello_ns() == T0 + HELLO_INTERVAL_NS
    client.video_arrived(T0 + 7)
    assert client.next_hello_ns() == T0 + 7 + HELLO_AGAIN_NS
    client.hello(T0 + 7 + HELLO_AGAIN_NS)
    assert client.next_hello_ns() == T0 + 7 + 2 * HELLO_AGAIN_NS


@given(st.binary(max_size=80), st.sampled_from([b"", b"LAVT", b"LAVT\x01\x03", b"LAVT\x02\x03", b"LAVT\x03\x03"]))
def test_any_bytes(data: bytes, head: bytes) -> None:
    """Arbitrary bytes get no reply, open no path and raise nothing, and each datagram is counted once."""
    server = server_with_open_path()
    assert server.receive(head + data, ELSEWHERE, T0) is None
    assert server.open_address(T0) == HOME
    assert sum(rejections(server).values()) == 1
    assert PathClient(TOKEN).answer(head + data) is None


@given(st.integers(0, 69), st.integers(1, 255))
def test_any_change(position: int, flipped_bits: int) -> None:
    """An answer with any byte changed does not open the path."""
    server = new_server()
    answer = bytearray(answer_for(server, HOME))
    answer[position] ^= flipped_bits
    server.receive(bytes(answer), HOME, T0)
    assert server.open_address(T0) is None
    assert sum(rejections(server).values()) == 1
