from __future__ import annotations

from dataclasses import asdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.errors import BadPacket
from lavt.transport.rtcp import (
    Feedback,
    ReceptionReport,
    is_rtcp,
    is_rtp,
    parse_feedback,
    picture_loss,
    receiver_report,
)
from lavt.transport.rtp import RtpPacket

WORD = st.integers(0, 2**32 - 1)
SOME_REPORT = receiver_report(1, 2, highest_sequence=3, lost_fraction=0.25, cumulative_lost=5, jitter=6)


REPORTS = st.builds(
    ReceptionReport,
    media_ssrc=WORD,
    highest_sequence=WORD,
    lost_fraction=st.integers(0, 255).map(lambda part: part / 256),
    cumulative_lost=st.integers(-(2**23), 2**23 - 1),
    jitter=WORD,
)


@given(WORD, REPORTS)
def test_report_round_trip(ssrc: int, report: ReceptionReport) -> None:
    """A receiver report that is written is read back as it was, in steps of 1/256."""
    datagram = receiver_report(ssrc, **asdict(report))
    assert is_rtcp(datagram)
    assert parse_feedback(datagram) == Feedback((report,), picture_loss=False)


def test_report_as_in_the_rfc() -> None:
    """A receiver report has the bytes that RFC 3550 gives it."""
    as_in_section_6_4_2 = "81 c9 0007 00000001 00000002 40 000005 00000003 00000006 00000000 00000000"
    assert bytes.fromhex(as_in_section_6_4_2) == SOME_REPORT


def test_values_beyond_their_fields() -> None:
    """Values that do not fit their field are cut to the nearest that do, and the sequence number wraps."""
    datagram = receiver_report(1, 2, highest_sequence=2**32 + 9, lost_fraction=1.0, cumulative_lost=2**30, jitter=2**40)
    (report,) = parse_feedback(datagram).reports
    assert report == ReceptionReport(2, 9, 255 / 256, 2**23 - 1, 2**32 - 1)


def test_picture_loss() -> None:
    """A picture-loss indication follows an empty receiver report and is read back."""
    datagram = picture_loss(1, 2)
    assert datagram == bytes.fromhex("80 c9 0001 00000001") + bytes.fromhex("81 ce 0002 00000001 00000002")
    assert is_rtcp(datagram)
    assert parse_feedback(datagram) == Feedback((), picture_loss=True)


def test_compound() -> None:
    """Sender reports give their report blocks, and source descriptions and the like are passed over."""
    sender_report = bytes.fromhex("81 c8 000c 00000009") + bytes(20) + SOME_REPORT[8:]
    description = bytes.fromhex("81 ca 0002 00000009 01 01 61 00")
    datagram = sender_report + description + picture_loss(1, 2)[8:]
    assert parse_feedback(datagram) == Feedback((ReceptionReport(2, 3, 0.25, 5, 6),), picture_loss=True)


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        SOME_REPORT[:-1],
        SOME_REPORT[:4] + SOME_REPORT[:4],
        picture_loss(1, 2)[8:],
        picture_loss(1, 2)[:-4],
        SOME_REPORT + b"\x81\xce",
        SOME_REPORT + b"\x81\xca\x00\x05",
        b"\x82" + SOME_REPORT[1:],
        b"\x41" + SOME_REPORT[1:],
        b"\xa1" + SOME_REPORT[1:] + picture_loss(1, 2),
        SOME_REPORT + b"\x41\xce\x00\x00",
        SOME_REPORT + b"\x81\xce\x00\x01\x00\x00\x00\x01",
    ],
)
def test_not_rtcp(datagram: bytes) -> None:
    """A datagram that does not begin with a report, is cut off or of another version is refused."""
    with pytest.raises(BadPacket):
        parse_feedback(datagram)


@given(st.binary(max_size=80), st.sampled_from([b"", b"\x81\xc9", b"\x80\xc9\x00\x01\x00\x00\x00\x01\x81\xce"]))
def test_any_bytes(data: bytes, head: bytes) -> None:
    """No bytes make the parser raise anything but `BadPacket`."""
    try:
        parse_feedback(head + data)
    except BadPacket:
        return
    assert (head + data)[1] in {200, 201}


@given(st.binary(max_size=30))
def test_one_or_the_other(datagram: bytes) -> None:
    """No datagram is RTP and RTCP at once."""
    assert not (is_rtp(datagram) and is_rtcp(datagram))


def test_telling_apart() -> None:
    """RTP of our payload type is RTP with and without marker, and what is neither is neither."""
    for marker in (False, True):
        datagram = RtpPacket(96, 1, 2, 3, marker, b"").to_bytes()
        assert is_rtp(datagram)
        assert not is_rtcp(datagram)
    for other in (b"", b"LAVT" + bytes(20), b"\x80\x60"):
        assert not is_rtp(other)
        assert not is_rtcp(other)
