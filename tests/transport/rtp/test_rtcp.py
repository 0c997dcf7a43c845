from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import BadPacket
from lavt.transport.rtp.ntp_time import (
    delay_to_short,
    elapsed_to_ntp,
    ntp_to_short,
    round_trip_ns,
    short_to_delay_ns,
    wall_to_ntp,
)
from lavt.transport.rtp.rtcp import (
    Announcement,
    BitRateLimit,
    Feedback,
    ReceptionReport,
    SenderReport,
    is_rtcp,
    max_bit_rate,
    parse_announcement,
    parse_feedback,
    picture_loss,
    receiver_report,
    sender_report,
)
from lavt.transport.rtp.rtcp_xr import ReferenceAnswer, ReferenceTime, round_trip_of_answer_ns
from lavt.transport.rtp.rtp import RtpPacket

UINT32 = st.integers(0, 2**32 - 1)
DELAY_NS = UINT32.map(short_to_delay_ns)
CLOCK_NS = st.integers(0, 2**62)
CNAME = st.text("abcdefghij@.", min_size=1, max_size=300)
REPORTS = st.builds(
    ReceptionReport,
    media_ssrc=UINT32,
    highest_sequence=UINT32,
    lost_fraction=st.integers(0, 255).map(lambda part: part / 256),
    cumulative_lost=st.integers(-(2**23), 2**23 - 1),
    jitter=UINT32,
    last_report=UINT32,
    last_report_age_ns=DELAY_NS,
)
ANSWERS = st.builds(ReferenceAnswer, UINT32, UINT32, DELAY_NS)

REPORT = ReceptionReport(2, 3, 0.25, 5, 6, 0xB44DB705, 5 * NS_PER_S + 250 * NS_PER_MS)
EXAMPLE_REPORT = receiver_report(1, REPORT, clock_ns=NS_PER_S // 2, cname="ab")
EXAMPLE_SENDER_REPORT = sender_report(
    9,
    wall_ns=0,
    rtp_timestamp=7,
    packets=2**32 + 8,
    octets=2**32 + 9,
    cname="a",
    answered=[ReferenceAnswer(1, 0x8000, 2**20)],
)

# Written by hand from the diagrams in the RFCs.
REPORT_BLOCK = "00000002 40 000005 00000003 00000006 b44db705 00054000"
RECEIVER_REPORT = "81 c9 0007 00000001" + REPORT_BLOCK  # RFC 3550, section 6.4.2
EMPTY_REPORT = "80 c9 0001 00000001"
DESCRIPTION = "81 ca 0003 00000001 01 02 61 62 00000000"  # RFC 3550, section 6.5
REFERENCE_TIME = "80 cf 0004 00000001 04 00 0002 00000000 80000000"  # RFC 3611, sections 3 and 4.4
SENDER_REPORT = "80 c8 0006 00000009 83aa7e80 00000000 00000007 00000008 00000009"  # RFC 3550, section 6.4.1
SENDER_DESCRIPTION = "81 ca 0002 00000009 01 01 61 00"
ANSWER = "80 cf 0005 00000009 05 00 0003 00000001 00008000 00000045"  # RFC 3611, section 4.5
PICTURE_LOSS = "81 ce 0002 00000001 00000002"  # RFC 4585, section 6.3.1
LIMIT = "83 cd 0004 00000001 00000000 00000002"  # RFC 5104, section 4.2.1


def test_receiver_report_as_in_the_rfcs() -> None:
    """A receiver report, its source description and its reference time have the formats of the RFCs."""
    assert bytes.fromhex(RECEIVER_REPORT + DESCRIPTION + REFERENCE_TIME) == EXAMPLE_REPORT


def test_sender_report_as_in_the_rfcs() -> None:
    """A sender report, its source description and its answers have the formats of the RFCs."""
    assert bytes.fromhex(SENDER_REPORT + SENDER_DESCRIPTION + ANSWER) == EXAMPLE_SENDER_REPORT


def test_sender_report_without_answers() -> None:
    """A sender without a reference time to answer sends no extended report."""
    datagram = sender_report(9, wall_ns=0, rtp_timestamp=7, packets=8, octets=9, cname="a")
    assert datagram == bytes.fromhex(SENDER_REPORT + SENDER_DESCRIPTION)


def test_picture_loss_as_in_the_rfcs() -> None:
    """A picture-loss indication follows an empty receiver report and a source description."""
    datagram = picture_loss(1, 2, cname="ab")
    assert datagram == bytes.fromhex(EMPTY_REPORT + DESCRIPTION + PICTURE_LOSS)
    assert parse_feedback(datagram) == Feedback(picture_loss=True)


@pytest.mark.parametrize(
    ("bit_rate_bps", "exponent", "mantissa"),
    [
        (0, 0, 0),
        (131_071, 0, 131_071),
        (131_072, 1, 65_536),
        (2_000_000, 4, 125_000),
        (2_000_015, 4, 125_000),
        (2**80, 63, 2**17 - 1),
    ],
)
def test_max_bit_rate_as_in_the_rfc(bit_rate_bps: int, exponent: int, mantissa: int) -> None:
    """A bit rate limit is written as exponent, mantissa and overhead, rounded down and clamped."""
    datagram = max_bit_rate(1, 2, bit_rate_bps, overhead_bytes=40, cname="ab")
    word = exponent * 2**26 + mantissa * 2**9 + 40
    assert datagram == bytes.fromhex(EMPTY_REPORT + DESCRIPTION + LIMIT) + word.to_bytes(4, "big")
    limit = BitRateLimit(2, mantissa * 2**exponent, 40)
    assert parse_feedback(datagram) == Feedback(limits=(limit,))


def test_overhead_beyond_its_field() -> None:
    """An overhead above 511 bytes is written as 511, and the bit rate is unchanged."""
    (limit,) = parse_feedback(max_bit_rate(1, 2, 1000, overhead_bytes=600)).limits
    assert limit == BitRateLimit(2, 1000, 511)


@given(UINT32, UINT32, st.integers(0, 2**80), st.integers(0, 511))
def test_max_bit_rate_round_trip(ssrc: int, media_ssrc: int, bit_rate_bps: int, overhead_bytes: int) -> None:
    """A parsed limit is never higher than the requested one, and lower by at most one part in 2^16."""
    datagram = max_bit_rate(ssrc, media_ssrc, bit_rate_bps, overhead_bytes=overhead_bytes)
    (limit,) = parse_feedback(datagram).limits
    assert (limit.media_ssrc, limit.overhead_bytes) == (media_ssrc, overhead_bytes)
    assert bit_rate_bps * (1 - 2**-16) <= limit.bit_rate_bps <= bit_rate_bps


@given(UINT32, REPORTS, CLOCK_NS, CNAME)
def test_receiver_report_round_trip(ssrc: int, report: ReceptionReport, clock_ns: int, cname: str) -> None:
    """A written receiver report is parsed back unchanged, with its reference time."""
    datagram = receiver_report(ssrc, report, clock_ns=clock_ns, cname=cname)
    assert is_rtcp(datagram)
    reference = ReferenceTime(ssrc, clock_ns * 65_536 // NS_PER_S % 2**32)
    assert parse_feedback(datagram) == Feedback((report,), reference_times=(reference,))
    assert parse_announcement(datagram) == Announcement()


@given(UINT32, CLOCK_NS, st.tuples(UINT32, UINT32, UINT32), CNAME, st.lists(ANSWERS, max_size=3))
def test_sender_report_round_trip(
    ssrc: int, wall_ns: int, counts: tuple[int, int, int], cname: str, answers: list[ReferenceAnswer]
) -> None:
    """A written sender report is parsed back unchanged, with its answers."""
    timestamp, packets, octets = counts
    datagram = sender_report(
        ssrc, wall_ns=wall_ns, rtp_timestamp=timestamp, packets=packets, octets=octets, cname=cname, answered=answers
    )
    assert is_rtcp(datagram)
    report = SenderReport(ssrc, wall_to_ntp(wall_ns), timestamp, packets, octets)
    assert parse_announcement(datagram) == Announcement((report,), tuple(answers))
    assert parse_feedback(datagram) == Feedback()


@given(st.text(max_size=400))
def test_any_cname(cname: str) -> None:
    """A source description has whole words and ends with at least one zero byte for any name."""
    datagram = picture_loss(1, 2, cname=cname)
    assert parse_feedback(datagram) == Feedback(picture_loss=True)
    name = cname.encode()[:255]
    words = int.from_bytes(datagram[10:12], "big")
    assert datagram[16:18] == bytes([1, len(name)])
    end = 8 + 4 * (words + 1)
    assert datagram[18 : 18 + len(name)] == name
    assert datagram[18 + len(name) : end] in {bytes(1), bytes(2), bytes(3), bytes(4)}
    assert len(datagram) == end + 12


def test_values_beyond_their_fields() -> None:
    """Values that do not fit their field are clamped, and the sequence number wraps."""
    too_high = ReceptionReport(2, 2**32 + 9, 1.0, 2**30, 2**40, 1, 2**60)
    (report,) = parse_feedback(receiver_report(1, too_high, clock_ns=0)).reports
    assert report == ReceptionReport(2, 9, 255 / 256, 2**23 - 1, 2**32 - 1, 1, short_to_delay_ns(2**32 - 1))
    too_low = ReceptionReport(2, 9, -1.0, -(2**30), 0, 1, -1)
    (report,) = parse_feedback(receiver_report(1, too_low, clock_ns=0)).reports
    assert report == ReceptionReport(2, 9, 0.0, -(2**23), 0, 1, 0)


def test_compound_datagrams_are_parsed() -> None:
    """Report blocks of sender reports are parsed, too, and unknown packets, formats and blocks are skipped."""
    sender_report_with_block = "81 c8 000c 00000009" + "00" * 20 + REPORT_BLOCK
    unknown = (
        "80 d0 0000" + "8f ce 0002 00000001 00000002" + "81 cd 0003 00000001 00000002 00010000" + "81 cb 0001 00000001"
    )
    extended = "80 cf 0006 00000001 07 00 0001 00000000 04 00 0002 00000000 80000000"
    feedback = parse_feedback(bytes.fromhex(sender_report_with_block + DESCRIPTION + unknown + extended + PICTURE_LOSS))
    assert feedback == Feedback((REPORT,), picture_loss=True, reference_times=(ReferenceTime(1, 0x8000),))
    announcement = parse_announcement(bytes.fromhex(SENDER_REPORT + unknown + extended + ANSWER))
    answer = ReferenceAnswer(1, 0x8000, short_to_delay_ns(0x45))
    assert announcement == Announcement((SenderReport(9, 0x83AA7E80 << 32, 7, 8, 9),), (answer,))


def test_padding_and_extension() -> None:
    """The last packet may be padded, and a report may be longer than its blocks."""
    padded = "a1 ce 0003 00000001 00000002 00000004"
    assert parse_feedback(bytes.fromhex(EMPTY_REPORT + padded)) == Feedback(picture_loss=True)
    extended = "81 c9 0008 00000001" + REPORT_BLOCK + "12345678"
    assert parse_feedback(bytes.fromhex(extended)) == Feedback((REPORT,))


INVALID_BEGINNINGS = (
    "",
    RECEIVER_REPORT[:-2],
    PICTURE_LOSS,
    DESCRIPTION,
    "81c90000 81c90000",  # reports without an SSRC
    "41" + RECEIVER_REPORT[2:],  # version 1
)
INVALID_ENDS = (
    "81ce",  # half a header
    "81ca0005",  # a header without its 5 words
    "41ce0000",  # version 1
    "a1ca0000",  # padding without room for its own length
    "a1ca000100000000",  # padding of length 0
    "a1ca000100000003",  # padding that is not whole words
    "a1ca000100000008",  # padding longer than the packet
    "a1ca000100000004" + DESCRIPTION,  # padding before the last packet
)
INVALID_AT_THE_SENDER = (
    "82" + RECEIVER_REPORT[2:],  # one report block instead of two
    "81c8000600000009" + "00" * 20,  # a sender report without its report block
    "81ce000100000001",  # a picture-loss indication without the SSRC of the media
    "81ce0003000000010000000200000000",  # a picture-loss indication that is too long
    "83cd0002 00000001 00000000",  # a bit rate limit without an entry
    "83cd0003 00000001 00000000 00000002",  # a bit rate limit with half an entry
    "83cd0001 00000001",  # a bit rate limit without the SSRC of the media
    "80cf0000",  # an extended report without an SSRC
    "80cf0002 00000001 04000001",  # a reference time without content
    "80cf0003 00000001 04000001 00000000",  # a reference time of one word instead of two
    "80cf0005 00000001 04000003 00000000 00000000 00000000",  # a reference time of three words
)
INVALID_AT_THE_RECEIVER = (
    "80c8000500000009" + "00" * 16,  # a sender report that is too short
    "81c8000600000009" + "00" * 20,  # a sender report without its report block
    "80cf0000",  # an extended report without an SSRC
    "80cf0002 00000009 05000003",  # an answer without content
    "80cf0003 00000009 05000001 00000001",  # an answer of one word instead of three
    "80cf0006 00000009 05000004" + "00" * 16,  # an answer of four words
)


@pytest.mark.parametrize("datagram", [*INVALID_BEGINNINGS, *(EMPTY_REPORT + end for end in INVALID_ENDS)])
def test_invalid_rtcp_is_rejected(datagram: str) -> None:
    """A datagram is rejected if it has no report first, is cut off, or has another version or invalid padding."""
    with pytest.raises(BadPacket):
        parse_feedback(bytes.fromhex(datagram))
    with pytest.raises(BadPacket):
        parse_announcement(bytes.fromhex(datagram))


@pytest.mark.parametrize("packet", INVALID_AT_THE_SENDER)
def test_wrong_lengths_for_the_sender(packet: str) -> None:
    """A report, request or reference time of an impossible length raises `BadPacket`."""
    with pytest.raises(BadPacket):
        parse_feedback(bytes.fromhex(EMPTY_REPORT + packet))


@pytest.mark.parametrize("packet", INVALID_AT_THE_RECEIVER)
def test_wrong_lengths_for_the_receiver(packet: str) -> None:
    """A sender report or an answer of an impossible length raises `BadPacket`."""
    with pytest.raises(BadPacket):
        parse_announcement(bytes.fromhex(EMPTY_REPORT + packet))


PACKETS = st.builds(
    lambda first, kind, body, words: (
        struct.pack("!BBH", first, kind, len(body) // 4 if words is None else words) + body
    ),
    st.sampled_from([0x80, 0x81, 0x83, 0xA1]),
    st.sampled_from([200, 201, 202, 205, 206, 207]),
    st.lists(st.sampled_from([b"\4\0\0\2", b"\5\0\0\3", b"\5\0\0\0", bytes(4), b"\0\0\0\4"]), max_size=9).map(b"".join),
    st.one_of(st.none(), st.none(), st.integers(0, 9)),
)


@given(st.one_of(st.binary(max_size=80), st.lists(PACKETS, max_size=4).map(b"".join)))
def test_any_bytes(data: bytes) -> None:
    """For any bytes a parser raises nothing but `BadPacket`."""
    for beginning in (b"", b"\x81\xc9", bytes.fromhex(EMPTY_REPORT)):
        for parse in (parse_feedback, parse_announcement):
            try:
                parse(beginning + data)
            except BadPacket:
                continue
            assert (beginning + data)[1] in {200, 201}


def test_ntp_times() -> None:
    """An NTP timestamp counts from 1900 for the wall clock, and from the clock's own epoch for any other clock."""
    wall_ns = 1_500_000_000_500_000_000
    assert wall_to_ntp(wall_ns) == (1_500_000_000 + 2_208_988_800) << 32 | 2**31
    assert elapsed_to_ntp(wall_ns) == 1_500_000_000 << 32 | 2**31
    assert ntp_to_short(0x0123_4567_89AB_CDEF) == 0x4567_89AB
    second_era_ns = (2**32 - 2_208_988_800) * NS_PER_S
    assert (wall_to_ntp(second_era_ns - 1) >> 32, wall_to_ntp(second_era_ns)) == (2**32 - 1, 0)


@given(UINT32)
def test_delays_are_rounded_to_the_nearest(short: int) -> None:
    """A delay is converted to 1/65536 s and back with rounding to the nearest."""
    assert delay_to_short(short_to_delay_ns(short)) == short
    assert abs(short_to_delay_ns(short) * 65_536 - short * NS_PER_S) <= 32_768


def test_round_trip_of_the_rfc() -> None:
    """The round-trip time of the example in RFC 3550 (figure 2) is 6.125 s."""
    assert round_trip_ns(0xB710_8000, 0xB705_2000, 5_250_000_000) == 6_125_000_000


STEP_NS = -(-NS_PER_S // 65_536)


@given(CLOCK_NS, st.integers(0, 59 * NS_PER_S), st.integers(0, 65_000 * NS_PER_S))
def test_both_sides_know_the_round_trip_time(sent_ns: int, trip_ns: int, answer_delay_ns: int) -> None:
    """Each side's round-trip time is wrong by at most two steps of 1/65536 s, also when the short format wraps."""
    arrived_ns = sent_ns + trip_ns + answer_delay_ns
    by_wall_clock, by_receiver_clock = ntp_to_short(wall_to_ntp(sent_ns)), ntp_to_short(elapsed_to_ntp(sent_ns))
    sender_result_ns = round_trip_ns(ntp_to_short(wall_to_ntp(arrived_ns)), by_wall_clock, answer_delay_ns)
    answer = ReferenceAnswer(1, by_receiver_clock, answer_delay_ns)
    receiver_result_ns = round_trip_of_answer_ns(answer, arrived_ns)
    for sent_short, computed_ns in ((by_wall_clock, sender_result_ns), (by_receiver_clock, receiver_result_ns)):
        if sent_short == 0:
            assert computed_ns is None
        else:
            assert computed_ns is not None
            assert abs(computed_ns - trip_ns) <= 2 * STEP_NS


def test_impossible_round_trips() -> None:
    """There is no round-trip time before the first report, and none above 60 s or negative by over a step."""
    assert round_trip_ns(2**31, 0, 0) is None
    assert round_trip_ns(100, 100, 2 * STEP_NS) is None
    assert round_trip_ns(100, 100, STEP_NS) == 0
    assert round_trip_ns(1 + 60 * 65_536, 1, 0) == 60 * NS_PER_S
    assert round_trip_ns(2 + 60 * 65_536, 1, 0) is None
    assert round_trip_ns(65_535, 2**32 - 1, 0) == NS_PER_S


def test_rtp_and_rtcp_are_distinguished() -> None:
    """RTP of our payload type, with and without marker, and other datagrams are not RTCP."""
    for marker in (False, True):
        datagram = RtpPacket(96, 1, 2, 3, marker, b"").to_bytes()
        assert not is_rtcp(datagram)
    for other in (b"", b"LAVT" + bytes(20), b"\x80\x60"):
        assert not is_rtcp(other)
