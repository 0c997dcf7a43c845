from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import astuple

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.rtp.adaptive_hold import MIN_HOLD_NS
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.ntp_time import elapsed_to_ntp, ntp_to_short
from lavt.transport.rtp.reception_stats import Reception, ReceptionSample
from lavt.transport.rtp.rtcp import Announcement, SenderReport
from lavt.transport.rtp.rtcp_xr import ReferenceAnswer
from lavt.transport.rtp.rtp import RtpPacket

SSRC = 7


class ReceivedStream:
    """Reception statistics with a jitter buffer, used as the receiver node does."""

    def __init__(self) -> None:
        self.jitter_buffer = JitterBuffer()
        self.reception = Reception(self.jitter_buffer)

    def arrive(self, sequence: int, at_ns: int, timestamp: int = 0, ssrc: int = SSRC) -> None:
        """Push a packet from the network."""
        packet = RtpPacket(96, sequence % 2**16, timestamp % 2**32, ssrc, False, b"")
        self.jitter_buffer.push(packet, at_ns)
        self.reception.note_packet(packet, at_ns)

    def recover(self, sequence: int, at_ns: int) -> None:
        """Push a recovered packet."""
        self.jitter_buffer.push_recovered(RtpPacket(96, sequence % 2**16, 0, SSRC, False, b""), at_ns)

    def start(self, first: int, count: int = 1) -> None:
        """Push the first packets in order, and let their hold expire."""
        for number in range(first, first + count):
            self.arrive(number, 0)
        self.jitter_buffer.expire(MIN_HOLD_NS)


def losses(stream: ReceivedStream, at_ns: int) -> tuple[int, float, int]:
    """Return the highest sequence number, the lost fraction and the cumulative losses of a report."""
    report = stream.reception.report(at_ns)
    assert report is not None
    return report.highest_sequence, report.lost_fraction, report.cumulative_lost


def sample(stream: ReceivedStream, at_ns: int) -> tuple[int, ...]:
    """Return packets, lost before repair, recovered, lost after repair, reordered, late and duplicate."""
    return astuple(stream.reception.sample(at_ns))[1:-2]


def test_before_the_first_packet() -> None:
    """Before the first packet there is no report, and a sample is empty and has no duration."""
    stream = ReceivedStream()
    assert stream.reception.report(NS_PER_S) is None
    assert stream.reception.sample(NS_PER_S) == ReceptionSample(0, 0, 0, 0, 0, 0, 0, 0, 0, None)


def test_samples_follow_each_other() -> None:
    """The first sample begins with the first packet, each later one at the end of the previous sample."""
    stream = ReceivedStream()
    stream.reception.sample(NS_PER_S)
    stream.arrive(1, 2 * NS_PER_S)
    assert stream.reception.sample(3 * NS_PER_S).duration_ns == NS_PER_S
    assert stream.reception.sample(5 * NS_PER_S) == ReceptionSample(2 * NS_PER_S, 0, 0, 0, 0, 0, 0, 0, 0, None)


def test_loss_without_repair() -> None:
    """A packet that never arrives is lost before and after repair, once its hold has expired."""
    stream = ReceivedStream()
    stream.start(100, 5)
    assert losses(stream, MIN_HOLD_NS) == (104, 0.0, 0)
    for number in (105, 107, 108):
        stream.arrive(number, 20 * NS_PER_MS)
    assert losses(stream, 20 * NS_PER_MS) == (108, 0.0, 0)
    stream.jitter_buffer.expire(30 * NS_PER_MS)
    stream.arrive(109, 31 * NS_PER_MS)
    assert losses(stream, 31 * NS_PER_MS) == (109, 1 / 2, 1)
    assert losses(stream, 32 * NS_PER_MS) == (109, 0.0, 1)
    assert sample(stream, 33 * NS_PER_MS) == (9, 1, 0, 1, 0, 0, 0)


def test_a_recovered_packet_is_lost_before_repair_only() -> None:
    """A recovered packet is among the losses in the report and before repair, but not among those after repair."""
    stream = ReceivedStream()
    stream.start(0, 2)
    stream.arrive(3, 20 * NS_PER_MS)
    stream.recover(2, 21 * NS_PER_MS)
    stream.recover(4, 21 * NS_PER_MS)
    assert losses(stream, 22 * NS_PER_MS) == (4, 2 / 5, 2)
    assert sample(stream, 22 * NS_PER_MS) == (3, 2, 2, 0, 0, 0, 0)


def test_the_original_after_its_recovery() -> None:
    """A packet that arrives after it was recovered is a duplicate, and no longer lost."""
    stream = ReceivedStream()
    stream.start(0, 2)
    stream.arrive(3, 20 * NS_PER_MS)
    stream.recover(2, 21 * NS_PER_MS)
    assert sample(stream, 22 * NS_PER_MS) == (3, 1, 1, 0, 0, 0, 0)
    assert losses(stream, 22 * NS_PER_MS) == (3, 1 / 4, 1)
    stream.arrive(2, 23 * NS_PER_MS)
    assert sample(stream, 23 * NS_PER_MS) == (1, -1, 0, 0, 0, 0, 1)
    assert losses(stream, 23 * NS_PER_MS) == (3, 0.0, 0)


def test_useless_recovery_is_not_counted() -> None:
    """A packet that is recovered after it was given up, or that is present already, is not counted."""
    stream = ReceivedStream()
    stream.start(0, 2)
    stream.arrive(3, 20 * NS_PER_MS)
    stream.jitter_buffer.expire(30 * NS_PER_MS)
    stream.recover(2, 31 * NS_PER_MS)
    stream.recover(3, 31 * NS_PER_MS)
    assert sample(stream, 32 * NS_PER_MS) == (3, 1, 0, 1, 0, 0, 0)


def test_reordered_late_and_duplicate() -> None:
    """A late packet is among the losses after repair, although it arrived; a reordered packet is not."""
    stream = ReceivedStream()
    stream.start(0, 2)
    stream.arrive(3, 20 * NS_PER_MS)
    stream.arrive(2, 25 * NS_PER_MS)
    assert sample(stream, 25 * NS_PER_MS) == (4, 0, 0, 0, 1, 0, 0)
    stream.arrive(5, 40 * NS_PER_MS)
    stream.jitter_buffer.expire(50 * NS_PER_MS)
    assert sample(stream, 50 * NS_PER_MS) == (1, 1, 0, 1, 0, 0, 0)
    stream.arrive(4, 51 * NS_PER_MS)
    stream.arrive(5, 51 * NS_PER_MS)
    assert sample(stream, 52 * NS_PER_MS) == (2, -2, 0, 0, 0, 1, 1)
    assert losses(stream, 52 * NS_PER_MS) == (5, 0.0, -1)


def test_the_share_of_lost_packets() -> None:
    """Of five expected packets, one is recovered and one is lost, a fifth; its late arrival is no expected packet."""
    stream = ReceivedStream()
    stream.start(0, 2)
    stream.arrive(4, 20 * NS_PER_MS)
    stream.recover(3, 21 * NS_PER_MS)
    stream.jitter_buffer.expire(30 * NS_PER_MS)
    assert stream.reception.sample(30 * NS_PER_MS).lost_share == 1 / 5
    stream.arrive(2, 31 * NS_PER_MS)
    assert stream.reception.sample(32 * NS_PER_MS).lost_share is None
    stream.arrive(5, 40 * NS_PER_MS)
    assert stream.reception.sample(41 * NS_PER_MS).lost_share == 0.0


PACKET_FATES = {
    "arrives": [("arrive", 0)],
    "twice": [("arrive", 0), ("arrive", 2)],
    "reordered": [("arrive", 5)],
    "late": [("arrive", 40)],
    "lost": [],
    "recovered": [("recover", 3)],
    "recovered late": [("recover", 40)],
    "recovered before arrival": [("recover", 3), ("arrive", 6)],
    "recovered after arrival": [("arrive", 3), ("recover", 6)],
}
"""What can happen to a packet: its events, each with its delay in ms."""
PERIOD_FATES = st.lists(st.sampled_from(sorted(PACKET_FATES)), max_size=20).map(lambda fates: [*fates, "arrives"])


@given(st.integers(0, 2**16 - 1), st.lists(PERIOD_FATES, min_size=1, max_size=4))
def test_losses_match_the_rfc(first: int, periods: list[list[str]]) -> None:
    """For any events the report has the values that the program of RFC 3550, A.3, computes."""
    stream = ReceivedStream()
    stream.start(first)
    number, at_ms, received = first, 20, 1
    expected_prior, received_prior = 0, 0
    for fates in periods:
        events = []
        for fate in fates:
            number, at_ms = number + 1, at_ms + 1
            events += [(at_ms + after_ms, kind, number) for kind, after_ms in PACKET_FATES[fate]]
        for event_ms, kind, event_number in sorted(events):
            stream.jitter_buffer.expire(event_ms * NS_PER_MS)
            {"arrive": stream.arrive, "recover": stream.recover}[kind](event_number, event_ms * NS_PER_MS)
            received += kind == "arrive"
        at_ms += 100
        stream.jitter_buffer.expire(at_ms * NS_PER_MS)
        expected = number - first + 1
        expected_interval, expected_prior = expected - expected_prior, expected
        received_interval, received_prior = received - received_prior, received
        lost_interval = expected_interval - received_interval
        fraction = 0 if lost_interval <= 0 else (lost_interval << 8) // expected_interval
        highest, lost_fraction, cumulative = losses(stream, at_ms * NS_PER_MS)
        assert (highest, int(lost_fraction * 256), cumulative) == (number, fraction, expected - received)


def test_jitter_by_hand() -> None:
    """Each packet, also within a frame, moves the jitter by a sixteenth towards the change of transit time."""
    stream = ReceivedStream()
    stream.arrive(1, 0, timestamp=0)
    stream.arrive(2, 1_100_000, timestamp=0)  # 99 units of 1/90000 s later, in the same frame
    stream.arrive(3, 34_433_334, timestamp=3000)  # exactly one frame period (3000 units) later
    report = stream.reception.report(0)
    assert report is not None
    jitter = 99 / 16 * 15 / 16
    assert report.jitter == int(jitter) == 5
    assert stream.reception.sample(NS_PER_S).jitter_us == round(jitter * 1e6 / 90_000) == 64


@given(
    st.lists(st.tuples(st.integers(0, 10**8), st.integers(-(2**31), 2**31)), min_size=1, max_size=30),
    st.integers(0, 2**62),
)
def test_jitter_matches_the_rfc(packets: list[tuple[int, int]], begin_ns: int) -> None:
    """The jitter is the value that the program of RFC 3550, A.8, computes, across the wraps of both clocks."""
    stream = ReceivedStream()
    at_ns, timestamp, transit, jitter = begin_ns, 0, None, 0.0
    for number, (pause_ns, step) in enumerate(packets):
        at_ns, timestamp = at_ns + pause_ns, timestamp + step
        stream.arrive(number, at_ns, timestamp)
        arrival = int.from_bytes((at_ns * 90_000 // NS_PER_S).to_bytes(12, "big")[-4:], "big")
        before, transit = transit, (arrival - timestamp) & 0xFFFF_FFFF
        if before is not None:
            difference = int.from_bytes(((transit - before) & 0xFFFF_FFFF).to_bytes(4, "big"), "big", signed=True)
            jitter += 1 / 16 * (abs(difference) - jitter)
    report = stream.reception.report(at_ns)
    assert report is not None
    assert abs(report.jitter - int(jitter)) <= 1


def test_sequence_numbers_wrap() -> None:
    """The highest sequence number includes the wraps."""
    stream = ReceivedStream()
    stream.start(65_534, 4)
    assert losses(stream, MIN_HOLD_NS) == (65_537, 0.0, 0)


def test_sender_report_comes_back() -> None:
    """A reception report has the time of the last sender report, in short format, and the time since its arrival."""
    stream = ReceivedStream()
    stream.arrive(1, 0)
    report = stream.reception.report(NS_PER_S)
    assert report is not None
    assert (report.last_report, report.last_report_age_ns) == (0, 0)
    stream.reception.note_announcement(Announcement((SenderReport(SSRC, 0x0123_4567_89AB_CDEF, 0, 0, 0),)), 1, NS_PER_S)
    report = stream.reception.report(NS_PER_S + 250 * NS_PER_MS)
    assert report is not None
    assert (report.last_report, report.last_report_age_ns) == (0x4567_89AB, 250 * NS_PER_MS)
    stream.reception.note_announcement(
        Announcement((SenderReport(SSRC + 1, 0x0123_4567_89AB_CDEF, 0, 0, 0),)), 1, NS_PER_S
    )
    report = stream.reception.report(2 * NS_PER_S)
    assert report is not None
    assert report.last_report == 0


def test_a_round_trip_time_of_less_than_a_step() -> None:
    """A round-trip time of less than one step (1/65536 s) is 0, and not None."""
    reception = Reception(JitterBuffer())
    sent_ns = 5 * NS_PER_S
    answer = ReferenceAnswer(1, ntp_to_short(elapsed_to_ntp(sent_ns)), 0)
    reception.note_announcement(Announcement((), (answer,)), 1, sent_ns + 1000)
    assert reception.round_trip_ns == 0


def test_an_answer_gives_the_round_trip_time() -> None:
    """The sender's answer to our reference time gives the round-trip time; an answer to another receiver does not."""
    stream = ReceivedStream()
    stream.arrive(1, 0)
    sent_ns, answer_delay_ns = 100 * NS_PER_S, 300 * NS_PER_MS
    sent_short = ntp_to_short(elapsed_to_ntp(sent_ns))
    arrived_ns = sent_ns + answer_delay_ns + 80 * NS_PER_MS
    stream.reception.note_announcement(
        Announcement((), (ReferenceAnswer(6, sent_short, answer_delay_ns),)), 5, arrived_ns
    )
    assert stream.reception.round_trip_ns is None
    stream.reception.note_announcement(
        Announcement((), (ReferenceAnswer(5, sent_short, answer_delay_ns),)), 5, arrived_ns
    )
    assert stream.reception.round_trip_ns is not None
    assert abs(stream.reception.round_trip_ns - 80 * NS_PER_MS) < 50_000, "three steps of 1/65536 s"
    assert stream.reception.sample(arrived_ns).round_trip_us == stream.reception.round_trip_ns // 1000


def test_another_stream_begins_new_reports() -> None:
    """A report covers one SSRC; samples continue across streams."""
    stream = ReceivedStream()
    stream.start(0, 2)
    stream.arrive(3, 20 * NS_PER_MS, timestamp=10**6)
    stream.arrive(5, 20 * NS_PER_MS)
    stream.arrive(1000, 21 * NS_PER_MS, timestamp=10**9, ssrc=8)
    report = stream.reception.report(22 * NS_PER_MS)
    assert report is not None
    assert (report.media_ssrc, *losses(stream, 0), report.jitter) == (8, 1000, 0.0, 0, 0)
    assert report.lost_fraction == 0.0
    assert sample(stream, NS_PER_S) == (5, 2, 0, 2, 0, 0, 0)


def test_a_stray_packet_is_not_counted() -> None:
    """A stray packet is not counted; when a consecutive packet follows it, both packets are counted."""
    stream = ReceivedStream()
    stream.start(0, 2)
    stream.arrive(30_000, 20 * NS_PER_MS, timestamp=10**9)
    report = stream.reception.report(20 * NS_PER_MS)
    assert report is not None
    assert (report.highest_sequence, report.jitter) == (1, 0)
    assert sample(stream, 20 * NS_PER_MS)[0] == 2
    stream.arrive(30_001, 20 * NS_PER_MS, timestamp=0)
    assert sample(stream, 30 * NS_PER_MS)[0] == 2
    assert losses(stream, 30 * NS_PER_MS)[0] == 30_001
