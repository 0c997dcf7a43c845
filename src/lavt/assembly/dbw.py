"""By-wire vehicles of configs: a profile's YAML file and its DBC become a `Profile`, where the two agree."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from hashlib import sha256
from importlib import resources
from pathlib import Path
from typing import Literal, TypeVar, get_args

from lavt.config.dbw import CommandConfig, CommandSet, ProfileConfig, ReportConfig, SentConfig, SystemCommandConfig
from lavt.config_file import parse_config, read_yaml
from lavt.domain import NS_PER_MS
from lavt.errors import UserError
from lavt.vehicle.dbw.codec import Codec, MessageFacts, SignalFacts
from lavt.vehicle.dbw.profile import (
    AXES,
    IN_DEGREES,
    IN_DEGREES_PER_SECOND,
    IN_FRACTIONS,
    IN_METRES_PER_SECOND,
    AxisCommand,
    ByWireCar,
    ByWireLimits,
    GearCommand,
    OwnBrake,
    Profile,
    ReportSpec,
    SignalCondition,
    SystemCommand,
)

COARSEST_PEDAL = 0.02
"""Of a whole pedal; a DBC that says nothing of a number from 0 to 65535 would have a brake of 1 in 65535."""

Choice = TypeVar("Choice", str, list[int])


def shipped_profiles() -> dict[str, Path]:
    """List the profiles that come with LAVT, by name."""
    folder = Path(str(resources.files("lavt.vehicle.dbw") / "profiles"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_profile(name_or_path: str, dbc: str = "", steering_sign: Literal[1, -1] | None = None) -> Profile:
    """Read a profile by its name or its YAML file, and check it against its DBC, or against `dbc` instead.

    `:remote` or `:user` behind the name chooses the set of commands. `steering_sign` is for a profile that leaves it
    open. Raises `UserError` for a file that is missing or wrong, and where profile and DBC do not agree.
    """
    config, codec = read_profile(name_or_path, dbc)
    sign = _sign_of_steering(config, steering_sign, name_or_path)
    return dataclasses.replace(
        (profile := _Reader(config, codec, name_or_path).profile()),
        car=dataclasses.replace(profile.car, steering_sign=sign),
    )


def read_profile(name_or_path: str, dbc: str = "") -> tuple[ProfileConfig, Codec]:
    """Read a profile and its DBC as `load_profile` does, without checking the one against the other."""
    name, chosen = _split(name_or_path)
    path = _path_of(name)
    config = parse_config(ProfileConfig, read_yaml(path), str(path))
    if chosen is not None:
        if config.commands is None:
            raise UserError(f"{name} has one set of commands only: leave out :{chosen}")
        config = config.model_copy(update={"commands": chosen})
    return config, Codec(_dbc_of(path, config, dbc))


def profile_digest(name_or_path: str, dbc: str = "") -> str:
    """Give the SHA-256 of a profile's YAML file and DBC, in hexadecimal digits."""
    path = _path_of(_split(name_or_path)[0])
    config = parse_config(ProfileConfig, read_yaml(path), str(path))
    return sha256(
        b"".join(sha256(each.read_bytes()).digest() for each in (path, _dbc_of(path, config, dbc)))
    ).hexdigest()


def _path_of(name: str) -> Path:
    path = shipped_profiles().get(name, Path(name))
    if path.suffix != ".yaml" and not path.exists():
        raise UserError(f"there is no profile {name!r}: name a YAML file, or one of {', '.join(shipped_profiles())}")
    return path


def _dbc_of(path: Path, config: ProfileConfig, dbc: str) -> Path:
    return Path(dbc) if dbc else path.parent / config.dbc


def _split(name_or_path: str) -> tuple[str, CommandSet | None]:
    name, _, last = name_or_path.rpartition(":")
    for each in get_args(CommandSet):
        if name and last == each:
            return name, each
    return name_or_path, None


def _sign_of_steering(config: ProfileConfig, given: Literal[1, -1] | None, name: str) -> Literal[1, -1] | None:
    own = config.vehicle.steering_sign
    if own is not None and given is not None and own != given:
        raise UserError(f"{name} has steering_sign {own}, not {given}: leave vehicle.dbw.steering_sign out")
    return own if given is None else given


class _Reader:
    """Reads a profile beside its DBC, and keeps a list of the signals that it uses."""

    def __init__(self, config: ProfileConfig, codec: Codec, name: str) -> None:
        self.config, self.codec, self.name = config, codec, name
        self.used: dict[str, bool] = {}
        """`message.signal`: whether it is unverified."""

    def profile(self) -> Profile:
        """Give the profile."""
        config = self.config
        reports = {
            report.message: self._report(part, report)
            for part in type(config.reports).model_fields
            if (report := getattr(config.reports, part)).message
        }
        self._whole(reports)
        return Profile(
            name=self.name,
            kit=config.kit,
            commands=config.commands,
            car=ByWireCar(**config.vehicle.model_dump()),
            limits=ByWireLimits(**config.limits.model_dump()),
            command_step_deg=config.command_step_deg,
            axes={axis: self._axis(axis, getattr(config.sent, axis)) for axis in AXES},
            gear=self._gear(config.sent),
            system=self._system(config.sent.system),
            clearing_bytes=config.sent.clearing_bytes,
            reports=reports,
            watchdog=self._watchdog(),
            speed_per_mps=self._unit_of(reports, "speed", IN_METRES_PER_SECOND),
            angle_per_deg=self._unit_of(reports, "angle", IN_DEGREES),
            unverified=tuple(name for name, is_unverified in self.used.items() if is_unverified),
            codec=self.codec,
        )

    def _axis(self, axis: str, command: CommandConfig) -> AxisCommand:
        message = self._message(command.message)
        value = self._signal(message, command.value)
        units, limits = (IN_DEGREES if axis == "steering" else IN_FRACTIONS), self.config.limits
        per_unit = self._unit(value, message, units)
        most = limits.steering_wheel_deg if axis == "steering" else getattr(limits, axis)
        for end in (most, -most if axis == "steering" else 0.0):
            self._fits(message, value, end * per_unit)
        if axis != "steering" and abs(value.scale) > COARSEST_PEDAL * per_unit:
            raise UserError(
                f"{self.name}: a step of {value.name} of {message.name} is {abs(value.scale) / per_unit:.0%} of a pedal"
                ": give it its scale or its unit in the DBC"
            )
        constants: dict[str, float] = {}
        if value.multiplexer:
            self._signal(message, value.multiplexer)
            constants[value.multiplexer] = min(value.branches)
        if command.rate:
            constants[command.rate] = self._rate(message, command)
        return AxisCommand(
            message=message.name,
            value=value.name,
            per_unit=per_unit,
            constants=constants,
            enable=self._signal(message, command.enable).name,
            clear=self._signal(message, command.clear).name,
            count=self._named(message, command.count),
            modulus=self._modulus(message, command.count),
            checksum=self._checksum(message, command.checksum),
        )

    def _rate(self, message: MessageFacts, command: CommandConfig) -> float:
        """Give the rate that is commanded: the limit's, cut off to a step, as 0 may be the kit's default at least one.

        A greater one would let the wheel turn faster than is allowed.
        """
        signal = self._signal(message, command.rate)
        unit = self._unit(signal, message, IN_DEGREES_PER_SECOND) / command.rate_unit_degps
        wanted = min(self.config.limits.steering_wheel_rate_degps * unit, signal.maximum)
        steps = math.floor(wanted / signal.scale + 1e-9)
        if steps < 1:
            raise UserError(
                f"{self.name}: limits.steering_wheel_rate_degps is less than one of {signal.name}: raise it"
            )
        return steps * signal.scale

    def _gear(self, sent: SentConfig) -> GearCommand:
        message = self._message(sent.gear.message)
        value = self._signal(message, sent.gear.value)
        for gear in ("park", "drive"):
            if gear not in sent.gears:
                raise UserError(f"{self.name}: sent.gears has no {gear}: give its number")
        for number in sent.gears.values():
            self._fits(message, value, number)
        return GearCommand(
            message=message.name,
            value=value.name,
            clear=self._named(message, sent.gear.clear),
            numbers=dict(sent.gears),
            checksum=self._checksum(message, sent.gear.checksum),
        )

    def _system(self, command: SystemCommandConfig) -> SystemCommand | None:
        if not command.message:
            return None
        message = self._message(command.message)
        value = self._signal(message, command.value)
        for number in (command.enable, command.disable):
            self._fits(message, value, number)
        return SystemCommand(
            message=message.name,
            value=value.name,
            enable=command.enable,
            disable=command.disable,
            count=self._named(message, command.count),
            modulus=self._modulus(message, command.count),
            checksum=self._checksum(message, command.checksum),
        )

    def _report(self, part: str, report: ReportConfig) -> ReportSpec:
        message = self._message(report.message)
        return ReportSpec(
            part=part,
            timeout_ns=report.timeout_ms * NS_PER_MS,
            values={word: self._signal(message, signal).name for word, signal in report.values.items()},
            no_value={
                word: -(1 << signal.bits - 1) * signal.scale + signal.offset
                for word, name in report.values.items()
                if (signal := self._signal(message, name)).is_signed
            },
            override=self._signs(message, report.override),
            trip=self._signs(message, report.trip),
            command_error=self._signs(message, report.command_error),
            fault=self._signs(message, report.fault),
            needs={
                self._signal(message, signal).name: frozenset(self._of_set(numbers, f"{part}.needs.{signal}"))
                for signal, numbers in report.needs.items()
            },
            reasons=tuple(self._signal(message, signal).name for signal in report.reasons),
            checksum=self._checksum(message, report.checksum),
        )

    def _watchdog(self) -> OwnBrake | None:
        watchdog = self.config.watchdog
        if not watchdog.signal:
            return None
        message = self._message(self.config.reports.brake.message)
        return OwnBrake(message.name, self._signal(message, watchdog.signal).name, watchdog.above)

    def _signs(self, message: MessageFacts, signs: Mapping[str, str]) -> tuple[SignalCondition, ...]:
        found = []
        for key, words in signs.items():
            name, equals, number = key.partition("=")
            if equals and not number.isdecimal():
                raise UserError(f"{self.name}: {key!r} of {message.name} is no sign: write SIGNAL or SIGNAL=number")
            found.append(SignalCondition(self._signal(message, name).name, int(number) if equals else None, words))
        return tuple(found)

    def _whole(self, reports: Mapping[str, ReportSpec]) -> None:
        """Make sure that everything is reported without which nothing can be driven."""
        told = {(report.part, word) for report in reports.values() for word in report.values}
        wanted = [*((axis, "enabled") for axis in AXES), ("steering", "angle"), ("gear", "gear")]
        for part, word in wanted:
            if (part, word) not in told:
                raise UserError(f"{self.name}: reports.{part}.values has no {word}: name its signal")
        if not any(word == "speed" for _, word in told):
            raise UserError(f"{self.name}: no report has a speed: name its signal in reports.speed.values")

    # What the DBC has.

    def _message(self, name: str | dict[CommandSet, str]) -> MessageFacts:
        chosen = self._of_set(name, "a message")
        if chosen not in self.codec.messages:
            raise UserError(f"{self.name}: its DBC has no message {chosen!r}: change the profile, or name another DBC")
        return self.codec.messages[chosen]

    def _of_set(self, value: Choice | dict[CommandSet, Choice], where: str) -> Choice:
        if not isinstance(value, dict):
            return value
        chosen = self.config.commands
        if chosen is None or chosen not in value:
            raise UserError(f"{self.name}: {where} is for {_either(value)}: say in commands which")
        return value[chosen]

    def _signal(self, message: MessageFacts, name: str) -> SignalFacts:
        if name not in message.signals:
            raise UserError(
                f"{self.name}: {message.name} of its DBC has no signal {name!r}: change the profile, or name another"
            )
        self.used[f"{message.name}.{name}"] = message.signals[name].is_unverified
        return message.signals[name]

    def _named(self, message: MessageFacts, name: str) -> str:
        return self._signal(message, name).name if name else ""

    def _modulus(self, message: MessageFacts, name: str) -> int:
        return 1 << self._signal(message, name).bits if name else 1

    def _checksum(self, message: MessageFacts, name: str) -> str:
        """Give the name of a checksum, which has to be the whole last byte."""
        if name:
            signal = self._signal(message, name)
            if (signal.bits, signal.start // 8) != (8, message.length - 1):
                raise UserError(
                    f"{self.name}: {name} of {message.name} is not its last byte, as a checksum here must be"
                )
        return name

    def _unit(self, signal: SignalFacts, message: MessageFacts, units: Mapping[str, float]) -> float:
        if signal.unit not in units:
            raise UserError(
                f"{self.name}: {signal.name} of {message.name} is in {signal.unit!r}: name a signal in "
                f"{_either(repr(unit) for unit in units)}"
            )
        return units[signal.unit]

    def _unit_of(self, reports: Mapping[str, ReportSpec], word: str, units: Mapping[str, float]) -> float:
        """Give the unit of a reported value."""
        name, report = next((name, report) for name, report in reports.items() if word in report.values)
        message = self.codec.messages[name]
        return self._unit(message.signals[report.values[word]], message, units)

    def _fits(self, message: MessageFacts, signal: SignalFacts, value: float) -> None:
        slack = abs(signal.scale) / 2
        if not signal.minimum - slack <= value <= signal.maximum + slack:
            raise UserError(
                f"{self.name}: {value:g} does not fit {signal.name} of {message.name}, which goes from "
                f"{signal.minimum:g} to {signal.maximum:g}: change the limit or the number in the profile"
            )


def _either(words: Iterable[str]) -> str:
    return " or ".join(words)
