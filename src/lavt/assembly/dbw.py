"""Loading of by-wire profiles: a YAML file and its DBC, which must match, become a `Profile`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from hashlib import sha256
from importlib import resources
from pathlib import Path
from typing import Literal, TypeVar, get_args

from lavt.config.dbw import (
    CommandConfig,
    CommandSet,
    DbwConfig,
    ProfileConfig,
    ReportConfig,
    SentConfig,
    SystemCommandConfig,
)
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
    IN_RADIANS_PER_SECOND,
    SPEEDS,
    WHEEL_SPEEDS,
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
from lavt.vehicle.dbw.speed_monitor import CONSTANT_WITHIN_MPS
from lavt.vehicle.dbw.states import STATIONARY_BELOW_MPS

MAX_PEDAL_STEP = 0.02
"""The largest accepted step of a pedal's signal, as a share of the pedal's range. A raw 16-bit value whose scale is
missing in the DBC has a larger step, and so is detected."""

Choice = TypeVar("Choice", str, list[int])


def shipped_profiles() -> dict[str, Path]:
    """Return the paths of the shipped profiles by name."""
    folder = Path(str(resources.files("lavt.vehicle.dbw") / "profiles"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_profile(name_or_path: str, dbc: str = "", steering_sign: Literal[1, -1] | None = None) -> Profile:
    """Load a profile by its name or path, and check it against the file `dbc`, or by default the DBC that it names.

    The suffix `:remote` or `:user` of the name selects the command set. `steering_sign` is only for a profile without a
    sign. Raises `UserError` for a missing or invalid file, and if profile and DBC do not match.
    """
    config, codec = read_profile(name_or_path, dbc)
    sign = _steering_sign(config, steering_sign, name_or_path)
    profile = _ProfileBuilder(config, codec, name_or_path).build()
    return dataclasses.replace(profile, car=dataclasses.replace(profile.car, steering_sign=sign))


def read_profile(name_or_path: str, dbc: str = "") -> tuple[ProfileConfig, Codec]:
    """Read a profile and its DBC as `load_profile` does, without checking that they match."""
    name, command_set = _split_suffix(name_or_path)
    path = _profile_path(name)
    config = parse_config(ProfileConfig, read_yaml(path), str(path))
    if command_set is not None:
        if config.commands is None:
            raise UserError(f"{name} has only one set of commands: leave out :{command_set}")
        config = config.model_copy(update={"commands": command_set})
    return config, Codec(_dbc_path(path, config, dbc))


def profile_digest(name_or_path: str, dbc: str = "") -> str:
    """Return the SHA-256 of a profile's YAML file and DBC, in hexadecimal digits."""
    path = _profile_path(_split_suffix(name_or_path)[0])
    config = parse_config(ProfileConfig, read_yaml(path), str(path))
    return sha256(
        b"".join(sha256(file.read_bytes()).digest() for file in (path, _dbc_path(path, config, dbc)))
    ).hexdigest()


def _profile_path(name: str) -> Path:
    path = shipped_profiles().get(name, Path(name))
    if path.suffix != ".yaml" and not path.exists():
        raise UserError(f"unknown profile {name!r}: name a YAML file, or one of {', '.join(shipped_profiles())}")
    return path


def _dbc_path(path: Path, config: ProfileConfig, dbc: str) -> Path:
    return Path(dbc) if dbc else path.parent / config.dbc


def _split_suffix(name_or_path: str) -> tuple[str, CommandSet | None]:
    """Split off the suffix: return the name or path without it, and the command set (None without a suffix)."""
    name, _, suffix = name_or_path.rpartition(":")
    for command_set in get_args(CommandSet):
        if name and suffix == command_set:
            return name, command_set
    return name_or_path, None


def _steering_sign(config: ProfileConfig, configured: Literal[1, -1] | None, name: str) -> Literal[1, -1] | None:
    own = config.vehicle.steering_sign
    if own is not None and configured is not None and own != configured:
        raise UserError(f"{name} has steering_sign {own}, not {configured}: leave vehicle.dbw.steering_sign out")
    return own if configured is None else configured


class _ProfileBuilder:
    """A builder of a profile from its config and DBC, which also collects the signals that the profile uses."""

    def __init__(self, config: ProfileConfig, codec: Codec, name: str) -> None:
        self.config, self.codec, self.name = config, codec, name
        self.used_signals: dict[str, SignalFacts] = {}
        """The signals that the profile uses, by `message.signal`."""

    def build(self) -> Profile:
        """Build the profile."""
        config = self.config
        reports = {
            report.message: self._report(part, report)
            for part in type(config.reports).model_fields
            if (report := getattr(config.reports, part)).message
        }
        self._check_complete(reports)
        speeds_per_mps = self._speed_units(reports)
        self._check_speed_steps(reports, speeds_per_mps)
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
            speeds_per_mps=speeds_per_mps,
            angle_per_deg=self._reported_factor(reports, "angle", IN_DEGREES),
            unverified=tuple(name for name, signal in self.used_signals.items() if signal.is_unverified),
            codec=self.codec,
        )

    def _axis(self, axis: str, command: CommandConfig) -> AxisCommand:
        message = self._message(command.message)
        value = self._signal(message, command.value)
        units, limits = (IN_DEGREES if axis == "steering" else IN_FRACTIONS), self.config.limits
        per_unit = self._signal_factor(value, message, units)
        limit = limits.steering_wheel_deg if axis == "steering" else getattr(limits, axis)
        for extreme in (limit, -limit if axis == "steering" else 0.0):
            self._check_range(message, value, extreme * per_unit)
        if axis != "steering" and abs(value.scale) > MAX_PEDAL_STEP * per_unit:
            raise UserError(
                f"{self.name}: a step of {value.name} of {message.name} is {abs(value.scale) / per_unit:.0%} of a pedal"
                ": set its scale or its unit in the DBC"
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
            count=self._optional_signal(message, command.count),
            modulus=self._modulus(message, command.count),
            checksum=self._checksum(message, command.checksum),
        )

    def _rate(self, message: MessageFacts, command: CommandConfig) -> float:
        """Return the commanded rate: the limit, rounded down to a multiple of the signal's step.

        Raise `UserError` if this rate is 0, because a kit can treat 0 as a request for its default rate.
        """
        signal = self._signal(message, command.rate)
        per_degps = self._signal_factor(signal, message, IN_DEGREES_PER_SECOND) / command.rate_unit_degps
        limit = min(self.config.limits.steering_wheel_rate_degps * per_degps, signal.maximum)
        steps = math.floor(limit / signal.scale + 1e-9)
        if steps < 1:
            raise UserError(
                f"{self.name}: limits.steering_wheel_rate_degps is less than one step of {signal.name}: raise it"
            )
        return steps * signal.scale

    def _gear(self, sent: SentConfig) -> GearCommand:
        message = self._message(sent.gear.message)
        value = self._signal(message, sent.gear.value)
        for gear in ("park", "drive"):
            if gear not in sent.gears:
                raise UserError(f"{self.name}: sent.gears has no {gear}: add its code")
        for code in sent.gears.values():
            self._check_range(message, value, code)
        return GearCommand(
            message=message.name,
            value=value.name,
            clear=self._optional_signal(message, sent.gear.clear),
            codes=dict(sent.gears),
            checksum=self._checksum(message, sent.gear.checksum),
        )

    def _system(self, command: SystemCommandConfig) -> SystemCommand | None:
        if not command.message:
            return None
        message = self._message(command.message)
        value = self._signal(message, command.value)
        for code in (command.enable, command.disable):
            self._check_range(message, value, code)
        return SystemCommand(
            message=message.name,
            value=value.name,
            enable=command.enable,
            disable=command.disable,
            count=self._optional_signal(message, command.count),
            modulus=self._modulus(message, command.count),
            checksum=self._checksum(message, command.checksum),
        )

    def _report(self, part: str, report: ReportConfig) -> ReportSpec:
        message = self._message(report.message)
        return ReportSpec(
            part=part,
            timeout_ns=report.timeout_ms * NS_PER_MS,
            values={value: self._signal(message, signal).name for value, signal in report.values.items()},
            no_value={  # the lowest value of each signed signal means "not known"
                value: -(1 << signal.bits - 1) * signal.scale + signal.offset
                for value, name in report.values.items()
                if (signal := self._signal(message, name)).is_signed
            },
            override=self._conditions(message, report.override),
            trip=self._conditions(message, report.trip),
            command_error=self._conditions(message, report.command_error),
            fault=self._conditions(message, report.fault),
            needs={
                self._signal(message, signal).name: frozenset(self._select_set(codes, f"{part}.needs.{signal}"))
                for signal, codes in report.needs.items()
            },
            reasons=tuple(self._signal(message, signal).name for signal in report.reasons),
            count=self._optional_signal(message, report.count),
            checksum=self._checksum(message, report.checksum),
        )

    def _watchdog(self) -> OwnBrake | None:
        watchdog = self.config.watchdog
        if not watchdog.signal:
            return None
        message = self._message(self.config.reports.brake.message)
        return OwnBrake(message.name, self._signal(message, watchdog.signal).name, watchdog.above)

    def _conditions(self, message: MessageFacts, conditions: Mapping[str, str]) -> tuple[SignalCondition, ...]:
        parsed = []
        for key, text in conditions.items():
            name, equals, number = key.partition("=")
            if equals and not number.isdecimal():
                raise UserError(f"{self.name}: {key!r} of {message.name} is invalid: write SIGNAL or SIGNAL=number")
            parsed.append(SignalCondition(self._signal(message, name).name, int(number) if equals else None, text))
        return tuple(parsed)

    def _check_complete(self, reports: Mapping[str, ReportSpec]) -> None:
        """Raise `UserError` if a reported value that driving requires is missing."""
        reported = {(report.part, value) for report in reports.values() for value in report.values}
        required = [*((axis, "enabled") for axis in AXES), ("steering", "angle"), ("gear", "gear")]
        for part, value in required:
            if (part, value) not in reported:
                raise UserError(f"{self.name}: reports.{part}.values has no {value}: name its signal")
        if not any(value == "speed" for _, value in reported):
            raise UserError(f"{self.name}: no report has a speed: name its signal in reports.speed.values")

    # Look-ups in the DBC.

    def _message(self, name: str | dict[CommandSet, str]) -> MessageFacts:
        selected = self._select_set(name, "a message")
        if selected not in self.codec.messages:
            raise UserError(
                f"{self.name}: its DBC has no message {selected!r}: change the profile, or name another DBC"
            )
        return self.codec.messages[selected]

    def _select_set(self, value: Choice | dict[CommandSet, Choice], where: str) -> Choice:
        """Return the value for the profile's command set."""
        if not isinstance(value, dict):
            return value
        command_set = self.config.commands
        if command_set is None or command_set not in value:
            raise UserError(f"{self.name}: {where} is for {_join_or(value)}: select one in commands")
        return value[command_set]

    def _signal(self, message: MessageFacts, name: str) -> SignalFacts:
        if name not in message.signals:
            raise UserError(
                f"{self.name}: {message.name} of its DBC has no signal {name!r}: change the profile, or name another"
            )
        self.used_signals[f"{message.name}.{name}"] = message.signals[name]
        return message.signals[name]

    def _optional_signal(self, message: MessageFacts, name: str) -> str:
        return self._signal(message, name).name if name else ""

    def _modulus(self, message: MessageFacts, name: str) -> int:
        return 1 << self._signal(message, name).bits if name else 1

    def _checksum(self, message: MessageFacts, name: str) -> str:
        """Return the name of a checksum's signal; raise `UserError` unless the signal is the last byte."""
        if name:
            signal = self._signal(message, name)
            if (signal.bits, signal.start // 8) != (8, message.length - 1):
                raise UserError(
                    f"{self.name}: {name} of {message.name} is not its last byte, as a checksum must be here"
                )
        return name

    def _signal_factor(self, signal: SignalFacts, message: MessageFacts, units: Mapping[str, float]) -> float:
        """Return the factor that `units` has for the unit of a signal."""
        if signal.unit not in units:
            raise UserError(
                f"{self.name}: {signal.name} of {message.name} is in {signal.unit!r}: name a signal in "
                f"{_join_or(repr(unit) for unit in units)}"
            )
        return units[signal.unit]

    def _reported_factor(self, reports: Mapping[str, ReportSpec], value: str, units: Mapping[str, float]) -> float:
        """Return the factor that `units` has for the unit of a reported value."""
        name, report = next((name, report) for name, report in reports.items() if value in report.values)
        message = self.codec.messages[name]
        return self._signal_factor(message.signals[report.values[value]], message, units)

    def _speed_units(self, reports: Mapping[str, ReportSpec]) -> dict[str, float]:
        """Return, for each reported speed, the signal value that means 1 m/s; for wheels, `wheel_radius_m` converts."""
        reported = {value for report in reports.values() for value in report.values}
        radius_m = self.config.vehicle.wheel_radius_m
        return {
            speed: self._reported_factor(reports, speed, IN_RADIANS_PER_SECOND) / radius_m
            if speed in WHEEL_SPEEDS
            else self._reported_factor(reports, speed, IN_METRES_PER_SECOND)
            for speed in SPEEDS
            if speed in reported
        }

    def _check_speed_steps(self, reports: Mapping[str, ReportSpec], speeds_per_mps: Mapping[str, float]) -> None:
        """Raise `UserError` for a speed whose step is too large for the checks of `speed_monitor.py`."""
        for speed, per_mps in speeds_per_mps.items():
            name, report = next((name, report) for name, report in reports.items() if speed in report.values)
            signal = self.codec.messages[name].signals[report.values[speed]]
            step_mps = 0.0 if signal.is_float else abs(signal.scale) / per_mps
            largest_mps = CONSTANT_WITHIN_MPS if speed == "speed" else STATIONARY_BELOW_MPS
            if step_mps > largest_mps:
                raise UserError(
                    f"{self.name}: {signal.name} of {name} has steps of {step_mps:.3g} m/s, which is too coarse to "
                    f"check the speed: name a signal with steps of at most {largest_mps:g} m/s as {speed}"
                )

    def _check_range(self, message: MessageFacts, signal: SignalFacts, value: float) -> None:
        tolerance = abs(signal.scale) / 2
        if not signal.minimum - tolerance <= value <= signal.maximum + tolerance:
            raise UserError(
                f"{self.name}: {value:g} is out of the range of {signal.name} of {message.name}, "
                f"{signal.minimum:g} to {signal.maximum:g}: change the limit or the code in the profile"
            )


def _join_or(alternatives: Iterable[str]) -> str:
    return " or ".join(alternatives)


def find_dbw(target: str) -> DbwConfig:
    """Return the section `vehicle.dbw` of the server's config `target`, or a default section if `target` is a profile.

    Raises `UserError` for a config whose vehicle is not of kind `dbw`.
    """
    path = Path(target)
    if path.suffix not in {".yaml", ".yml"}:
        return DbwConfig(profile=target)
    data = read_yaml(path)
    if "kit" in data:  # the file is a profile
        return DbwConfig(profile=target)
    vehicle = data.get("vehicle")
    section = vehicle.get("dbw") if isinstance(vehicle, dict) and vehicle.get("kind") == "dbw" else None
    if not isinstance(section, dict):
        raise UserError(f"{path} has no vehicle of kind dbw with vehicle.dbw: name another config or a profile")
    return parse_config(DbwConfig, section, f"{path}: vehicle.dbw")
