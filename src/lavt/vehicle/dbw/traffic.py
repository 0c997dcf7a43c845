"""What is heard on a bus, in words: each message, how often, what it says, what changed and what is wrong with it.

Sans-IO: frames and `now` in, what there is to tell out. It only listens.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.can_frame import CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw.codec import Codec, MessageFacts, SignalFacts
from lavt.vehicle.dbw.crc8 import frame_crc8

Values = Mapping[str, float | None]

MOST_UNKNOWN = 1000
"""So many identifiers that nobody knows are counted one by one."""
OTHERS = (-1, False)
"""Those after them."""


@dataclass(frozen=True, slots=True)
class ExpectedMessages:
    """What a profile says of messages, for whoever listens; without one nothing is expected."""

    checksums: AbstractSet[str] = frozenset()
    """Names of signals that are one."""
    counters: AbstractSet[str] = frozenset()
    """Names of signals that count frames."""
    timeouts_ns: Mapping[str, int] = field(default_factory=dict)
    """Of messages that have to come."""
    short_lengths: AbstractSet[int] = frozenset()
    """Lengths that a frame may have though its message is longer."""


@dataclass(frozen=True, slots=True)
class MessageSummary:
    """What there is to tell of one message."""

    facts: MessageFacts
    frames: int
    rate_hz: float
    values: Values
    """The newest; a value that is not there is None."""
    changed: tuple[str, ...]
    """Signals that changed since the last time, but for counters and checksums."""
    wrong: tuple[str, ...]


class BusTraffic:
    """Listens to a bus; `unknown` counts frames of no message, by identifier (and whether it has 29 bits)."""

    def __init__(self, codec: Codec, expected: ExpectedMessages, *, start_ns: int) -> None:
        self.unknown: Counter[tuple[int, bool]] = Counter()
        self._codec, self._expected = codec, expected
        self._start_ns = self._told_ns = start_ns
        self._names = {(facts.identifier, facts.is_extended): name for name, facts in codec.messages.items()}
        self._heard = {name: _Heard() for name in codec.messages if name in expected.timeouts_ns}

    def hear(self, heard: ReceivedCanFrame) -> None:
        """Take a frame, whatever it is."""
        key = (heard.frame.identifier, heard.frame.is_extended)
        name = self._names.get(key)
        if name is None:
            self.unknown[key if key in self.unknown or len(self.unknown) < MOST_UNKNOWN else OTHERS] += 1
            return
        message = self._heard.setdefault(name, _Heard())
        facts, tallies = self._codec.messages[name], (message.lately, message.in_all)
        if message.last_ns is not None:
            for tally in tallies:
                tally.longest_gap_ns = max(tally.longest_gap_ns, heard.arrived_ns - message.last_ns)
        message.last_ns = heard.arrived_ns
        wrong = self._wrong(heard.frame, facts)
        decoded = self._codec.decode(heard.frame, short=True)
        if decoded is None:
            wrong.append("cannot be read")
        else:
            wrong += self._miscounted(message, decoded[1])
            for tally in tallies:
                tally.changed |= self._changes(message.values, decoded[1])
            message.values = decoded[1]
        for tally in tallies:
            tally.frames += 1
            tally.wrong.update(wrong)

    def tell(self, now_ns: int) -> list[MessageSummary]:
        """Tell each message that was ever heard or has to come, as of now; rate, changes and wrongs since last told."""
        told = [self._told(name, message, message.lately, self._told_ns, now_ns) for name, message in self._sorted()]
        for message in self._heard.values():
            message.lately = _Tally()
        self._told_ns = now_ns
        return told

    def tell_all(self, now_ns: int) -> list[MessageSummary]:
        """The same of the whole time."""
        return [self._told(name, message, message.in_all, self._start_ns, now_ns) for name, message in self._sorted()]

    def _sorted(self) -> list[tuple[str, _Heard]]:
        return sorted(self._heard.items(), key=lambda item: self._codec.messages[item[0]].identifier)

    def _told(self, name: str, message: _Heard, tally: _Tally, since_ns: int, now_ns: int) -> MessageSummary:
        wrong = [words if count == 1 else f"{words} ({count} times)" for words, count in tally.wrong.items()]
        timeout_ns = self._expected.timeouts_ns.get(name)
        if message.last_ns is None:
            wrong.append("never came")
        elif timeout_ns is not None:
            silent_ns = max(tally.longest_gap_ns, now_ns - message.last_ns)
            if silent_ns > timeout_ns:
                wrong.append(f"silent for {silent_ns // NS_PER_MS} ms, longer than {timeout_ns // NS_PER_MS} ms")
        ignored = self._expected.checksums | self._expected.counters
        return MessageSummary(
            facts=self._codec.messages[name],
            frames=message.in_all.frames,
            rate_hz=tally.frames * NS_PER_S / max(1, now_ns - since_ns),
            values=message.values,
            changed=tuple(sorted(tally.changed - ignored)),
            wrong=tuple(wrong),
        )

    def _wrong(self, frame: CanFrame, facts: MessageFacts) -> list[str]:
        """What is wrong with a frame as a whole."""
        length = len(frame.data)
        if length != facts.length:
            return [] if length in self._expected.short_lengths else [f"has {length} bytes, not {facts.length}"]
        has_checksum = not self._expected.checksums.isdisjoint(facts.signals)
        if has_checksum and frame.data[-1] != frame_crc8(frame.identifier, frame.data[:-1], extended=frame.is_extended):
            return ["its checksum is wrong"]
        return []

    def _miscounted(self, message: _Heard, values: Values) -> list[str]:
        """What is wrong with a frame's counter: it has to differ from the one before."""
        for name in self._expected.counters & values.keys():
            before, message.count = message.count, values[name]
            if before == message.count:
                return [f"{name} stands still"]
        return []

    def _changes(self, before: Values, after: Values) -> set[str]:
        return {name for name, value in after.items() if name in before and before[name] != value}


@dataclass(slots=True)
class _Tally:
    """What was heard of a message in a while."""

    frames: int = 0
    longest_gap_ns: int = 0
    changed: set[str] = field(default_factory=set)
    wrong: Counter[str] = field(default_factory=Counter)


@dataclass(slots=True)
class _Heard:
    """A message that came, or has to."""

    last_ns: int | None = None
    values: Values = field(default_factory=dict)
    count: float | None = None
    lately: _Tally = field(default_factory=_Tally)
    in_all: _Tally = field(default_factory=_Tally)


def signal_words(signal: SignalFacts, value: float | None) -> str:
    """Say a signal's value as a person would; empty for a flag that is not set. `?` marks an unverified signal."""
    name = signal.name + "?" * signal.is_unverified
    if value is None:
        return f"{name} -"
    meaning = signal.names.get(signal.number(value))
    if meaning is not None:
        return f"{name} {meaning}"
    if signal.bits == 1:
        return name if value else ""
    return f"{name} {value:.6g} {signal.unit}".rstrip()
