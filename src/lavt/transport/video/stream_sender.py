"""Sender of a video stream: it makes media packets, repair packets as needed, and sender reports; it reads feedback."""

from __future__ import annotations

from typing import Final

from msgspec import Struct

from lavt.domain import NS_PER_MS, Now
from lavt.transport.rtp.fec import RedundancyController, RepairSender
from lavt.transport.rtp.rtcp import BitRateLimit, Feedback, ReceptionReport, sender_report
from lavt.transport.rtp.rtcp_xr import ReferenceAnswer, ReferenceTime
from lavt.transport.rtp.rtp import MAX_PACKET_BYTES, RTP_HEADER_BYTES, Packetizer
from lavt.transport.video.stamp import rtp_timestamp

REPORT_PERIOD_NS: Final = 500 * NS_PER_MS
"""Period of sender reports; RFC 3550 (section 6.2) allows it, because they are a small share of the stream."""


class FramePackets(Struct, frozen=True):
    """The datagrams of a frame. Plain receivers get only `media` and `report`, which every tool understands."""

    media: list[bytes]
    repair: list[bytes]
    report: list[bytes]
    """A sender report, if one is due."""


class StreamSender:
    """A sender that makes the datagrams of one stream and handles its receiver's feedback.

    `repair_packets` is the number of repair packets for each block of a frame; None: the number follows the reported
    loss. Public: `bit_rate_limit_bps`, the receiver's limit for the encoder, or None.
    """

    def __init__(self, packetizer: Packetizer, repairs: RepairSender, repair_packets: int | None = None) -> None:
        self._packetizer = packetizer
        self._repairs = repairs
        self._repair_packets = repair_packets
        self._packets = self._octets = 0
        self._next_report_ns = 0
        self.forget_receiver()

    def forget_receiver(self) -> None:
        """Discard the feedback of the previous receiver, because the next feedback can come from another one."""
        self.bit_rate_limit_bps: int | None = None
        self._redundancy = RedundancyController()
        self._reported: ReceptionReport | None = None
        self._reference: tuple[ReferenceTime, int] | None = None
        """The last reference time of the receiver that was not answered yet, and when it arrived."""

    def make_packets(self, access_unit: bytes, stamp_ns: int, now: Now) -> FramePackets:
        """Return the datagrams of a frame that was stamped at `stamp_ns` of the wall clock."""
        timestamp = rtp_timestamp(stamp_ns)
        media = self._packetizer.packetize(access_unit, timestamp)
        count = self._redundancy.repair_packets(now.mono_ns) if self._repair_packets is None else self._repair_packets
        repair = self._repairs.make_repair_packets(media, count) if count else []
        self._packets += len(media)
        self._octets += sum(map(len, media)) - RTP_HEADER_BYTES * len(media)
        report = []
        if now.mono_ns >= self._next_report_ns:
            self._next_report_ns = now.mono_ns + REPORT_PERIOD_NS
            report.append(self._report(now))
        return FramePackets(media, repair, report)

    def receive_feedback(self, feedback: Feedback, now_ns: int) -> None:
        """Handle feedback of the receiver."""
        ssrc = self._packetizer.ssrc
        for report in feedback.reports:
            if report.media_ssrc == ssrc:
                self._note_loss(report, now_ns)
        for limit in feedback.limits:
            if limit.media_ssrc == ssrc:
                self.bit_rate_limit_bps = _payload_bit_rate_bps(limit)
        if feedback.reference_times:
            self._reference = feedback.reference_times[-1], now_ns

    def _report(self, now: Now) -> bytes:
        """Write a sender report: the current wall time and its RTP timestamp (RFC 3550, section 6.4.1)."""
        answers = []
        if self._reference is not None:
            reference, arrived_ns = self._reference
            answers.append(ReferenceAnswer(reference.receiver_ssrc, reference.time, now.mono_ns - arrived_ns))
            self._reference = None
        ssrc = self._packetizer.ssrc
        return sender_report(
            ssrc,
            wall_ns=now.wall_ns,
            rtp_timestamp=rtp_timestamp(now.wall_ns),
            packets=self._packets,
            octets=self._octets,
            cname=f"{ssrc:08x}@lavt",
            answered=answers,
        )

    def _note_loss(self, report: ReceptionReport, now_ns: int) -> None:
        """Note the losses since the previous report; the first report and a report out of order give none."""
        previous, self._reported = self._reported, report
        if previous is None:
            return
        expected = (report.highest_sequence - previous.highest_sequence) % 2**32
        if 0 < expected < 2**31:
            lost = min(max(report.cumulative_lost - previous.cumulative_lost, 0), expected)
            self._redundancy.note_loss(lost, expected, now_ns)
        elif expected:  # out of order: the next report is compared with the newer one
            self._reported = previous


def _payload_bit_rate_bps(limit: BitRateLimit) -> int:
    """Return a limit for the payload alone, from a limit that includes the headers of each packet."""
    payload_bytes = MAX_PACKET_BYTES - RTP_HEADER_BYTES
    return limit.bit_rate_bps * payload_bytes // (payload_bytes + limit.overhead_bytes)
