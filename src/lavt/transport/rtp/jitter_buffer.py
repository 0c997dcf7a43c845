"""Packets back into the order of their sequence numbers, without keeping those that are in order.

A packet in order leaves at once. One after a gap waits for the missing ones, at most a hold from the first sign of the
gap; then the gap is given up. The very first packets wait one hold, since the first to arrive need not be the
first that was sent: without it a reordered keyframe at the start costs the whole first group of pictures.
"""

from __future__ import annotations

from typing import Final

from lavt.transport.rtp.adaptive_hold import AdaptiveHold
from lavt.transport.rtp.rtp import RtpPacket

MAX_JUMP: Final = 3000
"""Sequence numbers further from the newest than this are another range. RFC 3550 (A.1) allows only 100 backwards; here
a delay spike, which brings many old packets in a row, must not pass for a restart of the sender."""
CAPACITY: Final = 1024
"""Packets held at most; when there are more the gap is given up early."""

Ordered = list[tuple[RtpPacket, bool]]
"""Packets in order, each with whether any between it and the one before it is missing."""


class JitterBuffer:
    """Puts the packets of one RTP stream in order; a new SSRC begins a new stream.

    `hold_ns` is how long a gap is waited for; None: as long as the network's packets have lately been overtaken by.
    Repair packets have another SSRC and must not come in here. Public counters, in packets: `late` came after they had
    been given up, `duplicate` came twice, `lost` were given up (late ones included), `reordered` came late but in
    time, `stray` were far from all others and alone, `recovered` did not come in time but were made again in time.
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
        self._stray: RtpPacket | None = None
        self._after_loss = False
        self._ssrc: int | None = None
        self._next: int | None = None
        self._start(0)

    @property
    def highest_sequence(self) -> int:
        """The highest sequence number received, extended by the number of wraps (RFC 3550, section 6.4.1)."""
        return self._highest

    def push(self, packet: RtpPacket, now_ns: int) -> Ordered:
        """Take a packet that arrived at `now_ns`; return the packets that are in order now."""
        number = self._next
        if number is not None and not self._held and (packet.sequence, packet.ssrc) == (number % 2**16, self._ssrc):
            # As nearly always: the next one, and nothing waits.
            self._highest, self._next, self._stray = number, number + 1, None
            after_loss, self._after_loss = self._after_loss, False
            return [(packet, after_loss)]
        released: Ordered = []
        if packet.ssrc != self._ssrc:
            released = self._restart(packet)
        number = self._extend(packet.sequence)
        if abs(number - self._highest) > MAX_JUMP:
            stray, self._stray = self._stray, packet
            if stray is None or packet.sequence != (stray.sequence + 1) % 2**16:
                self.stray += 1
                return released
            # Two in a row: the sender has moved its sequence numbers (RFC 3550, A.1).
            self.stray -= 1
            released += self._restart(stray)
            self._insert(stray, self._highest, now_ns)
            number = self._extend(packet.sequence)
        self._stray = None
        self._insert(packet, number, now_ns)
        return released + self._drain() + self.expire(now_ns)

    def push_recovered(self, packet: RtpPacket, now_ns: int) -> Ordered:
        """Take a packet that was made again; one that is not missing, or no longer waited for, changes nothing."""
        number = self._extend(packet.sequence)
        waited_for = number not in self._held and (self._next is None or number >= self._next)
        if packet.ssrc != self._ssrc or abs(number - self._highest) > MAX_JUMP:
            return []
        if not waited_for:
            self._note_given_up(number, now_ns)
            return []
        self.recovered += 1
        if number < self._highest:
            self._note_reordered(number, now_ns)
        self._hold(packet, number, now_ns)
        return self._drain() + self.expire(now_ns)

    def expire(self, now_ns: int) -> Ordered:
        """Give up the gaps whose hold is over at `now_ns`; return the packets that are in order now."""
        released: Ordered = []
        while self._held and (now_ns >= self._deadline_ns() or len(self._held) > CAPACITY):
            released += self._skip_gap()
        return released

    def next_wake_ns(self) -> int | None:
        """Tell when `expire` has something to do; None: nothing is held."""
        return self._deadline_ns() if self._held else None

    def _start(self, first_number: int) -> None:
        """Forget the stream."""
        self._held: dict[int, tuple[RtpPacket, int]] = {}
        self._next = None
        self._first = first_number
        self._highest = first_number
        self._given_up: dict[int, int] = {}
        """Numbers of packets that were given up, each with the time of the first sign that it was missing."""

    def _restart(self, first: RtpPacket) -> Ordered:
        """Let go all that is held and begin anew with the stream of `first`."""
        released: Ordered = []
        while self._held:
            released += self._skip_gap()
        self._after_loss = self._ssrc is not None
        same_stream = first.ssrc == self._ssrc
        self._ssrc = first.ssrc
        self._stray = None
        self._start(self._highest + (first.sequence - self._highest) % 2**16 if same_stream else first.sequence)
        return released

    def _extend(self, sequence: int) -> int:
        """Give the extended sequence number that is nearest to the highest one."""
        return self._highest + (sequence - self._highest + 2**15) % 2**16 - 2**15

    def _insert(self, packet: RtpPacket, number: int, now_ns: int) -> None:
        """Hold a packet, or count why not."""
        if number in self._held:
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
            self._hold(packet, number, now_ns)

    def _hold(self, packet: RtpPacket, number: int, now_ns: int) -> None:
        """Keep a packet that is waited for."""
        if self._adaptive is not None and not self._held:
            self._hold_ns = self._adaptive.at(now_ns)
        self._highest = max(self._highest, number)
        self._held[number] = packet, now_ns

    def _drain(self) -> Ordered:
        """Let go the packets that are next, up to the first gap."""
        released: Ordered = []
        while self._next is not None and self._next in self._held:
            packet, _ = self._held.pop(self._next)
            released.append((packet, self._after_loss))
            self._after_loss = False
            self._next += 1
        return released

    def _skip_gap(self) -> Ordered:
        """Give up what is missing before the first packet held, and let go from there to the next gap."""
        first = min(self._held)
        if self._next is None:
            self._first = first
        else:
            missing = range(self._next, first)
            self.lost += len(missing)
            self._given_up.update(dict.fromkeys(missing, self._first_sign_ns()))
            if len(self._given_up) > 2 * MAX_JUMP:
                self._given_up = {each: at for each, at in self._given_up.items() if each > first - MAX_JUMP}
            self._after_loss = True
        self._next = first
        return self._drain()

    def _first_sign_ns(self) -> int:
        """Tell when the first gap showed: the packet held longest was the first sign of it."""
        return next(iter(self._held.values()))[1]

    def _deadline_ns(self) -> int:
        """Tell when the hold of the first gap is over."""
        return self._first_sign_ns() + self._hold_ns

    def _note_given_up(self, number: int, now_ns: int) -> None:
        """A packet came, or was made again, that had been given up: a longer hold would have waited for it."""
        if self._adaptive is not None and number in self._given_up:
            self._adaptive.note(now_ns - self._given_up[number], now_ns)

    def _note_reordered(self, number: int, now_ns: int) -> None:
        """A packet came, or was made again, in time, but after later ones; the first of these to come was the sign."""
        if self._adaptive is not None:
            sign_ns = min((came_ns for later, (_, came_ns) in self._held.items() if later > number), default=now_ns)
            self._adaptive.note(now_ns - sign_ns, now_ns)
            self._hold_ns = self._adaptive.at(now_ns)
