"""How a video stream arrives: the statistics of RFC 3550 for the sender, and those of each second for the record.

Loss is counted twice. Before repair a packet is lost that did not arrive, whether or not it was made again (RFC 5725,
section 3); after repair one that the decoder had to do without.
"""

from __future__ import annotations

from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.ntp_time import short_time
from lavt.transport.rtp.rtcp import Announcement, ReceptionReport, SenderReport
from lavt.transport.rtp.rtcp_xr import answered_round_trip_ns
from lavt.transport.rtp.rtp import RtpPacket
from lavt.value import value


@value
class ReceptionSample:
    """How the stream arrived between two samples; what is no time is in packets and adds up over the samples."""

    duration_ns: int
    """Since the sample before, or since the beginning; 0 where no packet has come yet."""
    packets: int
    """That arrived, duplicates and late ones included, strays and repair packets not."""
    lost_before_repair: int
    """Expected less arrived (RFC 3550, A.3): late ones and duplicates count against it and can make it negative."""
    recovered: int
    """Made again from repair packets while they were waited for."""
    lost_after_repair: int
    """Given up, also where they came later."""
    reordered: int
    """Overtaken by others, but in time."""
    late: int
    """Came after they had been given up."""
    duplicate: int
    """Came twice, or after they had been made again."""
    jitter_us: int
    """At the end (RFC 3550, section 6.4.1). A frame's packets share a timestamp, so the spacing of these is in it."""
    round_trip_us: int | None
    """The last one known at the end: of a report to the sender, and of the sender's report that answers it."""


class Reception:
    """Keeps the statistics of a stream whose packets go through `reorder`, in whose counters the losses are.

    Public: `round_trip_ns`, None before the sender has answered a report.
    """

    def __init__(self, reorder: JitterBuffer) -> None:
        self.round_trip_ns: int | None = None
        self._reorder = reorder
        self._packets = 0
        self._strays = reorder.stray
        self._ssrc: int | None = None
        self._transit: int | None = None
        self._jitter = 0.0
        self._packets_reported = 0
        self._lost_reported = 0
        self._lost_before_stream = 0
        self._sender_report: tuple[SenderReport, int] | None = None
        self._sampled_ns: int | None = None
        self._sampled = self._totals()

    def received(self, packet: RtpPacket, arrived_ns: int) -> None:
        """Count a packet of the stream that came from the network, after the reorder buffer has taken it.

        Packets that were made again are not given here.
        """
        self._packets += 1
        if packet.ssrc != self._ssrc:
            self._begin(packet.ssrc, arrived_ns)
        strays, self._strays = self._strays, self._reorder.stray
        if self._strays <= strays:
            self._note_transit(packet.timestamp, arrived_ns)

    def note_announcement(self, announcement: Announcement, receiver_ssrc: int | None, arrived_ns: int) -> None:
        """Take what a sender says, on the clock of our reports: the round trip, where it answers one of ours.

        Its report is for the round trip that the sender will know from our next one.
        """
        for report in announcement.reports:
            self._sender_report = report, arrived_ns
        for answer in announcement.answers:
            if answer.receiver_ssrc == receiver_ssrc:
                round_trip_ns = answered_round_trip_ns(answer, arrived_ns)
                self.round_trip_ns = self.round_trip_ns if round_trip_ns is None else round_trip_ns

    def report(self, now_ns: int) -> ReceptionReport | None:
        """Give the reception report since the one before (RFC 3550, A.3); None before the first packet."""
        if self._ssrc is None:
            return None
        packets, lost = self._arrived(), self._lost_before_repair()
        lost_since = lost - self._lost_reported
        expected_since = packets - self._packets_reported + lost_since
        self._packets_reported, self._lost_reported = packets, lost
        last, age_ns = 0, 0
        if self._sender_report is not None and self._sender_report[0].ssrc == self._ssrc:
            sent, arrived_ns = self._sender_report
            last, age_ns = short_time(sent.ntp_time), now_ns - arrived_ns
        return ReceptionReport(
            self._ssrc,
            self._reorder.highest_sequence,
            lost_since / expected_since if lost_since > 0 else 0.0,
            lost - self._lost_before_stream,
            int(self._jitter),
            last,
            age_ns,
        )

    def sample(self, now_ns: int) -> ReceptionSample:
        """Give what has happened since the sample before."""
        totals = self._totals()
        since = {name: total - self._sampled[name] for name, total in totals.items()}
        self._sampled = totals
        duration_ns = 0
        if self._sampled_ns is not None:
            duration_ns, self._sampled_ns = now_ns - self._sampled_ns, now_ns
        round_trip_us = None if self.round_trip_ns is None else self.round_trip_ns // 1000
        return ReceptionSample(
            duration_ns=duration_ns, jitter_us=round(self._jitter * 100 / 9), round_trip_us=round_trip_us, **since
        )

    def _begin(self, ssrc: int, arrived_ns: int) -> None:
        """Begin a stream: a report is about one only."""
        self._ssrc = ssrc
        self._transit, self._jitter = None, 0.0
        self._packets_reported = self._arrived() - 1
        self._lost_before_stream = self._lost_reported = self._lost_before_repair()
        if self._sampled_ns is None:
            self._sampled_ns = arrived_ns

    def _arrived(self) -> int:
        return self._packets - self._reorder.stray

    def _lost_before_repair(self) -> int:
        """Give expected less arrived, from the counters: it goes on when the sender moves its sequence numbers."""
        counters = self._reorder
        return counters.lost - counters.late + counters.recovered - counters.duplicate

    def _totals(self) -> dict[str, int]:
        counters = self._reorder
        return {
            "packets": self._arrived(),
            "lost_before_repair": self._lost_before_repair(),
            "recovered": counters.recovered,
            "lost_after_repair": counters.lost,
            "reordered": counters.reordered,
            "late": counters.late,
            "duplicate": counters.duplicate,
        }

    def _note_transit(self, timestamp: int, arrived_ns: int) -> None:
        """Keep the jitter over all packets as they arrive, in ticks of the RTP clock (RFC 3550, A.8)."""
        transit = (arrived_ns * 9 // 100_000 - timestamp) % 2**32
        if self._transit is not None:
            difference = (transit - self._transit + 2**31) % 2**32 - 2**31
            self._jitter += (abs(difference) - self._jitter) / 16
        self._transit = transit
