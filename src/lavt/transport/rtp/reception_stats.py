"""Reception statistics of a video stream: reports to the sender as in RFC 3550, and samples for the record.

Loss is counted twice. Before repair, a packet is lost if it did not arrive, whether or not it was recovered (RFC 5725,
section 3); after repair, a packet is lost if the decoder did not get it.
"""

from __future__ import annotations

from msgspec import Struct

from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.ntp_time import ntp_to_short
from lavt.transport.rtp.rtcp import Announcement, ReceptionReport, SenderReport
from lavt.transport.rtp.rtcp_xr import round_trip_of_answer_ns
from lavt.transport.rtp.rtp import RtpPacket


class ReceptionSample(Struct, frozen=True):
    """Reception between two samples. Counts are in packets since the previous sample, so their sums are totals."""

    duration_ns: int
    """Time since the previous sample, or since the stream began; 0 before the first packet."""
    packets: int
    """Packets that arrived, including duplicates and late packets. Repair packets and strays are not counted; a stray
    is an isolated packet whose sequence number is far from all others."""
    lost_before_repair: int
    """Expected packets minus arrived packets (RFC 3550, A.3); late packets and duplicates can make it negative."""
    recovered: int
    """Packets recovered from repair packets within their hold."""
    lost_after_repair: int
    """Packets given up, including those that arrived later."""
    reordered: int
    """Packets that arrived after later ones, but within their hold."""
    late: int
    """Packets that arrived after they had been given up."""
    duplicate: int
    """Packets that arrived twice, or after they had been recovered."""
    jitter_us: int
    """Jitter at the time of the sample (RFC 3550, section 6.4.1). It includes the spacing of a frame's packets, which
    share a timestamp."""
    round_trip_us: int | None
    """Last known round-trip time, from a report to the sender and the sender's answer to this report."""

    @property
    def lost_share(self) -> float | None:
        """The share of the expected packets that were given up (after repair); None if no packet was expected."""
        expected = self.packets + self.lost_before_repair
        return self.lost_after_repair / expected if expected > 0 else None


class Reception:
    """Reception statistics of a stream; the losses come from the counters of its `jitter_buffer`.

    Public: `round_trip_ns`, the round-trip time; None before the sender has answered a report.
    """

    def __init__(self, jitter_buffer: JitterBuffer) -> None:
        self.round_trip_ns: int | None = None
        self._jitter_buffer = jitter_buffer
        self._packets = 0
        self._strays = jitter_buffer.stray
        self._ssrc: int | None = None
        self._transit: int | None = None
        self._jitter = 0.0
        self._packets_reported = 0
        self._lost_reported = 0
        self._lost_before_stream = 0
        self._sender_report: tuple[SenderReport, int] | None = None
        """The last sender report, and when it arrived."""
        self._sampled_ns: int | None = None
        """When the last sample was taken; before that, when the stream began."""
        self._sampled_totals = self._totals()

    def note_packet(self, packet: RtpPacket, arrived_ns: int) -> None:
        """Count a packet that arrived from the network. Call it after the jitter buffer's `push`.

        Do not call it for recovered packets.
        """
        self._packets += 1
        if packet.ssrc != self._ssrc:
            self._begin_stream(packet.ssrc, arrived_ns)
        strays_before, self._strays = self._strays, self._jitter_buffer.stray
        if self._strays <= strays_before:  # this packet is not a stray
            self._note_transit(packet.timestamp, arrived_ns)

    def note_announcement(self, announcement: Announcement, receiver_ssrc: int | None, arrived_ns: int) -> None:
        """Note the contents of a sender's datagram; `arrived_ns` is on the clock of this receiver's reports.

        An answer to one of this receiver's reports gives `round_trip_ns`. The receiver's next report returns the time
        of the last sender report, so that the sender can compute the round-trip time, too.
        """
        for report in announcement.reports:
            self._sender_report = report, arrived_ns
        for answer in announcement.answers:
            if answer.receiver_ssrc == receiver_ssrc:
                round_trip_ns = round_trip_of_answer_ns(answer, arrived_ns)
                self.round_trip_ns = self.round_trip_ns if round_trip_ns is None else round_trip_ns

    def report(self, now_ns: int) -> ReceptionReport | None:
        """Return the reception report since the previous one (RFC 3550, A.3); None before the first packet."""
        if self._ssrc is None:
            return None
        packets, lost = self._arrived(), self._lost_before_repair()
        lost_since = lost - self._lost_reported
        expected_since = packets - self._packets_reported + lost_since
        self._packets_reported, self._lost_reported = packets, lost
        last, age_ns = 0, 0
        if self._sender_report is not None:
            sender_report, arrived_ns = self._sender_report
            if sender_report.ssrc == self._ssrc:
                last, age_ns = ntp_to_short(sender_report.ntp_time), now_ns - arrived_ns
        return ReceptionReport(
            self._ssrc,
            self._jitter_buffer.highest_sequence,
            lost_since / expected_since if lost_since > 0 else 0.0,
            lost - self._lost_before_stream,
            int(self._jitter),
            last,
            age_ns,
        )

    def sample(self, now_ns: int) -> ReceptionSample:
        """Return the reception since the previous sample."""
        totals = self._totals()
        since = {name: total - self._sampled_totals[name] for name, total in totals.items()}
        self._sampled_totals = totals
        duration_ns = 0
        if self._sampled_ns is not None:
            duration_ns, self._sampled_ns = now_ns - self._sampled_ns, now_ns
        round_trip_us = None if self.round_trip_ns is None else self.round_trip_ns // 1000
        return ReceptionSample(
            duration_ns=duration_ns,
            jitter_us=round(self._jitter * 100 / 9),  # a tick of the RTP clock (90 kHz) is 100 / 9 us
            round_trip_us=round_trip_us,
            **since,
        )

    def _begin_stream(self, ssrc: int, arrived_ns: int) -> None:
        """Begin the statistics of another stream, because a report covers one stream only."""
        self._ssrc = ssrc
        self._transit, self._jitter = None, 0.0
        self._packets_reported = self._arrived() - 1  # the first packet belongs to the first report
        self._lost_before_stream = self._lost_reported = self._lost_before_repair()
        if self._sampled_ns is None:
            self._sampled_ns = arrived_ns

    def _arrived(self) -> int:
        return self._packets - self._jitter_buffer.stray

    def _lost_before_repair(self) -> int:
        """Return the number of expected packets minus the number of arrived packets.

        It is computed from counters, so that a jump of the sequence numbers does not change it.
        """
        counters = self._jitter_buffer
        return counters.lost - counters.late + counters.recovered - counters.duplicate

    def _totals(self) -> dict[str, int]:
        counters = self._jitter_buffer
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
        """Update the jitter, in ticks of the RTP clock, with the transit time of a packet (RFC 3550, A.8)."""
        transit = (arrived_ns * 9 // 100_000 - timestamp) % 2**32
        if self._transit is not None:
            difference = (transit - self._transit + 2**31) % 2**32 - 2**31
            self._jitter += (abs(difference) - self._jitter) / 16
        self._transit = transit
