from __future__ import annotations

from collections import Counter
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.transport.clock_sync.probe import encode_request
from lavt.transport.datagram_filter import (
    OTHER_DATAGRAMS_PER_S,
    PROBES_PER_S,
    ProbePortFilter,
    VideoPortFilter,
    filtered,
)
from lavt.transport.video.path_validation import PathClient, PathServer

TOKEN = bytes(range(16))
HOME, ELSEWHERE = ("192.0.2.1", 5004), ("198.51.100.7", 5004)
VIA_RENDEZVOUS = ("rendezvous:192.0.2.1", 5004)
RTCP = bytes.fromhex("80c900010000000b")
T0 = 5 * NS_PER_S


def new_path() -> PathServer:
    path = PathServer(lambda: bytes(16))
    path.set_token(TOKEN)
    return path


def open_path(path: PathServer, client: PathClient, address: tuple[str, int] = HOME) -> None:
    challenge = path.receive(client.hello(T0), address, T0)
    path.receive(client.answer(challenge or b"") or b"", address, T0)
    assert path.open_address(T0) == address


def count_passed(
    port_filter: VideoPortFilter | ProbePortFilter, datagram: bytes, address: tuple[str, int], copies: int
) -> int:
    """Send `copies` equal datagrams within one second; return how many the filter passes."""
    return sum(port_filter.passes(datagram, address, T0 + number * NS_PER_MS // 10) for number in range(copies))


def exhaust(port_filter: VideoPortFilter) -> None:
    """Use up the rate limit of the second that begins at T0."""
    assert count_passed(port_filter, b"garbage", ELSEWHERE, 1000) == OTHER_DATAGRAMS_PER_S


def test_strangers_datagrams_pass_at_a_limited_rate() -> None:
    """All senders without an open path share one limit of 200 datagrams a second."""
    path, client = new_path(), PathClient(TOKEN)
    video = VideoPortFilter(path)
    forged = PathClient(bytes(16)).hello(T0)
    total = sum(
        count_passed(video, datagram, ELSEWHERE, 300)
        for datagram in (b"", b"LAVT", RTCP, forged, client.hello(T0)[:-1])
    )
    assert total == OTHER_DATAGRAMS_PER_S
    assert video.passes(b"garbage", ELSEWHERE, T0 + NS_PER_S)


def test_a_flood_does_not_keep_the_client_out() -> None:
    """During a flood each hello and answer of the client passes once, and all its reports once the path is open."""
    path, client = new_path(), PathClient(TOKEN)
    video = VideoPortFilter(path)
    exhaust(video)
    assert not video.passes(RTCP, HOME, T0)
    hello = client.hello(T0)
    answer = client.answer(path.receive(hello, HOME, T0) or b"") or b""
    for datagram in (hello, answer):
        assert video.passes(datagram, HOME, T0)
        assert not video.passes(datagram, HOME, T0)
        assert not video.passes(datagram, ELSEWHERE, T0)
    path.receive(answer, HOME, T0)
    assert count_passed(video, RTCP, HOME, 1000) == 1000
    assert video.passes(client.hello(T0), ELSEWHERE, T0)


def test_replays_with_the_clients_address_pass_at_a_limited_rate() -> None:
    """Replayed hellos and answers are limited like a stranger's, even from the address of the open path."""
    path, client = new_path(), PathClient(TOKEN)
    video = VideoPortFilter(path)
    hello = client.hello(T0)
    answer = client.answer(path.receive(hello, HOME, T0) or b"") or b""
    path.receive(answer, HOME, T0)
    assert count_passed(video, hello, HOME, 1000) == OTHER_DATAGRAMS_PER_S + 1, "the first one is no replay"
    assert count_passed(video, answer, HOME, 1000) == 1


def test_hellos_with_a_new_token_pass() -> None:
    """With the token of a new session the client's numbers begin anew; without a session nothing is authentic."""
    path, client = new_path(), PathClient(TOKEN)
    video = VideoPortFilter(path)
    exhaust(video)
    assert all(video.passes(client.hello(T0), HOME, T0) for _ in range(5))
    path.set_token(bytes(16))
    assert not video.passes(client.hello(T0), HOME, T0)
    assert video.passes(PathClient(bytes(16)).hello(T0), HOME, T0)
    path.set_token(None)
    assert not video.passes(PathClient(bytes(16)).hello(T0), HOME, T0)


def test_strangers_probes_do_not_crowd_out_the_clients() -> None:
    """Probes of the host with the open path have a separate rate limit, directly and through the rendezvous."""
    request = encode_request(1, 1)
    for address in (HOME, VIA_RENDEZVOUS):
        path = new_path()
        probe = ProbePortFilter(path)
        open_path(path, PathClient(TOKEN), address)
        assert count_passed(probe, request, ELSEWHERE, 1000) == PROBES_PER_S
        assert probe.passes(request, (address[0], 40000), T0)
        assert not probe.passes(request, ELSEWHERE, T0)
        assert count_passed(probe, request, address, 1000) == PROBES_PER_S - 1, "this host has sent one already"


def test_datagrams_that_do_not_pass_are_counted_and_not_delivered() -> None:
    """A datagram that does not pass is counted in the link's counts, and is neither delivered nor recorded."""
    delivered: list[tuple[str, Any]] = []
    counts: Counter[str] = Counter()
    deliver = filtered(
        lambda channel, payload, _arrived, _peer: delivered.append((channel, payload)),
        VideoPortFilter(new_path()),
        counts,
    )
    for number in range(OTHER_DATAGRAMS_PER_S + 7):
        deliver("feedback", number.to_bytes(2, "big"), Now(T0, T0), ELSEWHERE)
    assert len(delivered) == OTHER_DATAGRAMS_PER_S
    assert counts == {"datagrams_screened_out": 7}


@given(st.binary(max_size=80), st.sampled_from([b"", b"LAVT\x01\x03", b"LAVT\x03\x03"]))
def test_any_bytes(data: bytes, head: bytes) -> None:
    """Arbitrary bytes raise nothing and do not pass once the rate limit is used up."""
    video = VideoPortFilter(new_path())
    exhaust(video)
    assert not video.passes(head + data, ELSEWHERE, T0)
