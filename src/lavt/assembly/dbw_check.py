"""The check of a by-wire profile against its DBC: each mismatch becomes one sentence."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from lavt.config.dbw import CommandConfig, CommandSet, ProfileConfig, ReportConfig, SystemCommandConfig
from lavt.domain import NS_PER_MS
from lavt.vehicle.dbw.codec import Codec, MessageFacts, SignalFacts
from lavt.vehicle.dbw.profile import AXES, REPEAT_PERIOD_NS, Profile

MAX_FRAME_BYTES: Final = 8
MIN_PERIODS_PER_TIMEOUT: Final = 2
"""A timeout of fewer periods would not tolerate one lost message."""


@dataclass(frozen=True, slots=True)
class _SignalUse:
    """A signal that the profile uses."""

    key: str
    """The key of the profile that names the message, such as `sent.steering`."""
    message: MessageFacts
    signal: SignalFacts
    role: str
    """The key below `key` that names the signal, such as `value`."""


def find_mismatches(config: ProfileConfig, codec: Codec) -> list[str]:
    """Return all mismatches between a profile and its DBC.

    The check covers: the existence of messages and signals, identifiers and lengths; the positions and sizes of
    single-bit signals, counters and checksums; the multiplexer values of multiplexed commands; the ranges of limits;
    the ranges and names of the codes that the profile expects in signals; and timeouts compared with periods.
    """
    mismatches = [*_check_identifiers(codec)]
    uses: list[_SignalUse] = []
    for key, message_name, roles in _messages(config):
        message = codec.messages.get(message_name)
        if message is None:
            hint = _nearest_hint(message_name, codec.messages)
            mismatches.append(f"{key}: the DBC has no message {message_name or 'of this command set'}{hint}")
            continue
        if message.length > MAX_FRAME_BYTES:
            mismatches.append(
                f"{key}: {message.name} has {message.length} bytes, but a frame has at most {MAX_FRAME_BYTES}"
            )
        for role, name in roles:
            signal = message.signals.get(name)
            if signal is None:
                hint = _nearest_hint(name, message.signals)
                mismatches.append(f"{key}.{role}: {message.name} has no signal {name}{hint}")
            else:
                uses.append(_SignalUse(key, message, signal, role))
    for check in (_check_layouts, _check_multiplexing, _check_duplicates):
        mismatches += check(uses)
    for check_with_config in (_check_limits, _check_codes, _check_clearing):
        mismatches += check_with_config(config, uses)
    return [*mismatches, *_check_timeouts(config, codec)]


def real_bus_inhibit_reasons(profile: Profile) -> list[str]:
    """Return why a vehicle with this profile must not be armed on a bus that can have a real kit.

    Arming also requires a watchdog proof, which is not checked here.
    """
    reasons = []
    if profile.unverified:
        reasons.append(
            f"{len(profile.unverified)} of the profile's signals have an assumed layout, such as "
            f"{profile.unverified[0]}: name the vendor's DBC in vehicle.dbw.dbc"
        )
    if profile.car.steering_sign is None:
        reasons.append("the sign of steering to the left is unknown: find it out and set vehicle.dbw.steering_sign")
    return reasons


def _messages(config: ProfileConfig) -> Iterator[tuple[str, str, list[tuple[str, str]]]]:
    """Yield all messages that are sent or read: the profile's key, the message's name, and its (role, signal) pairs."""
    sent, reports = config.sent, config.reports
    for name in ("steering", "brake", "throttle", "gear", "system"):
        command: CommandConfig | SystemCommandConfig = getattr(sent, name)
        roles = ("value", "enable", "clear", "rate", "count", "checksum")
        if command.message:
            signals = [(role, getattr(command, role, "")) for role in roles]
            named = [(role, signal) for role, signal in signals if isinstance(signal, str) and signal]
            yield f"sent.{name}", _message_name(command.message, config), named
    for name in type(reports).model_fields:
        report: ReportConfig = getattr(reports, name)
        if report.message:
            yield f"reports.{name}", _message_name(report.message, config), list(_report_signals(report))
    if config.watchdog.signal:
        yield "watchdog", _message_name(reports.brake.message, config), [("signal", config.watchdog.signal)]


def _report_signals(report: ReportConfig) -> Iterator[tuple[str, str]]:
    """Yield the (role, signal) pairs of a report."""
    for value, signal in report.values.items():
        yield f"values.{value}", signal
    for kind in ("override", "trip", "command_error", "fault"):
        for signal_condition in getattr(report, kind):
            yield f"{kind}.{signal_condition}", signal_condition.partition("=")[0]
    for signal in report.needs:
        yield f"needs.{signal}", signal
    for signal in report.reasons:
        yield "reasons", signal
    if report.count:
        yield "count", report.count
    if report.checksum:
        yield "checksum", report.checksum


def _message_name(message: str | dict[CommandSet, str], config: ProfileConfig) -> str:
    """Return the name of a message in the profile's command set; empty if the set has no such message."""
    if isinstance(message, str):
        return message
    return message.get(config.commands, "") if config.commands else ""


def _check_identifiers(codec: Codec) -> Iterator[str]:
    owners: dict[tuple[int, bool], str] = {}
    for message in codec.messages.values():
        owner = owners.setdefault((message.identifier, message.is_extended), message.name)
        if owner != message.name:
            yield f"the DBC has two messages of identifier 0x{message.identifier:03X}: {owner} and {message.name}"


def _is_single_bit(use: _SignalUse) -> bool:
    return use.signal.bits == 1


def _is_last_byte(use: _SignalUse) -> bool:
    return use.signal.bits == 8 and use.signal.start // 8 == use.message.length - 1


def _is_counter(use: _SignalUse) -> bool:
    return use.signal.bits > 1 and not use.signal.is_signed and use.signal.scale == 1


LAYOUTS: Final[Mapping[str, tuple[Callable[[_SignalUse], bool], str]]] = {
    "enable": (_is_single_bit, "is not a single bit, as a switch must be"),
    "clear": (_is_single_bit, "is not a single bit, as a switch must be"),
    "values.enabled": (_is_single_bit, "is not a single bit, as a switch must be"),
    "count": (_is_counter, "is not an unsigned number of several bits, as a counter must be"),
    "checksum": (_is_last_byte, "is not the last byte, as a checksum must be here"),
}
"""The required layout of a signal by role: a predicate, and the end of the sentence that reports a violation."""


def _check_layouts(uses: Sequence[_SignalUse]) -> Iterator[str]:
    for use in uses:
        is_valid, complaint = LAYOUTS.get(use.role, (lambda _: True, ""))
        if not is_valid(use):
            yield f"{use.key}.{use.role}: {use.signal.name} of {use.message.name} {complaint}"


def _check_multiplexing(uses: Sequence[_SignalUse]) -> Iterator[str]:
    """Check that the signals of a multiplexed command are in the same frames, those of a single multiplexer value."""
    for use in uses:
        if use.role != "value" or not use.signal.multiplexer:
            continue
        if len(use.signal.branches) != 1:
            multiplexer_values = ", ".join(map(str, sorted(use.signal.branches)))
            yield (
                f"{use.key}.value: {use.signal.name} is in the frames of several multiplexer values "
                f"({multiplexer_values}), so the value to send is ambiguous"
            )
        for other in uses:
            shares_multiplexer = other.key == use.key and other.signal.multiplexer == use.signal.multiplexer
            if shares_multiplexer and not use.signal.branches & other.signal.branches:
                yield f"{other.key}.{other.role}: {other.signal.name} shares no frame with {use.signal.name}"


def _check_duplicates(uses: Sequence[_SignalUse]) -> Iterator[str]:
    """Check that no signal of a command has two roles."""
    roles: dict[tuple[str, str], str] = {}
    for use in uses:
        if use.key.startswith("sent."):
            earlier_role = roles.setdefault((use.key, use.signal.name), use.role)
            if earlier_role != use.role:
                yield f"{use.key}: {use.signal.name} is both {earlier_role} and {use.role}"


def _check_limits(config: ProfileConfig, uses: Sequence[_SignalUse]) -> Iterator[str]:
    """Check that the limits of the commands are in the ranges of their signals, if the unit is known."""
    limits = {
        "sent.steering": (-config.limits.steering_wheel_deg, config.limits.steering_wheel_deg, {"deg": 1.0}),
        "sent.brake": (0.0, config.limits.brake, {"": 1.0, "%": 100.0}),
        "sent.throttle": (0.0, config.limits.throttle, {"": 1.0, "%": 100.0}),
    }
    for use in uses:
        if use.role == "value" and use.key in limits:
            low, high, units = limits[use.key]
            per_unit = units.get(use.signal.unit, 0.0)  # an unknown unit is reported when the profile is loaded
            for limit in (low * per_unit, high * per_unit):
                if not use.signal.minimum - 1e-9 <= limit <= use.signal.maximum + 1e-9:
                    yield (
                        f"{use.key}.value: the limit {limit:g} is not in the range of {use.signal.name}, "
                        f"{use.signal.minimum:g} to {use.signal.maximum:g}"
                    )


def _check_codes(config: ProfileConfig, uses: Sequence[_SignalUse]) -> Iterator[str]:
    """Check that the profile's codes are in the ranges of their signals and have the same names in the DBC."""
    for use in uses:
        for statement, code, expected_name in _expected_codes(config, use):
            signal = use.signal
            if not signal.minimum <= code <= signal.maximum:
                yield (
                    f"{use.key}.{use.role}: {statement}, which is not in the range of {signal.name}, "
                    f"{signal.minimum:g} to {signal.maximum:g}"
                )
            elif signal.names and signal.names.get(code, "").upper() != expected_name.upper() and expected_name:
                name = f"is named {signal.names[code]!r}" if code in signal.names else "has no name"
                yield f"{use.key}.{use.role}: {statement}, but in the DBC the value {code} of {signal.name} {name}"
            elif signal.names and code not in signal.names:
                yield f"{use.key}.{use.role}: {statement}, but in the DBC the value {code} of {signal.name} has no name"


def _expected_codes(config: ProfileConfig, use: _SignalUse) -> Iterator[tuple[str, int, str]]:
    """Yield the codes that the profile expects: a statement, the code, and its name in the DBC (empty: any name)."""
    part = use.key.partition(".")[2]
    if use.key == "sent.gear" and use.role == "value":
        yield from ((f"{gear} is {code}", code, gear) for gear, code in config.sent.gears.items())
    elif use.key == "sent.system" and use.role == "value":
        system = config.sent.system
        yield f"enable is {system.enable}", system.enable, "enable"
        yield f"disable is {system.disable}", system.disable, "disable"
    elif use.role.startswith("needs."):
        needs = getattr(config.reports, part).needs[use.signal.name]
        expected = needs.get(config.commands or "remote", []) if isinstance(needs, dict) else needs
        yield from ((f"{code} is expected", code, "") for code in expected)
    elif "=" in use.role:
        text = use.role.partition("=")[2]
        if text.isdecimal():
            yield f"{text} is expected", int(text), ""


def _check_clearing(config: ProfileConfig, uses: Sequence[_SignalUse]) -> Iterator[str]:
    """Check that the clearing signal of a command is in its first `sent.clearing_bytes` bytes.

    To clear an override, only these bytes of the command are sent.
    """
    sent_bytes = config.sent.clearing_bytes or MAX_FRAME_BYTES
    for use in uses:
        is_clearing = use.role == "clear" and use.key.partition(".")[2] in AXES
        if is_clearing and use.signal.start // 8 >= sent_bytes:
            yield f"{use.key}.clear: {use.signal.name} is not in the first {sent_bytes} bytes (sent.clearing_bytes)"


def _check_timeouts(config: ProfileConfig, codec: Codec) -> Iterator[str]:
    """Check that each timeout tolerates one lost message, and that no timeout is longer than the DBC's."""
    for key, name, _ in _messages(config):
        message = codec.messages.get(name)
        if message is None:
            continue
        if key.startswith("sent."):
            if message.timeout_ns is not None and message.timeout_ns < MIN_PERIODS_PER_TIMEOUT * REPEAT_PERIOD_NS:
                timeout = _ms(message.timeout_ns)
                yield f"{key}: {name} times out after {timeout}, too short for its period of {_ms(REPEAT_PERIOD_NS)}"
            continue
        if key == "watchdog":
            continue
        timeout_ns = getattr(config.reports, key.partition(".")[2]).timeout_ms * NS_PER_MS
        if message.timeout_ns is not None and timeout_ns > message.timeout_ns:
            yield f"{key}.timeout_ms: {_ms(timeout_ns)} is longer than the DBC's {_ms(message.timeout_ns)}"
        if message.period_ns is not None and timeout_ns < MIN_PERIODS_PER_TIMEOUT * message.period_ns:
            period = _ms(message.period_ns)
            yield f"{key}.timeout_ms: {_ms(timeout_ns)} is too short for {name}, which comes every {period}"


def _ms(duration_ns: int) -> str:
    return f"{duration_ns / NS_PER_MS:g} ms"


def _nearest_hint(name: str, known: Mapping[str, object]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    return f"; the nearest is {close[0]}" if close else ""
