"""The events of a software car, and their texts."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, Final

from msgspec import Struct

from lavt.vehicle.software_car.state import AXES, GearRejection, KitState, ReleaseReason


class KitEvent(Struct, frozen=True):
    """An event with its time on the machine's monotonic clock."""

    mono_ns: int
    kind: str
    """A key of `OBSERVED`; `event` for an event of the simulator; `bus` for a loss or return of the bus; or the result
    of a console command: `done`, `rejected` or `help`."""
    text: str


RELEASE_REASONS: Final = {
    ReleaseReason.NONE: "nothing",
    ReleaseReason.TIMEOUT: "no command in time",
    ReleaseReason.CRC: "a wrong checksum",
    ReleaseReason.COUNTER: "a wrong counter",
    ReleaseReason.OVERRIDE: "override by the driver",
    ReleaseReason.SEAT_BELT: "the seat belt is open",
    ReleaseReason.DOOR: "a door is open",
    ReleaseReason.LOCKOUT_SPEED: "lockout by speed",
    ReleaseReason.LOCKOUT_ACCELERATION: "lockout by acceleration",
    ReleaseReason.LOCKOUT_REVERSE: "lockout by the reverse gear",
    ReleaseReason.REQUESTED: "requested",
    ReleaseReason.DISABLED: "no command with the enable bit",
    ReleaseReason.FAULT: "a fault",
    ReleaseReason.REMOTE: "the remote's switch",
}
GEAR_REJECTIONS: Final = {
    GearRejection.IN_PROGRESS: "shift in progress",
    GearRejection.OVERRIDE: "override by the driver",
    GearRejection.BRAKE_OR_MOTION: "the brake is not pressed, or the car moves",
    GearRejection.UNSUPPORTED: "unsupported gear",
    GearRejection.FAULT: "a fault",
}


def enabled_axes(state: KitState) -> tuple[str, ...]:
    """Return the enabled axes."""
    return tuple(axis for axis in AXES if state.actuators[axis].is_enabled)


def overridden_parts(state: KitState) -> tuple[str, ...]:
    """Return the axes that the driver overrides, and `gear` if the driver overrides the gear."""
    axes = [axis for axis in AXES if state.actuators[axis].is_overridden]
    return (*axes, "gear") if state.is_gear_overridden else tuple(axes)


def _enabled_text(state: KitState, previous_axes: Any) -> str:
    axes = enabled_axes(state)
    if set(axes) > set(previous_axes):
        return f"enabled: {', '.join(axes)}"
    return f"released: {RELEASE_REASONS[state.disengage_reason]}" + (f"; remaining: {', '.join(axes)}" if axes else "")


def _overridden_text(state: KitState, _: Any) -> str:
    parts = overridden_parts(state)
    return f"override by the driver: {', '.join(parts)}" if parts else "override cleared"


def _gear_text(state: KitState, _: Any) -> str:
    return f"gear {state.gear.name}"


def _rejection_text(state: KitState, _: Any) -> str:
    reason = GEAR_REJECTIONS.get(state.gear_reject)
    return f"gear {state.gear_order} rejected: {reason}" if reason else "gear rejection cleared"


def _watchdog_text(state: KitState, _: Any) -> str:
    if state.watchdog_reason == ReleaseReason.NONE:
        return "watchdog cleared"
    reason = f"{RELEASE_REASONS[state.watchdog_reason]} ({state.watchdog_axis})"
    if state.watchdog_brakes:
        return f"watchdog brakes: {reason}"
    return f"watchdog stopped braking and waits for CLEAR: {reason}"


def _readiness_text(state: KitState, _: Any) -> str:
    reason = state.not_ready_reason
    return f"not ready: {RELEASE_REASONS[reason]}" if reason != ReleaseReason.NONE else "ready"


OBSERVED: Final[dict[str, tuple[Callable[[KitState], Hashable], Callable[[KitState, Any], str]]]] = {
    "enabled": (enabled_axes, _enabled_text),
    "overridden": (overridden_parts, _overridden_text),
    "gear": (lambda state: state.gear, _gear_text),
    "rejected": (lambda state: (state.gear_reject, state.gear_order if state.gear_reject else 0), _rejection_text),
    "watchdog": (lambda state: (state.watchdog_reason, state.watchdog_brakes), _watchdog_text),
    "readiness": (lambda state: state.not_ready_reason, _readiness_text),
}
"""For each kind of event, two functions. The first one returns the observed value of a state. The second one returns
the text for a change of this value, given the new state and the previous value."""


class StateObserver:
    """An observer that compares successive states of a kit and makes events of the changes."""

    def __init__(self, state: KitState) -> None:
        self._values = [value_of(state) for value_of, _ in OBSERVED.values()]

    def observe(self, state: KitState, now_ns: int) -> list[KitEvent]:
        """Return an event for each change since the last call."""
        values = [value_of(state) for value_of, _ in OBSERVED.values()]
        if values == self._values:
            return []
        before, self._values = self._values, values
        changes = zip(OBSERVED.items(), before, values, strict=True)
        return [KitEvent(now_ns, kind, text_of(state, old)) for (kind, (_, text_of)), old, new in changes if old != new]
