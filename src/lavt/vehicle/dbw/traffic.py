"""Statistics of the traffic on a bus: each message's rate, values, changes and errors.

The module does no I/O and sends nothing: it takes received frames and times, and returns summaries.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.can_frame import CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw.codec import Codec, MessageFacts, SignalFacts
from lavt.vehicle.dbw.crc8 import has_valid_checksum
from lavt.vehicle.dbw.profile import Profile

Values = Mapping[str, float | None]

MAX_UNKNOWN = 1000
"""Largest number of unknown identifiers that are counted separately."""
OTHER_IDENTIFIERS = (-1, False)
"""The key under which frames with further unknown identifiers are counted."""


@dataclass(frozen=True, slots=True)
class ExpectedMessages:
    """A profile's expectations of the messages on the bus; none by default."""

    checksums: AbstractSet[str] = frozenset()
    """Names of checksum signals."""
    counters: AbstractSet[str] = frozenset()
    """Names of counter signals."""
    timeouts_ns: Mapping[str, int] = field(default_factory=dict)
    """For the messages that must be received, the timeouts by message name."""
    short_lengths: AbstractSet[int] = frozenset()
    """Lengths of frames that are right although their messages are longer."""


def expected_traffic(profile: Profile) -> ExpectedMessages:
    """Return the messages that a profile expects on its bus.

    Checksums and counters are recognised by the names of their signals. So they are also expected in messages that the
    profile does not use.
    """
    axes = profile.axes.values()
    checksums = {command.checksum for command in axes} | {report.checksum for report in profile.reports.values()}
    return ExpectedMessages(
        checksums=checksums - {""},
        counters={command.count for command in axes} - {""},
        timeouts_ns={message: report.timeout_ns for message, report in profile.reports.items()},
        short_lengths=frozenset() if profile.clearing_bytes is None else {profile.clearing_bytes},
    )


@dataclass(frozen=True, slots=True)
class MessageSummary:
    """Statistics of one message."""

    facts: MessageFacts
    frames: int
    """Number of frames since the start."""
    rate_hz: float
    """Frames per second in the period of the summary."""
    values: Values
    """The newest values; None for a missing value."""
    changed: tuple[str, ...]
    """Signals that changed in the period, without counters and checksums."""
    wrong: tuple[str, ...]
    """Errors in the period."""


class BusTraffic:
    """Statistics of a bus."""

    def __init__(self, codec: Codec, expected: ExpectedMessages, *, start_ns: int) -> None:
        self.unknown: Counter[tuple[int, bool]] = Counter()
        """Number of frames of unknown messages, by identifier and whether the identifier has 29 bits."""
        self._codec, self._expected = codec, expected
        self._start_ns = self._period_start_ns = start_ns
        self._names = {(facts.identifier, facts.is_extended): name for name, facts in codec.messages.items()}
        self._received = {name: _ReceivedMessage() for name in codec.messages if name in expected.timeouts_ns}

    def receive(self, received: ReceivedCanFrame) -> None:
        """Process any frame from the bus."""
        key = (received.frame.identifier, received.frame.is_extended)
        name = self._names.get(key)
        if name is None:
            self.unknown[key if key in self.unknown or len(self.unknown) < MAX_UNKNOWN else OTHER_IDENTIFIERS] += 1
            return
        message = self._received.setdefault(name, _ReceivedMessage())
        facts, tallies = self._codec.messages[name], (message.period, message.total)
        if message.last_ns is not None:
            for tally in tallies:
                tally.longest_gap_ns = max(tally.longest_gap_ns, received.arrived_ns - message.last_ns)
        message.last_ns = received.arrived_ns
        wrong = self._frame_errors(received.frame, facts)
        decoded = self._codec.decode(received.frame, short=True)
        if decoded is None:
            wrong.append("cannot be decoded")
        else:
            _, values = decoded
            wrong += self._counter_errors(message, values)
            for tally in tallies:
                tally.changed |= self._changes(message.values, values)
            message.values = values
        for tally in tallies:
            tally.frames += 1
            tally.wrong.update(wrong)

    def take_period(self, now_ns: int) -> list[MessageSummary]:
        """Return a summary of each received or expected message since the last call, and start a new period."""
        summaries = [
            self._summary(name, message, message.period, self._period_start_ns, now_ns)
            for name, message in self._sorted()
        ]
        for message in self._received.values():
            message.period = _Tally()
        self._period_start_ns = now_ns
        return summaries

    def total(self, now_ns: int) -> list[MessageSummary]:
        """Return a summary of each received or expected message since the start."""
        return [self._summary(name, message, message.total, self._start_ns, now_ns) for name, message in self._sorted()]

    def _sorted(self) -> list[tuple[str, _ReceivedMessage]]:
        return sorted(self._received.items(), key=lambda item: self._codec.messages[item[0]].identifier)

    def _summary(
        self, name: str, message: _ReceivedMessage, tally: _Tally, since_ns: int, now_ns: int
    ) -> MessageSummary:
        wrong = [text if count == 1 else f"{text} ({count} times)" for text, count in tally.wrong.items()]
        timeout_ns = self._expected.timeouts_ns.get(name)
        if message.last_ns is None:
            wrong.append("never received")
        elif timeout_ns is not None:
            gap_ns = max(tally.longest_gap_ns, now_ns - message.last_ns)
            if gap_ns > timeout_ns:
                wrong.append(f"gap of {gap_ns // NS_PER_MS} ms, longer than {timeout_ns // NS_PER_MS} ms")
        ignored = self._expected.checksums | self._expected.counters
        return MessageSummary(
            facts=self._codec.messages[name],
            frames=message.total.frames,
            rate_hz=tally.frames * NS_PER_S / max(1, now_ns - since_ns),
            values=message.values,
            changed=tuple(sorted(tally.changed - ignored)),
            wrong=tuple(wrong),
        )

    def _frame_errors(self, frame: CanFrame, facts: MessageFacts) -> list[str]:
        """Return the errors of a frame's length and checksum."""
        length = len(frame.data)
        if length != facts.length:
            return [] if length in self._expected.short_lengths else [f"has {length} bytes, not {facts.length}"]
        has_checksum = not self._expected.checksums.isdisjoint(facts.signals)
        if has_checksum and not has_valid_checksum(frame):
            return ["wrong checksum"]
        return []

    def _counter_errors(self, message: _ReceivedMessage, values: Values) -> list[str]:
        """Return an error if a frame's counter equals that of the frame before."""
        for name in self._expected.counters & values.keys():
            before, message.count = message.count, values[name]
            if before == message.count:
                return [f"{name} does not count"]
        return []

    def _changes(self, before: Values, after: Values) -> set[str]:
        return {name for name, value in after.items() if name in before and before[name] != value}


@dataclass(slots=True)
class _Tally:
    """Statistics of a message in a period."""

    frames: int = 0
    longest_gap_ns: int = 0
    changed: set[str] = field(default_factory=set)
    wrong: Counter[str] = field(default_factory=Counter)


@dataclass(slots=True)
class _ReceivedMessage:
    """The state of a received or expected message."""

    last_ns: int | None = None
    values: Values = field(default_factory=dict)
    count: float | None = None
    period: _Tally = field(default_factory=_Tally)
    total: _Tally = field(default_factory=_Tally)


def signal_text(signal: SignalFacts, value: float | None) -> str:
    """Format a signal's name and value; empty for a flag that is not set. `?` marks an unverified signal."""
    name = signal.name + "?" * signal.is_unverified
    if value is None:
        return f"{name} -"
    meaning = signal.names.get(signal.number(value))
    if meaning is not None:
        return f"{name} {meaning}"
    if signal.bits == 1:
        return name if value else ""
    return f"{name} {value:.6g} {signal.unit}".rstrip()
