"""Messages of a DBC file as bytes and back, and what the file says of them. The only module that knows cantools.

cantools is of the extra `can`. Values are physical, in the DBC's units; a value that the DBC has a name for stays a
number (`SignalFacts.names` has the name), and one that is named as none (`NO_VALUE`), or is no number, is None.

A frame of 8 bytes and 15 signals takes 4 us to decode, one of 9 signals 10 us to encode (medians of 7 times 20 000;
Python 3.11, cantools 45.1, one core of a virtual machine).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from lavt.domain import NS_PER_MS
from lavt.errors import UserError
from lavt.vehicle.can_frame import CanFrame

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

NO_VALUE: Final = frozenset({"INVALID", "UNKNOWN"})
"""Names that a DBC gives to what stands in a signal when there is nothing to say."""
RANGE_SLACK_STEPS: Final = 1e-6
"""A value so little over its range is at its end: the step of a signal is seldom a number that floats have."""


@dataclass(frozen=True, slots=True)
class SignalFacts:
    """What the DBC says of a signal; physical = number * scale + offset."""

    name: str
    start: int
    """Bit, as DBC counts."""
    bits: int
    is_signed: bool
    is_float: bool
    scale: float
    offset: float
    minimum: float
    """Physical; that of the bits, where the DBC has none."""
    maximum: float
    unit: str
    names: Mapping[int, str]
    """Of numbers on the wire."""
    is_unverified: bool
    """Its place is an assumption (`docs/can.md`)."""
    is_multiplexer: bool
    multiplexer: str
    """The signal that says whether this one is in the frame; empty: it always is."""
    branches: frozenset[int]
    """Numbers of the multiplexer with which it is."""
    no_value: frozenset[float]
    """Physical values that stand for none."""

    def number(self, value: float) -> int:
        """What stands on the wire for a physical value."""
        return round((value - self.offset) / self.scale)


@dataclass(frozen=True, slots=True)
class MessageFacts:
    """What the DBC says of a message."""

    name: str
    identifier: int
    is_extended: bool
    length: int
    """Bytes."""
    signals: Mapping[str, SignalFacts]
    timeout_ns: int | None
    """Attribute `TimeoutMs`: so long after the last one its receiver does without."""
    period_ns: int | None
    """Attribute `GenMsgCycleTime`."""
    senders: tuple[str, ...]


class Codec:
    """The messages of one DBC file.

    `counts` has what `decode` could not read: `unknown_identifier`, `wrong_length`, `unknown_multiplexer`.

    Raises `UserError` where cantools is missing, or the file is missing or no DBC.
    """

    def __init__(self, dbc: Path) -> None:
        loaded = _loaded(dbc)
        self.messages: Mapping[str, MessageFacts] = {message.name: _facts(message) for message in loaded.messages}
        self.counts: Counter[str] = Counter()
        self._messages = {message.name: message for message in loaded.messages}
        self._decoders = {(message.frame_id, message.is_extended_frame): message for message in loaded.messages}
        self._perhaps_none = {
            name: [signal for signal in facts.signals.values() if signal.no_value or signal.is_float]
            for name, facts in self.messages.items()
        }
        self._zeros = {
            name: {signal.name: signal.offset for signal in facts.signals.values()}
            for name, facts in self.messages.items()
        }

    def encode(self, message: str, values: Mapping[str, float], *, length: int | None = None) -> bytes:
        """Make a message's bytes; bits of signals not named are 0. `length` cuts.

        Rounds to the nearest step. Raises ValueError for a message or signal that the DBC has not, a signal that is not
        in this frame by its multiplexer, and a value out of its range.
        """
        facts = self.messages.get(message)
        if facts is None:
            raise ValueError(f"the DBC has no message {message}")
        for name, value in values.items():
            _check(facts, name, value)
        full = {**self._zeros[message], **values}
        absent = [signal.name for signal in facts.signals.values() if not _is_in(signal, full, facts)]
        if strays := [name for name in absent if name in values]:
            raise ValueError(f"{strays[0]} of {message} is not in a frame with this multiplexer")
        for name in absent:
            del full[name]
        data = bytes(self._messages[message].encode(full, strict=False))
        return data if length is None else data[:length]

    def decode(self, frame: CanFrame, *, short: bool = False) -> tuple[str, dict[str, float | None]] | None:
        """Tell a frame's message and its physical values; None for what the DBC does not know, counted.

        A frame must have the message's length; with `short` it may have less, and tells the signals that are whole in
        it. Never raises, whatever the frame is.
        """
        message = self._decoders.get((frame.identifier, frame.is_extended))
        if message is None:
            self.counts["unknown_identifier"] += 1
            return None
        length = len(frame.data)
        if length > message.length or (length < message.length and not short):
            self.counts["wrong_length"] += 1
            return None
        try:
            values: Any = message.decode(frame.data, decode_choices=False, allow_truncated=short)
        except Exception:  # whatever a library makes of garbage from the bus, the loop goes on
            self.counts["unknown_multiplexer"] += 1
            return None
        for signal in self._perhaps_none[message.name]:
            value = values.get(signal.name)
            if value is not None and (value in signal.no_value or not math.isfinite(value)):
                values[signal.name] = None
        return message.name, values


def _check(facts: MessageFacts, name: str, value: float) -> None:
    signal = facts.signals.get(name)
    if signal is None:
        raise ValueError(f"{facts.name} has no signal {name}")
    slack = abs(signal.scale) * RANGE_SLACK_STEPS
    if not signal.minimum - slack <= value <= signal.maximum + slack:  # nan neither
        raise ValueError(
            f"{name} of {facts.name} is {value}, but goes from {signal.minimum:g} to {signal.maximum:g} {signal.unit}"
        )


def _is_in(signal: SignalFacts, values: Mapping[str, float], facts: MessageFacts) -> bool:
    """Whether a signal is in the frame that has these values: by its multiplexer, and that one's, if it has one."""
    if not signal.multiplexer:
        return True
    selector = facts.signals[signal.multiplexer]
    return selector.number(values[selector.name]) in signal.branches and _is_in(selector, values, facts)


def _loaded(dbc: Path) -> Database:
    try:
        cantools = import_module("cantools")  # an extra
    except ImportError as error:
        raise UserError(f"drive-by-wire needs cantools ({error}): pip install 'lavt[can]'") from error
    try:
        loaded: Database = cantools.database.load_file(dbc, database_format="dbc")
    except OSError as error:
        raise UserError(f"{dbc} cannot be read ({error.strerror}): name a DBC file") from error
    except Exception as error:  # a parser that is given anything fails with anything
        why = str(error).partition("\n")[0]
        raise UserError(f"{dbc} is no DBC file that can be read ({why}): name one that is") from error
    if not loaded.messages:
        raise UserError(f"{dbc} has no message: name a DBC file")
    return loaded


def _facts(message: Message) -> MessageFacts:
    return MessageFacts(
        name=message.name,
        identifier=message.frame_id,
        is_extended=message.is_extended_frame,
        length=message.length,
        signals={signal.name: _signal_facts(signal) for signal in message.signals},
        timeout_ns=_milliseconds(_attribute(message, "TimeoutMs")),
        period_ns=_milliseconds(message.cycle_time),
        senders=tuple(message.senders),
    )


def _signal_facts(signal: Signal) -> SignalFacts:
    lowest, highest = _number_range(signal)
    scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
    ends = sorted((lowest * scale + offset, highest * scale + offset))
    names = {int(number): str(name) for number, name in (signal.choices or {}).items()}
    return SignalFacts(
        name=signal.name,
        start=signal.start,
        bits=signal.length,
        is_signed=signal.is_signed,
        is_float=signal.conversion.is_float,
        scale=scale,
        offset=offset,
        minimum=max(ends[0], -math.inf if signal.minimum is None else signal.minimum),
        maximum=min(ends[1], math.inf if signal.maximum is None else signal.maximum),
        unit=signal.unit or "",
        names=names,
        is_unverified=_attribute(signal, "Unverified") == 1,
        is_multiplexer=signal.is_multiplexer,
        multiplexer=signal.multiplexer_signal or "",
        branches=frozenset(signal.multiplexer_ids or ()),
        no_value=frozenset(
            float(signal.conversion.raw_to_scaled(number, decode_choices=False))  # type: ignore[arg-type]
            for number, name in names.items()
            if name.upper() in NO_VALUE
        ),
    )


def _number_range(signal: Signal) -> tuple[float, float]:
    """What numbers the signal's bits hold."""
    if signal.conversion.is_float:
        return -math.inf, math.inf
    if signal.is_signed:
        return -(1 << (signal.length - 1)), (1 << (signal.length - 1)) - 1
    return 0, (1 << signal.length) - 1


def _attribute(owner: Message | Signal, name: str) -> Any:
    attributes = owner.dbc.attributes if owner.dbc else {}
    return attributes[name].value if name in attributes else None


def _milliseconds(count: Any) -> int | None:
    """As nanoseconds; a DBC says 0 where it has none."""
    return int(count) * NS_PER_MS if count else None
