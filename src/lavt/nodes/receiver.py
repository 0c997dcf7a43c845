"""The receiver node, which restores the order of received packets and reassembles access units."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import BadPacket
from lavt.node import WAKE, Message, Send, Stage
from lavt.nodes.payloads import PathToken, ReceivedUnit
from lavt.transport.rtp.fec import REPAIR_PAYLOAD_TYPE, RepairReceiver
from lavt.transport.rtp.jitter_buffer import JitterBuffer, Ordered
from lavt.transport.rtp.reception_stats import Reception
from lavt.transport.rtp.rtcp import is_rtcp, max_bit_rate, parse_announcement, picture_loss, receiver_report
from lavt.transport.rtp.rtp import Depacketizer, parse_packet
from lavt.transport.video.cipher import NewCipher, plain_cipher
from lavt.transport.video.path_validation import PathClient, is_path_datagram

REPORT_PERIOD_NS = 500 * NS_PER_MS
"""The server closes a path after 2 s without a report, that is after four missing reports."""
SAMPLE_PERIOD_NS = NS_PER_S
"""Period of the recorded statistics."""
KEYFRAME_DELAY_NS = 50 * NS_PER_MS
"""How long the sender of the video takes to answer a keyframe request: it waits for the next picture and encodes it."""
ASSUMED_ROUND_TRIP_NS = 50 * NS_PER_MS
"""The round trip that is assumed until it has been measured."""
SSRC = 0x4C415654
"""SSRC of the receiver in its reports: "LAVT"."""


class OrderedPackets(NamedTuple):
    """Received packets in order, for the depacketizer."""

    packets: Ordered
    arrived: Now
    """When the message arrived that released the packets."""
    sends: list[Send]
    """Messages to send besides the access units."""


class ReceiverNode:
    """The node that validates the video path, keeps it open with receiver reports, and receives the video.

    Lost packets are recovered from repair packets, if enough of those arrive. Otherwise pictures are in doubt until the
    next complete keyframe. A keyframe is requested at once, and again after each round trip in which none arrives. With
    each report, the receiver requests a bit rate of at most `max_bit_rate_bps` from the sender. With `informs_driver`,
    the driver node gets each sample of the reception, too.
    """

    name = "receiver"

    def __init__(
        self,
        jitter_buffer: JitterBuffer,
        depacketizer: Depacketizer,
        max_bit_rate_bps: int | None = None,
        new_cipher: NewCipher = plain_cipher,
        *,
        informs_driver: bool = False,
    ) -> None:
        self._counts: Counter[str] = Counter()
        self._jitter_buffer = jitter_buffer
        self._repair = RepairReceiver()
        self._depacketizer = depacketizer
        self._reception = Reception(jitter_buffer)
        self._max_bit_rate_bps = max_bit_rate_bps
        self._new_cipher = new_cipher
        self._informs_driver = informs_driver
        self._path: PathClient | None = None
        self._token = b""
        self._port = 0
        self._media_ssrc: int | None = None
        self._report_ns = self._sample_ns = 0
        self._in_doubt = False
        self._requested_ns: int | None = None
        """Time of the last keyframe request."""
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            "rtp": (("reorder", self._receive), ("depacketize", self._depacketize)),
            "path_token": (("note", self._note_token),),
            "picture_lost": (("ask", self._note_picture_lost),),
            WAKE: (("expire", self._wake), ("depacketize", self._depacketize)),
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the counts of the node, the jitter buffer, repair and the depacketizer."""
        names = ("late", "duplicate", "lost", "reordered", "stray", "recovered")
        return {
            **self._counts,
            **{f"packets_{name}": getattr(self._jitter_buffer, name) for name in names},
            "repair_malformed": self._repair.malformed,
            "repair_blocks_given_up": self._repair.unrepaired,
            "payloads_malformed": self._depacketizer.malformed,
        }

    def next_wake_ns(self) -> int | None:
        """Return when the jitter buffer, a hello, a report, a sample or a keyframe request is due."""
        times = [self._jitter_buffer.next_wake_ns()]
        if self._path is not None:
            times.append(self._path.next_hello_ns())
        if self._media_ssrc is not None:
            times.append(self._sample_ns)
            if self._path is not None:
                times += [self._report_ns, self._request_due_ns() if self._repeats_requests() else None]
        return min((time for time in times if time is not None), default=None)

    def _note_token(self, message: Message, _now: Now) -> None:
        path_token: PathToken = message.payload
        if self._path is None or path_token.token != self._token:
            self._token = path_token.token
            self._path = PathClient(path_token.token, self._new_cipher)
            self._port = path_token.port

    def _receive(self, message: Message, now: Now) -> OrderedPackets | None:
        """Process a datagram of any kind; count and drop an unreadable one."""
        datagram: bytes | None = message.payload
        if is_path_datagram(message.payload):  # a challenge: the server checks that the client has this address
            answer = None if self._path is None else self._path.answer(message.payload)
            self._counts["challenges_unreadable"] += answer is None
            return None if answer is None else OrderedPackets([], message.arrived, [self._feedback(answer)])
        is_report = is_rtcp(message.payload)
        if self._path is not None:
            datagram = (self._path.unprotect_rtcp if is_report else self._path.unprotect)(message.payload)
        if datagram is None:
            self._counts["packets_forged"] += 1
            return None
        try:
            if is_report:
                announcement = parse_announcement(datagram)
                # Without a path, as in `lavt watch`, this node sends no reports: the sender's answers to reports are
                # all for other receivers.
                own_ssrc = None if self._path is None else SSRC
                self._reception.note_announcement(announcement, own_ssrc, message.arrived.mono_ns)
                return None
            return OrderedPackets(self._order(datagram, message.arrived, now), message.arrived, [])
        except BadPacket:
            self._counts["packets_unreadable"] += 1
            return None

    def _order(self, datagram: bytes, arrived: Now, now: Now) -> Ordered:
        """Return the packets that a datagram makes available in order, also recovered ones; raise `BadPacket`."""
        packet = parse_packet(datagram)
        ordered: Ordered = []
        if packet.payload_type == REPAIR_PAYLOAD_TYPE:
            self._counts["packets_of_repair"] += 1
        else:
            self._counts["packets"] += 1
            self._media_ssrc = packet.ssrc
            if self._path is not None:
                self._path.video_arrived(now.mono_ns)
            ordered = self._jitter_buffer.push(packet, now.mono_ns)
            self._reception.note_packet(packet, arrived.mono_ns)
        for recovered in self._repair.push(packet, now.mono_ns):
            ordered += self._jitter_buffer.push_recovered(recovered, now.mono_ns)
        return ordered

    def _wake(self, message: Message, now: Now) -> OrderedPackets:
        now_ns = now.mono_ns
        sends = []
        if self._path is not None and now_ns >= self._path.next_hello_ns():
            sends.append(self._feedback(self._path.hello(now_ns)))
        if self._media_ssrc is not None:
            if self._path is not None and now_ns >= self._report_ns:
                self._report_ns = now_ns + REPORT_PERIOD_NS
                sends += self._report(self._media_ssrc, now_ns)
            if now_ns >= self._sample_ns:
                self._sample_ns = now_ns + SAMPLE_PERIOD_NS
                sample = self._reception.sample(now_ns)
                sends.append(Send("reception", sample))
                if self._informs_driver:
                    sends.append(Send("video_reception", sample))
            if self._repeats_requests():
                sends += self._request_keyframe(now_ns)
        return OrderedPackets(self._jitter_buffer.expire(now_ns), message.arrived, sends)

    def _depacketize(self, ordered: OrderedPackets, now: Now) -> list[Send]:
        packets, arrived, sends = ordered
        damaged = False
        for packet, lost_before in packets:
            damaged |= lost_before
            for unit in self._depacketizer.push(packet, lost_before=lost_before):
                self._counts["access_units"] += 1
                self._counts["access_units_incomplete"] += not unit.complete
                damaged = not unit.complete or (damaged and not unit.keyframe)
                self._in_doubt &= not (unit.complete and unit.keyframe)
                received = ReceivedUnit(unit.data, unit.timestamp, unit.complete, unit.keyframe, arrived.mono_ns)
                sends.append(Send("access_unit", received))
        self._in_doubt |= damaged
        return [*sends, *self._request_keyframe(now.mono_ns)] if damaged else sends

    def _note_picture_lost(self, _message: Message, now: Now) -> list[Send]:
        """Request a keyframe, because the decoder has no picture or a damaged one."""
        self._in_doubt = True
        return self._request_keyframe(now.mono_ns)

    def _repeats_requests(self) -> bool:
        """Return whether a keyframe is missing and its request can be repeated, which needs a known round trip."""
        return self._in_doubt and self._reception.round_trip_ns is not None

    def _request_due_ns(self) -> int:
        """Return when the next keyframe request is allowed: when the answer to the last one should have arrived."""
        if self._requested_ns is None:
            return 0
        round_trip_ns = self._reception.round_trip_ns
        if round_trip_ns is None:
            round_trip_ns = ASSUMED_ROUND_TRIP_NS
        return self._requested_ns + KEYFRAME_DELAY_NS + round_trip_ns

    def _request_keyframe(self, now_ns: int) -> list[Send]:
        """Return a keyframe request, unless the answer to the last one could still arrive."""
        if self._media_ssrc is None or self._path is None or now_ns < self._request_due_ns():
            return []
        self._requested_ns = now_ns
        self._counts["picture_loss_requests"] += 1
        return [self._rtcp(picture_loss(SSRC, self._media_ssrc))]

    def _report(self, media_ssrc: int, now_ns: int) -> list[Send]:
        report = self._reception.report(now_ns)
        sends = [] if report is None else [self._rtcp(receiver_report(SSRC, report, clock_ns=now_ns))]
        if self._max_bit_rate_bps is not None:
            sends.append(self._rtcp(max_bit_rate(SSRC, media_ssrc, self._max_bit_rate_bps, overhead_bytes=0)))
        return sends

    def _rtcp(self, packet: bytes) -> Send:
        return self._feedback(packet if self._path is None else self._path.protect_rtcp(packet))

    def _feedback(self, datagram: bytes) -> Send:
        return Send("feedback", datagram, self._port)
