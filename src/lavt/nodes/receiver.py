"""Step 6 of the life of a frame: packets arrive, are put in order, and become access units again."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from lavt.domain import NS_PER_MS, Now
from lavt.errors import BadPacket
from lavt.node import WAKE, Hop, Message, Send
from lavt.nodes.reports import PathToken, ReceivedUnit
from lavt.transport.reorder import ReorderBuffer
from lavt.transport.rtcp import ReceptionReport, picture_loss, receiver_report
from lavt.transport.rtp import Depacketizer, RtpPacket, parse_packet
from lavt.transport.video_path import PathClient, is_path_datagram

REPORT_PERIOD_NS = 500 * NS_PER_MS
"""Four reports within the 2 s after which the server closes a silent path."""
PICTURE_LOSS_PAUSE_NS = 100 * NS_PER_MS
SSRC = 0x4C415654
"""Of the receiver in its reports: "LAVT"."""


class ReceiverNode:
    """Opens the path of the video, keeps it open with receiver reports, and asks for a keyframe after a loss."""

    name = "receiver"

    def __init__(self, reorder: ReorderBuffer, depacketizer: Depacketizer) -> None:
        self._counts: Counter[str] = Counter()
        self._reorder = reorder
        self._depacketizer = depacketizer
        self._path: PathClient | None = None
        self._token = b""
        self._port = 0
        self._report_ns = 0
        self._picture_loss_ns = 0
        self._media_ssrc: int | None = None
        self._packets_since_report = 0
        self._lost_at_report = 0
        self._transit: int | None = None
        self._jitter = 0.0
        self.chains: Mapping[str, Sequence[Hop]] = {
            "rtp": (("reorder", self._receive), ("depacketize", self._depacketize)),
            "path_token": (("note", self._note_token),),
            "picture_lost": (("ask", lambda _message, now: self._ask_for_keyframe(now.mono_ns)),),
            WAKE: (("expire", self._wake), ("depacketize", self._depacketize)),
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """What was counted here, in the reorder buffer and in the depacketizer."""
        names = ("late", "duplicate", "lost", "reordered", "stray")
        return {
            **self._counts,
            **{f"packets_{name}": getattr(self._reorder, name) for name in names},
            "payloads_malformed": self._depacketizer.malformed,
        }

    def next_wake_ns(self) -> int | None:
        """When the reorder buffer gives up waiting, a hello or a report is due."""
        times = [self._reorder.next_wake_ns()]
        if self._path is not None:
            times += [self._path.next_hello_ns(), self._report_ns if self._media_ssrc is not None else None]
        return min((time for time in times if time is not None), default=None)

    def _note_token(self, message: Message, _now: Now) -> None:
        token: PathToken = message.payload
        if self._path is None or token.token != self._token:
            self._token = token.token
            self._path = PathClient(token.token)
            self._port = token.port

    def _receive(self, message: Message, now: Now) -> tuple[list[tuple[RtpPacket, bool]], Now, list[Send]] | None:
        if is_path_datagram(message.payload):
            answer = None if self._path is None else self._path.answer(message.payload)
            self._counts["challenges_unreadable"] += answer is None
            return None if answer is None else ([], message.arrived, [self._feedback(answer)])
        try:
            packet = parse_packet(message.payload)
        except BadPacket:
            self._counts["packets_unreadable"] += 1
            return None
        self._counts["packets"] += 1
        self._packets_since_report += 1
        self._note_transit(message.arrived.mono_ns, packet.timestamp)
        self._media_ssrc = packet.ssrc
        if self._path is not None:
            self._path.video_arrived(now.mono_ns)
        return self._reorder.push(packet, now.mono_ns), message.arrived, []

    def _wake(self, message: Message, now: Now) -> tuple[list[tuple[RtpPacket, bool]], Now, list[Send]]:
        sends = []
        if self._path is not None and now.mono_ns >= self._path.next_hello_ns():
            sends.append(self._feedback(self._path.hello(now.mono_ns)))
        if self._media_ssrc is not None and now.mono_ns >= self._report_ns:
            sends.append(self._report(self._media_ssrc, now.mono_ns))
            self._report_ns = now.mono_ns + REPORT_PERIOD_NS
        return self._reorder.expire(now.mono_ns), message.arrived, sends

    def _depacketize(self, ordered: tuple[list[tuple[RtpPacket, bool]], Now, list[Send]], now: Now) -> list[Send]:
        packets, arrived, sends = ordered
        for packet, lost_before in packets:
            for unit in self._depacketizer.push(packet, lost_before=lost_before):
                self._counts["access_units"] += 1
                self._counts["access_units_incomplete"] += not unit.complete
                received = ReceivedUnit(unit.data, unit.timestamp, unit.complete, unit.keyframe, arrived.mono_ns)
                sends.append(Send("access_unit", received))
            if lost_before:
                sends += self._ask_for_keyframe(now.mono_ns)
        return sends

    def _ask_for_keyframe(self, now_ns: int) -> list[Send]:
        """Ask for a keyframe after a loss, and no more often than one can come."""
        if self._media_ssrc is None or now_ns < self._picture_loss_ns:
            return []
        self._picture_loss_ns = now_ns + PICTURE_LOSS_PAUSE_NS
        self._counts["picture_loss_requests"] += 1
        return [self._feedback(picture_loss(SSRC, self._media_ssrc))]

    def _report(self, media_ssrc: int, now_ns: int) -> Send:
        lost_in_all = self._reorder.lost - self._reorder.late
        lost = max(0, lost_in_all - self._lost_at_report)
        expected = self._packets_since_report + lost
        fraction = lost / expected if expected else 0.0
        self._packets_since_report, self._lost_at_report = 0, lost_in_all
        report = ReceptionReport(
            media_ssrc, self._reorder.highest_sequence, fraction, lost_in_all, round(self._jitter)
        )  # fmt: skip
        return self._feedback(receiver_report(SSRC, report, clock_ns=now_ns))

    def _note_transit(self, arrived_ns: int, timestamp: int) -> None:
        """Keep the interarrival jitter, in units of the RTP clock (RFC 3550, section 6.4.1)."""
        transit = (arrived_ns * 9 // 100_000 - timestamp) & 0xFFFFFFFF
        if self._transit is not None:
            difference = (transit - self._transit + 2**31) % 2**32 - 2**31
            self._jitter += (abs(difference) - self._jitter) / 16
        self._transit = transit

    def _feedback(self, datagram: bytes) -> Send:
        return Send("feedback", datagram, self._port)
