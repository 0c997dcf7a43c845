"""Whether a by-wire profile and its DBC agree: every disagreement, not only the first, in a sentence of its own."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from lavt.config.dbw import CommandConfig, CommandSet, ProfileConfig, ReportConfig, SystemCommandConfig
from lavt.domain import NS_PER_MS
from lavt.vehicle.dbw.codec import Codec, MessageFacts, SignalFacts
from lavt.vehicle.dbw.profile import AXES, PERIOD_NS, Profile

MOST_BYTES: Final = 8
LEAST_PERIODS: Final = 2
"""A time-out bears one message that is lost."""


@dataclass(frozen=True, slots=True)
class _Use:
    """A signal as the profile uses it; `where` is the profile's key."""

    where: str
    message: MessageFacts
    signal: SignalFacts
    role: str


def disagreements(config: ProfileConfig, codec: Codec) -> list[str]:
    """Say in what a profile and its DBC disagree; empty: in nothing that is looked at here.

    Looked at are messages and signals (that they are there), identifiers and lengths, places and sizes of switches,
    counters and checksums, types of multiplexed commands, limits and numbers beside ranges and names, and time-outs
    beside periods.
    """
    found = [*_of_identifiers(codec)]
    uses: list[_Use] = []
    for where, message_name, roles in _parts(config):
        message = codec.messages.get(message_name)
        if message is None:
            nearest = _nearest(message_name, codec.messages)
            found.append(f"{where}: the DBC has no message {message_name or 'of this set of commands'}{nearest}")
            continue
        if message.length > MOST_BYTES:
            found.append(f"{where}: {message.name} has {message.length} bytes, a frame at most {MOST_BYTES}")
        for role, name in roles:
            signal = message.signals.get(name)
            if signal is None:
                nearest = _nearest(name, message.signals)
                found.append(f"{where}.{role}: {message.name} has no signal {name}{nearest}")
            else:
                uses.append(_Use(where, message, signal, role))
    for check in (_of_places, _of_branches, _of_doubles):
        found += check(uses)
    for check_numbers in (_of_limits, _of_numbers, _of_clearing):
        found += check_numbers(config, uses)
    return [*found, *_of_times(config, codec)]


def hindrances_on_a_real_bus(profile: Profile) -> list[str]:
    """Say why a profile may not arm where a real kit can be on the bus, whatever the kit's watchdog does."""
    found = []
    if profile.unverified:
        found.append(
            f"{len(profile.unverified)} of the profile's signals have an assumed place, such as "
            f"{profile.unverified[0]}: name the vendor's DBC in vehicle.dbw.dbc"
        )
    if profile.car.steering_sign is None:
        found.append("which sign of the steering is left is not known: try it, and say it in vehicle.dbw.steering_sign")
    return found


def _parts(config: ProfileConfig) -> Iterator[tuple[str, str, list[tuple[str, str]]]]:
    """Walk through what is sent and read: the profile's key, the message, and its signals by role."""
    sent, reports = config.sent, config.reports
    for name in ("steering", "brake", "throttle", "gear", "system"):
        command: CommandConfig | SystemCommandConfig = getattr(sent, name)
        roles = ("value", "enable", "clear", "rate", "count", "checksum")
        if command.message:
            signals = [(role, getattr(command, role, "")) for role in roles]
            named = [(role, signal) for role, signal in signals if isinstance(signal, str) and signal]
            yield f"sent.{name}", _of_set(command.message, config), named
    for name in type(reports).model_fields:
        report: ReportConfig = getattr(reports, name)
        if report.message:
            yield f"reports.{name}", _of_set(report.message, config), list(_read(report))
    if config.watchdog.signal:
        yield "watchdog", _of_set(reports.brake.message, config), [("signal", config.watchdog.signal)]


def _read(report: ReportConfig) -> Iterator[tuple[str, str]]:
    """The signals of a report, by role."""
    for word, signal in report.values.items():
        yield f"values.{word}", signal
    for group in ("override", "trip", "command_error", "fault"):
        for sign in getattr(report, group):
            yield f"{group}.{sign}", sign.partition("=")[0]
    for signal in report.needs:
        yield f"needs.{signal}", signal
    for signal in report.reasons:
        yield "reasons", signal
    if report.checksum:
        yield "checksum", report.checksum


def _of_set(message: str | dict[CommandSet, str], config: ProfileConfig) -> str:
    if isinstance(message, str):
        return message
    return message.get(config.commands, "") if config.commands else ""


def _of_identifiers(codec: Codec) -> Iterator[str]:
    owners: dict[tuple[int, bool], str] = {}
    for message in codec.messages.values():
        first = owners.setdefault((message.identifier, message.is_extended), message.name)
        if first != message.name:
            yield f"the DBC has two messages of identifier 0x{message.identifier:03X}: {first} and {message.name}"


def _is_switch(use: _Use) -> bool:
    return use.signal.bits == 1


def _is_last_byte(use: _Use) -> bool:
    return use.signal.bits == 8 and use.signal.start // 8 == use.message.length - 1


def _counts(use: _Use) -> bool:
    return use.signal.bits > 1 and not use.signal.is_signed and use.signal.scale == 1


PLACES: Final[Mapping[str, tuple[Callable[[_Use], bool], str]]] = {
    "enable": (_is_switch, "is no single bit, as a switch has to be"),
    "clear": (_is_switch, "is no single bit, as a switch has to be"),
    "values.enabled": (_is_switch, "is no single bit, as a switch has to be"),
    "count": (_counts, "is no unsigned number of several bits, as a counter has to be"),
    "checksum": (_is_last_byte, "is not the last byte, as a checksum here must be"),
}
"""By role: what its signal has to be, and what to say where it is not."""


def _of_places(uses: Sequence[_Use]) -> Iterator[str]:
    for use in uses:
        fits, words = PLACES.get(use.role, (lambda _: True, ""))
        if not fits(use):
            yield f"{use.where}.{use.role}: {use.signal.name} of {use.message.name} {words}"


def _of_branches(uses: Sequence[_Use]) -> Iterator[str]:
    """A command's type follows from its value's multiplexer: there has to be one type, and the rest has to be in it."""
    for value in uses:
        if value.role != "value" or not value.signal.multiplexer:
            continue
        if len(value.signal.branches) != 1:
            numbers = ", ".join(map(str, sorted(value.signal.branches)))
            yield f"{value.where}.value: {value.signal.name} is in types {numbers}: which is meant is open"
        for other in uses:
            is_beside = other.where == value.where and other.signal.multiplexer == value.signal.multiplexer
            if is_beside and not value.signal.branches & other.signal.branches:
                yield f"{other.where}.{other.role}: {other.signal.name} is in no frame with {value.signal.name}"


def _of_doubles(uses: Sequence[_Use]) -> Iterator[str]:
    roles: dict[tuple[str, str], str] = {}
    for use in uses:
        if use.where.startswith("sent."):
            first = roles.setdefault((use.where, use.signal.name), use.role)
            if first != use.role:
                yield f"{use.where}: {use.signal.name} is both {first} and {use.role}"


def _of_limits(config: ProfileConfig, uses: Sequence[_Use]) -> Iterator[str]:
    """What may be asked for fits the signal, where the units are known."""
    ends = {
        "sent.steering": (-config.limits.steering_wheel_deg, config.limits.steering_wheel_deg, {"deg": 1.0}),
        "sent.brake": (0.0, config.limits.brake, {"": 1.0, "%": 100.0}),
        "sent.throttle": (0.0, config.limits.throttle, {"": 1.0, "%": 100.0}),
    }
    for use in uses:
        if use.role == "value" and use.where in ends:
            low, high, units = ends[use.where]
            per_unit = units.get(use.signal.unit, 0.0)  # another unit is told of when the profile is read
            for end in (low * per_unit, high * per_unit):
                if not use.signal.minimum - 1e-9 <= end <= use.signal.maximum + 1e-9:
                    yield (
                        f"{use.where}.value: the limit {end:g} is not in the range of {use.signal.name}, "
                        f"{use.signal.minimum:g} to {use.signal.maximum:g}"
                    )


def _of_numbers(config: ProfileConfig, uses: Sequence[_Use]) -> Iterator[str]:
    """Numbers that are sent or looked for exist, and the DBC calls them what the profile does."""
    for use in uses:
        for words, number, meaning in _numbers(config, use):
            signal = use.signal
            if not signal.minimum <= number <= signal.maximum:
                yield f"{use.where}.{use.role}: {words} does not fit {signal.name}, which ends at {signal.maximum:g}"
            elif signal.names and signal.names.get(number, "").upper() != meaning.upper() and meaning:
                called = signal.names.get(number, "nothing")
                yield f"{use.where}.{use.role}: {words}, but the DBC calls {number} of {signal.name} {called}"
            elif signal.names and number not in signal.names:
                yield f"{use.where}.{use.role}: {words}, for which {signal.name} has no name in the DBC"


def _numbers(config: ProfileConfig, use: _Use) -> Iterator[tuple[str, int, str]]:
    """What numbers a use means: in words, itself, and what the DBC should call it (empty: whatever it likes)."""
    part = use.where.partition(".")[2]
    if use.where == "sent.gear" and use.role == "value":
        yield from ((f"{gear} is {number}", number, gear) for gear, number in config.sent.gears.items())
    elif use.where == "sent.system" and use.role == "value":
        system = config.sent.system
        yield f"enable is {system.enable}", system.enable, "enable"
        yield f"disable is {system.disable}", system.disable, "disable"
    elif use.role.startswith("needs."):
        needed = getattr(config.reports, part).needs[use.signal.name]
        chosen = needed.get(config.commands or "remote", []) if isinstance(needed, dict) else needed
        yield from ((f"{number} is needed", number, "") for number in chosen)
    elif "=" in use.role:
        text = use.role.partition("=")[2]
        if text.isdecimal():
            yield f"{text} is looked for", int(text), ""


def _of_clearing(config: ProfileConfig, uses: Sequence[_Use]) -> Iterator[str]:
    """What clears an override is in the bytes that are sent for it."""
    most = config.sent.clearing_bytes or MOST_BYTES
    for use in uses:
        is_sent_short = use.role == "clear" and use.where.partition(".")[2] in AXES
        if is_sent_short and use.signal.start // 8 >= most:
            yield f"{use.where}.clear: {use.signal.name} is not in the first {most} bytes (sent.clearing_bytes)"


def _of_times(config: ProfileConfig, codec: Codec) -> Iterator[str]:
    """Time-outs are no longer than the DBC's, and bear a lost message."""
    for where, name, _ in _parts(config):
        message = codec.messages.get(name)
        if message is None:
            continue
        if where.startswith("sent."):
            if message.timeout_ns is not None and message.timeout_ns < LEAST_PERIODS * PERIOD_NS:
                yield f"{where}: {name} has to come each {_ms(message.timeout_ns)}, and comes each {_ms(PERIOD_NS)}"
            continue
        if where == "watchdog":
            continue
        timeout_ns = getattr(config.reports, where.partition(".")[2]).timeout_ms * NS_PER_MS
        if message.timeout_ns is not None and timeout_ns > message.timeout_ns:
            yield f"{where}.timeout_ms: {_ms(timeout_ns)} is longer than the DBC's {_ms(message.timeout_ns)}"
        if message.period_ns is not None and timeout_ns < LEAST_PERIODS * message.period_ns:
            period = _ms(message.period_ns)
            yield f"{where}.timeout_ms: {_ms(timeout_ns)} is too short for {name}, which comes each {period}"


def _ms(duration_ns: int) -> str:
    return f"{duration_ns / NS_PER_MS:g} ms"


def _nearest(name: str, known: Mapping[str, object]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    return f"; the nearest is {close[0]}" if close else ""
