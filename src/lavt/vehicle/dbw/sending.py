"""Frames for the kit: limits, encoding, counters and checksums. No code changes a command after these limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from typing import Literal

from msgspec import Struct

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.profile import AXES, TICK_LIMIT_NS, Axis, AxisCommand, ByWireLimits, Gear, Profile, SystemCommand

GEAR_PERIOD_NS = 100 * NS_PER_MS
"""Our choice: period at which a gear is requested until the kit reports it."""


class KitCommands(Struct, frozen=True):
    """Commands to the kit other than the actuation."""

    enabled: frozenset[Axis]
    """Axes to enable; all other axes are disabled."""
    is_clearing: bool = False
    """Whether overrides are cleared."""
    gear: Gear | None = None
    """The requested gear; None if no gear is requested."""
    system: Literal["", "enable", "disable"] = ""
    """The request to the kit as a whole; empty if there is none."""


class DriveCommand(Struct, frozen=True):
    """A requested actuation: the steering wheel's angle, with its sign on the bus, and pedals as fractions."""

    wheel_deg: float
    throttle: float
    brake: float


def apply_limits(limits: ByWireLimits, requested: DriveCommand, before: DriveCommand, passed_ns: int) -> DriveCommand:
    """Limit `requested`, which is sent `passed_ns` after the command `before`. With a brake the throttle becomes 0.

    The limit of the angle has priority over the limit of its rate: if the driver has turned the wheel beyond the limit
    of the angle, the next command has the limit, whatever the rate.
    """
    passed_s = min(passed_ns, TICK_LIMIT_NS) / NS_PER_S
    turn_deg = limits.steering_wheel_rate_degps * passed_s
    wheel_deg = _clamp(requested.wheel_deg, before.wheel_deg - turn_deg, before.wheel_deg + turn_deg)
    throttle = 0.0 if requested.brake > 0 else requested.throttle
    return DriveCommand(
        _clamp(wheel_deg, -limits.steering_wheel_deg, limits.steering_wheel_deg),
        _clamp(throttle, 0.0, min(limits.throttle, before.throttle + limits.throttle_rate_per_s * passed_s)),
        _clamp(requested.brake, 0.0, min(limits.brake, before.brake + limits.brake_rate_per_s * passed_s)),
    )


def _choose(axes: AbstractSet[Axis], chosen: DriveCommand, other: DriveCommand) -> DriveCommand:
    """Return a command with the values of `chosen` for `axes`, and the values of `other` for the remaining axes."""
    return DriveCommand(
        (chosen if "steering" in axes else other).wheel_deg,
        (chosen if "throttle" in axes else other).throttle,
        (chosen if "brake" in axes else other).brake,
    )


def _clamp(number: float, lowest: float, highest: float) -> float:
    return min(max(number, lowest), highest)


class FrameSender:
    """An encoder for sets of frames."""

    def __init__(self, profile: Profile, start_ns: int) -> None:
        self._profile = profile
        self.last_command = DriveCommand(0.0, 0.0, 0.0)
        """The drive command of the last set; for a disabled axis, the reported angle or a released pedal."""
        self.last_set_ns = start_ns
        """Time of the last set; before the first set, the time of the start."""
        self.counts: Counter[str] = Counter()
        """`sets`, and how often each limit took effect: `limited_wheel_deg`, `limited_throttle`, ..."""
        self._frame_counts: Counter[str] = Counter()
        """Number of frames of each message, from which the counters in the frames follow."""
        self._gear_ns: int | None = None
        """Time of the last request for a gear; None: no gear is requested."""
        self._before: tuple[DriveCommand, int, int | None] = self.last_command, start_ns, None
        """`last_command`, `last_set_ns` and `_gear_ns` before the last set."""
        self._messages = {(facts.identifier, facts.is_extended): facts for facts in profile.codec.messages.values()}

    def frames(self, commands: KitCommands, requested: DriveCommand, wheel_deg: float, now_ns: int) -> list[CanFrame]:
        """Return a set of frames. The first command to enabled steering starts from the reported angle `wheel_deg`."""
        profile, passed_ns = self._profile, now_ns - self.last_set_ns
        self._before = self.last_command, self.last_set_ns, self._gear_ns
        self.last_set_ns = now_ns
        self.counts["sets"] += 1
        if commands.is_clearing:
            self.last_command = DriveCommand(wheel_deg, 0.0, 0.0)
            return self._clearing_frames()
        allowed = apply_limits(profile.limits, requested, self.last_command, passed_ns)
        self._count_limits(requested, allowed, commands.enabled)
        self.last_command = _choose(commands.enabled, allowed, DriveCommand(wheel_deg, 0.0, 0.0))
        values = {"steering": allowed.wheel_deg, "brake": allowed.brake, "throttle": allowed.throttle}
        frames = [self.axis_frame(axis, values[axis], is_enabled=axis in commands.enabled) for axis in AXES]
        if commands.system and profile.system is not None:
            frames.append(self._system_frame(profile.system, commands.system))
        if commands.gear is None:
            self._gear_ns = None
        elif self._gear_ns is None or now_ns - self._gear_ns >= GEAR_PERIOD_NS:
            self._gear_ns = now_ns
            frames.append(self.gear_frame(commands.gear))
        return frames

    def take_back(self, dropped: Sequence[CanFrame]) -> None:
        """Take back `dropped`, the last frames of the last set, which were not written.

        Their counter values are used again, because a gap in a counter would disengage the kit.
        """
        earlier_command, earlier_set_ns, self._gear_ns = self._before
        axes = set(AXES)
        for frame in dropped:
            facts = self._messages[frame.identifier, frame.is_extended]
            axes -= {axis for axis in AXES if self._profile.axes[axis].message == facts.name}
            if len(frame.data) == facts.length:  # shorter frames have no counter
                self._frame_counts[facts.name] -= 1
        self.last_command = _choose(axes, self.last_command, earlier_command)
        if not axes:
            self.last_set_ns = earlier_set_ns

    def axis_frame(self, axis: Axis, number: float, *, is_enabled: bool) -> CanFrame:
        """Return the command to an axis; `number` is in degrees of the steering wheel, or the fraction of a pedal."""
        command = self._profile.axes[axis]
        values = {command.value: number * command.per_unit if is_enabled else 0.0, command.enable: int(is_enabled)}
        return self._frame(
            command.message, {**command.constants, **values, **self._axis_counter(command)}, command.checksum
        )

    def gear_frame(self, gear: Gear) -> CanFrame:
        """Return the command for a gear."""
        command = self._profile.gear
        return self._frame(command.message, {command.value: command.codes[gear]}, command.checksum)

    def _clearing_frames(self) -> list[CanFrame]:
        """Return the frames that clear overrides; they have the length that the kit requires."""
        profile, frames = self._profile, []
        for axis in AXES:
            command = profile.axes[axis]
            if profile.clearing_bytes is None:
                values = {command.clear: 1, **self._axis_counter(command)}
                frames.append(self._frame(command.message, values, command.checksum))
            else:
                frames.append(self._frame(command.message, {command.clear: 1}, "", profile.clearing_bytes))
        if profile.gear.clear:
            frames.append(self._frame(profile.gear.message, {profile.gear.clear: 1}, profile.gear.checksum))
        return frames

    def _system_frame(self, command: SystemCommand, request: Literal["enable", "disable"]) -> CanFrame:
        values = {command.value: command.enable if request == "enable" else command.disable}
        counter = self._next_counter(command.message, command.count, command.modulus)
        return self._frame(command.message, {**values, **counter}, command.checksum)

    def _axis_counter(self, command: AxisCommand) -> dict[str, int]:
        return self._next_counter(command.message, command.count, command.modulus)

    def _next_counter(self, message: str, count: str, modulus: int) -> dict[str, int]:
        if not count:
            return {}
        self._frame_counts[message] += 1
        return {count: self._frame_counts[message] % modulus}

    def _frame(self, message: str, values: Mapping[str, float], checksum: str, length: int | None = None) -> CanFrame:
        codec = self._profile.codec
        facts, data = codec.messages[message], codec.encode(message, values, length=length)
        if checksum:  # it is the last byte, which the check of the profile ensures
            data = data[:-1] + bytes([frame_crc8(facts.identifier, data[:-1], extended=facts.is_extended)])
        return CanFrame(facts.identifier, data, facts.is_extended)

    def _count_limits(self, requested: DriveCommand, allowed: DriveCommand, enabled: frozenset[Axis]) -> None:
        changed: dict[str, tuple[Axis, bool]] = {
            "limited_wheel_deg": ("steering", requested.wheel_deg != allowed.wheel_deg),
            "limited_throttle": ("throttle", requested.throttle != allowed.throttle),
            "limited_brake": ("brake", requested.brake != allowed.brake),
        }
        self.counts.update(name for name, (axis, is_changed) in changed.items() if is_changed and axis in enabled)
