"""What leaves for the kit: limits, then bytes with counters and checksums. The limits are the last before the bus."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Literal

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.value import value
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.profile import AXES, TICK_LIMIT_NS, Axis, AxisCommand, ByWireLimits, Gear, Profile, SystemCommand

GEAR_PERIOD_NS = 100 * NS_PER_MS
"""A gear is asked for again so often until it is reported (ours); a kit may be at it still."""


@value
class KitCommands:
    """What is said to the kit, besides how it is to drive."""

    enabled: frozenset[Axis]
    """Axes that are to obey; the others are told not to."""
    is_clearing: bool = False
    gear: Gear | None = None
    """The gear that is asked for."""
    system: Literal["", "enable", "disable"] = ""


@value
class DriveCommand:
    """How the car is to drive: the steering wheel's angle on the bus, and pedals as fractions."""

    wheel_deg: float
    throttle: float
    brake: float


def limited(limits: ByWireLimits, requested: DriveCommand, before: DriveCommand, passed_ns: int) -> DriveCommand:
    """Give what of `requested` is allowed `passed_ns` after `before` was sent; with the brake there is no throttle."""
    passed_s = min(passed_ns, TICK_LIMIT_NS) / NS_PER_S
    turn_deg = limits.steering_wheel_rate_degps * passed_s
    wheel_deg = _within(requested.wheel_deg, -limits.steering_wheel_deg, limits.steering_wheel_deg)
    throttle = 0.0 if requested.brake > 0 else requested.throttle
    return DriveCommand(
        _within(wheel_deg, before.wheel_deg - turn_deg, before.wheel_deg + turn_deg),
        _within(throttle, 0.0, min(limits.throttle, before.throttle + limits.throttle_rate_per_s * passed_s)),
        _within(requested.brake, 0.0, min(limits.brake, before.brake + limits.brake_rate_per_s * passed_s)),
    )


def _within(number: float, least: float, most: float) -> float:
    return min(max(number, least), most)


class FrameSender:
    """Makes the frames of each set, and knows what the last one said."""

    def __init__(self, profile: Profile, start_ns: int) -> None:
        self._profile = profile
        self.sent = DriveCommand(0.0, 0.0, 0.0)
        """What the last set asked for, where its axes were enabled."""
        self.sent_ns = start_ns
        self.counts: Counter[str] = Counter()
        """`sets`, and how often each limit changed something: `limited_wheel_deg`, `limited_throttle`, .."""
        self._numbers: Counter[str] = Counter()
        """How many frames of each message were counted."""
        self._gear_ns: int | None = None

    def frames(self, plan: KitCommands, requested: DriveCommand, wheel_deg: float, now_ns: int) -> list[CanFrame]:
        """Make a set of frames; `wheel_deg` is where the steering wheel is, from which it turns once it is enabled."""
        profile, passed_ns = self._profile, now_ns - self.sent_ns
        self.sent_ns = now_ns
        self.counts["sets"] += 1
        if plan.is_clearing:
            self.sent = DriveCommand(wheel_deg, 0.0, 0.0)
            return self._clearing()
        allowed = limited(profile.limits, requested, self.sent, passed_ns)
        self._count_limits(requested, allowed, plan.enabled)
        self.sent = DriveCommand(
            allowed.wheel_deg if "steering" in plan.enabled else wheel_deg,
            allowed.throttle if "throttle" in plan.enabled else 0.0,
            allowed.brake if "brake" in plan.enabled else 0.0,
        )
        values = {"steering": allowed.wheel_deg, "brake": allowed.brake, "throttle": allowed.throttle}
        frames = [self.axis_frame(axis, values[axis], is_enabled=axis in plan.enabled) for axis in AXES]
        if plan.system and profile.system is not None:
            frames.append(self._system_frame(profile.system, plan.system))
        if plan.gear is None:
            self._gear_ns = None
        elif self._gear_ns is None or now_ns - self._gear_ns >= GEAR_PERIOD_NS:
            self._gear_ns = now_ns
            frames.append(self.gear_frame(plan.gear))
        return frames

    def axis_frame(self, axis: Axis, number: float, *, is_enabled: bool) -> CanFrame:
        """Make an axis's command: degrees of the steering wheel, or the fraction of a pedal."""
        command = self._profile.axes[axis]
        said = {command.value: number * command.per_unit if is_enabled else 0.0, command.enable: int(is_enabled)}
        return self._frame(command.message, {**command.constants, **said, **self._next(command)}, command.checksum)

    def gear_frame(self, gear: Gear) -> CanFrame:
        """Make the command for a gear."""
        command = self._profile.gear
        return self._frame(command.message, {command.value: command.numbers[gear]}, command.checksum)

    def _clearing(self) -> list[CanFrame]:
        """Make what takes back overrides: as short as the kit wants it."""
        profile, frames = self._profile, []
        for axis in AXES:
            command = profile.axes[axis]
            if profile.clearing_bytes is None:
                said = {command.clear: 1, **self._next(command)}
                frames.append(self._frame(command.message, said, command.checksum))
            else:
                frames.append(self._frame(command.message, {command.clear: 1}, "", profile.clearing_bytes))
        if profile.gear.clear:
            frames.append(self._frame(profile.gear.message, {profile.gear.clear: 1}, profile.gear.checksum))
        return frames

    def _system_frame(self, command: SystemCommand, request: Literal["enable", "disable"]) -> CanFrame:
        said = {command.value: command.enable if request == "enable" else command.disable}
        counted = self._counted(command.message, command.count, command.modulus)
        return self._frame(command.message, {**said, **counted}, command.checksum)

    def _next(self, command: AxisCommand) -> dict[str, int]:
        return self._counted(command.message, command.count, command.modulus)

    def _counted(self, message: str, count: str, modulus: int) -> dict[str, int]:
        if not count:
            return {}
        self._numbers[message] += 1
        return {count: self._numbers[message] % modulus}

    def _frame(self, message: str, said: Mapping[str, float], checksum: str, length: int | None = None) -> CanFrame:
        codec = self._profile.codec
        facts, data = codec.messages[message], codec.encode(message, said, length=length)
        if checksum:  # the last byte, as the profile was checked
            data = data[:-1] + bytes([frame_crc8(facts.identifier, data[:-1], extended=facts.is_extended)])
        return CanFrame(facts.identifier, data, facts.is_extended)

    def _count_limits(self, requested: DriveCommand, allowed: DriveCommand, enabled: frozenset[Axis]) -> None:
        changed: dict[str, tuple[Axis, bool]] = {
            "limited_wheel_deg": ("steering", requested.wheel_deg != allowed.wheel_deg),
            "limited_throttle": ("throttle", requested.throttle != allowed.throttle),
            "limited_brake": ("brake", requested.brake != allowed.brake),
        }
        self.counts.update(name for name, (axis, is_changed) in changed.items() if is_changed and axis in enabled)
