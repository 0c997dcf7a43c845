from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.errors import BadMessage
from lavt.transport.clock_sync.probe import (
    LATEST_NS,
    LAYOUT,
    ClockProbe,
    ProbeReply,
    decode_reply,
    decode_request,
    encode_reply,
    encode_request,
)

TIMES = st.integers(0, LATEST_NS - 1)
CORRECTIONS = st.tuples(st.floats(-1e9, 1e9), st.floats(0, 1e9))


def test_layout_of_a_request() -> None:
    """A request is 48 bytes: magic, version, kind, sequence, time of sending, and zeros for the server's values."""
    assert encode_request(258, 3) == b"LC\x01\x00" + b"\0\0\x01\x02" + (3).to_bytes(8, "big") + bytes(32)


def test_reply_is_not_longer_than_its_request() -> None:
    """A reply is as long as its request, so that a server cannot be used for amplification."""
    assert len(encode_reply(ProbeReply(1, 2, 3, 4, 0.25, 0.001))) == len(encode_request(1, 2)) == 48


@given(st.integers(0, 2**32 - 1), TIMES)
def test_request_round_trip(sequence: int, sent_ns: int) -> None:
    """A request is decoded as it was encoded, and is not a reply."""
    data = encode_request(sequence, sent_ns)
    assert decode_request(data) == (sequence, sent_ns)
    with pytest.raises(BadMessage):
        decode_reply(data)


@given(st.integers(0, 2**32 - 1), TIMES, TIMES, TIMES, st.one_of(st.none(), CORRECTIONS))
def test_reply_round_trip(
    sequence: int, sent_ns: int, first_ns: int, second_ns: int, correction: tuple[float, float] | None
) -> None:
    """A reply is decoded as it was encoded, with and without a correction, and is not a request."""
    reply = ProbeReply(
        sequence, sent_ns, min(first_ns, second_ns), max(first_ns, second_ns), *(correction or (None, None))
    )
    data = encode_reply(reply)
    assert decode_reply(data) == reply
    with pytest.raises(BadMessage):
        decode_request(data)


GOOD = encode_reply(ProbeReply(1, 2, 3, 4, 0.25, 0.001))
BAD = {
    "empty": b"",
    "short": GOOD[:-1],
    "long": GOOD + b"x",
    "another magic": b"XY" + GOOD[2:],
    "another version": GOOD[:2] + b"\x02" + GOOD[3:],
    "another kind": GOOD[:3] + b"\x07" + GOOD[4:],
    "sent before 1970": LAYOUT.pack(b"LC", 1, 1, 1, -1, 3, 4, 0.0, 0.0),
    "received too late for the format": LAYOUT.pack(b"LC", 1, 1, 1, 2, LATEST_NS, LATEST_NS, 0.0, 0.0),
    "answered before it was received": LAYOUT.pack(b"LC", 1, 1, 1, 2, 4, 3, 0.0, 0.0),
}


@pytest.mark.parametrize("case", BAD)
def test_invalid_replies_are_rejected(case: str) -> None:
    """Anything but a reply of this version is rejected."""
    with pytest.raises(BadMessage):
        decode_reply(BAD[case])


@pytest.mark.parametrize(
    "correction", [(math.nan, 0.1), (math.inf, 0.1), (0.1, math.nan), (0.1, -1.0), (0.1, math.inf)]
)
def test_invalid_correction_is_unknown(correction: tuple[float, float]) -> None:
    """A correction or bound that is not finite, or a negative bound, makes both unknown; the times are kept."""
    reply = decode_reply(LAYOUT.pack(b"LC", 1, 1, 1, 2, 3, 4, *correction))
    assert reply == ProbeReply(1, 2, 3, 4, None, None)


@given(st.binary(max_size=100) | st.binary(min_size=40, max_size=40).map(lambda data: GOOD[:8] + data))
def test_any_bytes_raise_only_bad_message(data: bytes) -> None:
    """Decoding any bytes raises nothing but `BadMessage`."""
    for decode in (decode_request, decode_reply):
        try:
            decode(data)
        except BadMessage:
            continue


@given(st.integers(-(10**12), 10**12), st.integers(0, 10**9), st.integers(0, 10**9), st.integers(0, 10**6), TIMES)
def test_true_offset_is_within_half_the_round_trip(
    delta_ns: int, forward_ns: int, return_ns: int, processing_ns: int, sent_ns: int
) -> None:
    """For any asymmetry of the path, Delta differs from the exchange's offset by at most half the round trip."""
    received_ns = sent_ns + forward_ns
    answered_ns = received_ns + processing_ns
    probe = ClockProbe(1, sent_ns, received_ns + delta_ns, answered_ns + delta_ns, answered_ns + return_ns)
    assert probe.round_trip_ns == forward_ns + return_ns
    assert abs(probe.offset_ns - delta_ns) <= probe.round_trip_ns / 2
