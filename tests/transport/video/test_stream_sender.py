from __future__ import annotations

import pytest
from tests.nodes.stand_ins import at

from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.transport.rtp.fec import RepairSender
from lavt.transport.rtp.ntp_time import elapsed_to_ntp, ntp_to_short
from lavt.transport.rtp.rtcp import BitRateLimit, Feedback, ReceptionReport, parse_announcement
from lavt.transport.rtp.rtcp_xr import ReferenceTime, round_trip_of_answer_ns
from lavt.transport.rtp.rtp import MAX_PACKET_BYTES, RTP_HEADER_BYTES, Packetizer
from lavt.transport.video.stamp import rtp_timestamp
from lavt.transport.video.stream_sender import StreamSender

UNIT = b"\x00\x00\x00\x01\x65" + bytes([9] * 5000)
SSRC, OTHER_SSRC = 5, 6


def new_sender(repair_packets: int | None = None) -> StreamSender:
    return StreamSender(Packetizer(SSRC, 65_000), RepairSender(7, 0), repair_packets)


def count_repairs(sender: StreamSender, at_ns: int) -> int:
    return len(sender.packets(UNIT, at(at_ns).wall_ns, at(at_ns)).repair)


def report_loss(sender: StreamSender, highest_sequence: int, lost: int, at_ns: int, ssrc: int = SSRC) -> None:
    sender.receive_feedback(Feedback((ReceptionReport(ssrc, highest_sequence, 0.0, lost, 0),)), at(at_ns).mono_ns)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_fixed_number_of_repair_packets(count: int) -> None:
    """A configured number of repair packets does not depend on the reported loss."""
    sender = new_sender(count)
    report_loss(sender, 100, 0, 0)
    report_loss(sender, 200, 50, 1)
    assert count_repairs(sender, 2) == count


def test_repair_packets_by_the_reported_loss() -> None:
    """A block gets no repair packet without loss, one after a loss, two during heavy loss, and none 30 s after it."""
    sender = new_sender()
    report_loss(sender, 10_000, 0, 0)
    assert count_repairs(sender, 1) == 0
    report_loss(sender, 10_300, 1, NS_PER_S)
    assert count_repairs(sender, NS_PER_S + 1) == 1
    report_loss(sender, 10_400, 21, 2 * NS_PER_S)
    assert count_repairs(sender, 2 * NS_PER_S + 1) == 2
    assert count_repairs(sender, 8 * NS_PER_S) == 1
    assert count_repairs(sender, 33 * NS_PER_S) == 0


def test_losses_are_those_between_two_reports() -> None:
    """Losses before the first report, of another stream or in an old report are ignored; a wrap is not a loss."""
    sender = new_sender()
    report_loss(sender, 2**32 - 100, 5000, 0)
    assert count_repairs(sender, 1) == 0, "before the first report"
    report_loss(sender, 50, 5000, 2)
    report_loss(sender, 1000, 7000, 3, ssrc=OTHER_SSRC)
    report_loss(sender, 20, 9000, 4)
    assert count_repairs(sender, 5) == 0, "no loss after a wrap, another stream, an old report"
    report_loss(sender, 150, 5001, 6)
    assert count_repairs(sender, 7) == 1


def test_forget_receiver_resets_the_feedback() -> None:
    """Losses and the bit rate limit of the previous receiver are discarded when another receiver begins."""
    sender = new_sender()
    report_loss(sender, 100, 0, 0)
    report_loss(sender, 200, 50, 1)
    sender.receive_feedback(Feedback(limits=(BitRateLimit(SSRC, 10**6, 0),)), at(1).mono_ns)
    sender.forget_receiver()
    report_loss(sender, 100, 60, 2)
    assert count_repairs(sender, 3) == 0
    assert sender.bit_rate_limit_bps is None


def test_a_limit_applies_to_this_stream_and_to_its_payload() -> None:
    """A limit of another stream is ignored; the headers that a limit includes are subtracted."""
    sender = new_sender()
    sender.receive_feedback(Feedback(limits=(BitRateLimit(OTHER_SSRC, 10**6, 0),)), 0)
    assert sender.bit_rate_limit_bps is None
    limit_bps, overhead_bytes, payload_bytes = 10**6, 40, MAX_PACKET_BYTES - RTP_HEADER_BYTES
    sender.receive_feedback(Feedback(limits=(BitRateLimit(SSRC, limit_bps, overhead_bytes),)), 0)
    assert sender.bit_rate_limit_bps == limit_bps * payload_bytes // (payload_bytes + overhead_bytes)


def test_the_first_frame_has_a_report() -> None:
    """A sender report is due with the first frame, even if the monotonic clock is at 0."""
    assert len(new_sender().packets(UNIT, 0, Now(0, 0)).report) == 1


def test_sender_reports() -> None:
    """A sender report every 500 ms counts the packets sent until then and answers the last reference time once."""
    sender = new_sender()
    requested_ns = 7 * NS_PER_S
    sender.receive_feedback(
        Feedback(reference_times=(ReferenceTime(9, ntp_to_short(elapsed_to_ntp(requested_ns))),)), at(0).mono_ns
    )
    reports = []
    for at_ns in range(0, 1_300 * NS_PER_MS, 100 * NS_PER_MS):
        packets = sender.packets(UNIT, at(at_ns).wall_ns, at(at_ns))
        for datagram in packets.report:
            announcement = parse_announcement(datagram)
            (report,) = announcement.reports
            assert (report.ssrc, report.rtp_timestamp) == (SSRC, rtp_timestamp(at(at_ns).wall_ns))
            payload_bytes = sum(len(packet) - RTP_HEADER_BYTES for packet in packets.media)
            assert report.octets == payload_bytes * report.packets // len(packets.media)
            reports.append((at_ns // NS_PER_MS, report.packets // len(packets.media), announcement.answers))
    assert [(ms, frames, len(answers)) for ms, frames, answers in reports] == [(0, 1, 1), (500, 6, 0), (1000, 11, 0)]
    (answer,) = reports[0][2]
    assert round_trip_of_answer_ns(answer, requested_ns + 80 * NS_PER_MS) == pytest.approx(80 * NS_PER_MS, abs=50_000)
