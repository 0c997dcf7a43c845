"""Jitter buffer: it restores the order of sequence numbers without delaying packets that arrive in order.

A packet in order leaves immediately. A packet after a gap waits for the missing packets, for at most one hold since the
gap was detected; then the gap is given up. The first packets of a stream also wait one hold, because the first packet
to arrive is perhaps not the first that was sent. Without this wait, reordering in the first keyframe would make all
pictures up to the next keyframe unusable.
"""

from __future__ import annotations

from typing import Final

from lavt.transport.rtp.adaptive_hold import AdaptiveHold
from lavt.transport.rtp.rtp import RtpPacket

MAX_JUMP: Final = 3000
"""Sequence numbers farther from the newest than this belong to another range. RFC 3550 (A.1) allows only 100 backwards;
here a delay spike, after which many old packets arrive in a row, must not be taken for a restart of the sender."""
CAPACITY: Final = 1024
"""Largest number of packets in the buffer; if there are more, the gap is given up early."""

Ordered = list[tuple[RtpPacket, bool]]
"""Packets in order; the flag of a packet is whether packets between the previous packet and this one are missing."""


class JitterBuffer:
    """A jitter buffer for the packets of one RTP stream; a new SSRC begins a new stream.

    `hold_ns` is the longest wait for the packets of a gap; None: it adapts to the recent reordering delays of the
    network. Repair packets have another SSRC and must not be pushed. Public counters, in packets: `late` arrived after
    they had been given up, `duplicate` arrived twice, `lost` were given up (including late ones), `reordered` arrived
    after later ones but within their hold, `stray` were isolated with a sequence number far from all others,
    `recovered` were recovered within their hold.
    """

    def __init__(self, hold_ns: int | None = None) -> None:
        self.late = 0
        self.duplicate = 0
        self.lost = 0
        self.reordered = 0
        self.stray = 0
        self.recovered = 0
        self._adaptive = AdaptiveHold() if hold_ns is None else None
        self._hold_ns = 0 if hold_ns is None else hold_ns
        self._last_stray: RtpPacket | None = None
        """The previous packet, if it was a stray."""
        self._after_loss = False
        """Packets before the next released packet are missing."""
        self._ssrc: int | None = None
        self._next: int | None = None
        self._reset(0)

    @property
    def highest_sequence(self) -> int:
        """The highest sequence number received, extended by the number of wraps (RFC 3550, section 6.4.1)."""
        return self._highest

    def push(self, packet: RtpPacket, now_ns: int) -> Ordered:
        """Add a packet that arrived at `now_ns`; return the packets that are now in order."""
        number = self._next
        if number is not None and not self._buffered and (packet.sequence, packet.ssrc) == (number % 2**16, self._ssrc):
            # The usual case: this is the next packet, and no packet is waiting.
            self._highest, self._next, self._last_stray = number, number + 1, None
            after_loss, self._after_loss = self._after_loss, False
            return [(packet, after_loss)]
        released: Ordered = []
        if packet.ssrc != self._ssrc:
            released = self._begin_stream(packet)
        number = self._extend(packet.sequence)
        if abs(number - self._highest) > MAX_JUMP:
            stray, self._last_stray = self._last_stray, packet
            if stray is None or packet.sequence != (stray.sequence + 1) % 2**16:
                self.stray += 1
                return released
            # Two consecutive strays: the sequence numbers of the sender have jumped (RFC 3550, A.1).
            self.stray -= 1
            released += self._begin_stream(stray)
            self._insert(stray, self._highest, now_ns)
            number = self._extend(packet.sequence)
        self._last_stray = None
        self._insert(packet, number, now_ns)
        return released + self._drain() + self.expire(now_ns)

    def push_recovered(self, packet: RtpPacket, now_ns: int) -> Ordered:
        """Add a recovered packet; return the packets that are now in order.

        A packet that is not missing, or that was given up, is dropped.
        """
        number = self._extend(packet.sequence)
        is_missing = number not in self._buffered and (self._next is None or number >= self._next)
        if packet.ssrc != self._ssrc or abs(number - self._highest) > MAX_JUMP:
            return []
        if not is_missing:
            self._note_given_up(number, now_ns)
            return []
        self.recovered += 1
        if number < self._highest:
            self._note_reordered(number, now_ns)
        self._store(packet, number, now_ns)
        return self._drain() + self.expire(now_ns)

    def expire(self, now_ns: int) -> Ordered:
        """Give up the gaps whose hold has expired at `now_ns`; return the packets that are now in order."""
        released: Ordered = []
        while self._buffered and (now_ns >= self._deadline_ns() or len(self._buffered) > CAPACITY):
            released += self._skip_gap()
        return released

    def next_wake_ns(self) -> int | None:
        """Return when `expire` must be called next; None: no packet is waiting."""
        return self._deadline_ns() if self._buffered else None

    def _reset(self, first_number: int) -> None:
        """Clear the state of the stream."""
        self._buffered: dict[int, tuple[RtpPacket, int]] = {}
        self._next = None
        self._first = first_number
        self._highest = first_number
        self._given_up: dict[int, int] = {}
        """Numbers of packets that were given up, each with the time when its gap was detected."""

    def _begin_stream(self, first: RtpPacket) -> Ordered:
        """Release all buffered packets and begin the stream of `first`."""
        released: Ordered = []
        while self._buffered:
            released += self._skip_gap()
        self._after_loss = self._ssrc is not None
        same_stream = first.ssrc == self._ssrc
        self._ssrc = first.ssrc
        self._last_stray = None
        self._reset(self._highest + (first.sequence - self._highest) % 2**16 if same_stream else first.sequence)
        return released

    def _extend(self, sequence: int) -> int:
        """Return the extended sequence number that is nearest to the highest one."""
        return self._highest + (sequence - self._highest + 2**15) % 2**16 - 2**15

    def _insert(self, packet: RtpPacket, number: int, now_ns: int) -> None:
        """Store a packet, or count it as late or duplicate."""
        if number in self._buffered:
            self.duplicate += 1
        elif self._next is not None and number < self._next:
            if number in self._given_up or number < self._first:
                self._note_given_up(number, now_ns)
                self._given_up.pop(number, None)
                self.late += 1
            else:
                self.duplicate += 1
        else:
            if number < self._highest:
                self.reordered += 1
                self._note_reordered(number, now_ns)
            self._store(packet, number, now_ns)

    def _store(self, packet: RtpPacket, number: int, now_ns: int) -> None:
        """Store a packet that has not left the buffer yet."""
        if self._adaptive is not None and not self._buffered:
            self._hold_ns = self._adaptive.hold_ns(now_ns)
        self._highest = max(self._highest, number)
        self._buffered[number] = packet, now_ns

    def _drain(self) -> Ordered:
        """Release the next packets up to the first gap."""
        released: Ordered = []
        while self._next is not None and self._next in self._buffered:
            packet, _ = self._buffered.pop(self._next)
            released.append((packet, self._after_loss))
            self._after_loss = False
            self._next += 1
        return released

    def _skip_gap(self) -> Ordered:
        """Give up the packets missing before the first buffered one, and release those up to the next gap."""
        first = min(self._buffered)
        if self._next is None:
            self._first = first
        else:
            missing = range(self._next, first)
            self.lost += len(missing)
            self._given_up.update(dict.fromkeys(missing, self._gap_detected_ns()))
            if len(self._given_up) > 2 * MAX_JUMP:
                self._given_up = {
                    lost: detected_ns for lost, detected_ns in self._given_up.items() if lost > first - MAX_JUMP
                }
            self._after_loss = True
        self._next = first
        return self._drain()

    def _gap_detected_ns(self) -> int:
        """Return when the first gap was detected: when the longest-buffered packet arrived."""
        return next(iter(self._buffered.values()))[1]

    def _deadline_ns(self) -> int:
        """Return when the hold of the first gap expires."""
        return self._gap_detected_ns() + self._hold_ns

    def _note_given_up(self, number: int, now_ns: int) -> None:
        """Tell the adaptive hold of a packet that arrived or was recovered after it was given up, so that it grows."""
        if self._adaptive is not None and number in self._given_up:
            self._adaptive.note_delay(now_ns - self._given_up[number], now_ns)

    def _note_reordered(self, number: int, now_ns: int) -> None:
        """Tell the adaptive hold of a packet that arrived or was recovered within its hold, but after later packets.

        It was found missing when the first of these later packets arrived.
        """
        if self._adaptive is not None:
            later_ns = (at_ns for later, (_, at_ns) in self._buffered.items() if later > number)
            detected_ns = min(later_ns, default=now_ns)
            self._adaptive.note_delay(now_ns - detected_ns, now_ns)
            self._hold_ns = self._adaptive.hold_ns(now_ns)
