"""What happens to a software car, in words."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, Final

from lavt.value import value
from lavt.vehicle.software_car.state import AXES, GearRejection, KitState, ReleaseReason


@value
class KitEvent:
    """Something that happened at a time of the machine's monotonic clock."""

    mono_ns: int
    kind: str
    """One of `TOLD`, `event` (of the simulator), `bus`, or what became of a word: `done`, `rejected`, `help`."""
    text: str


REASONS: Final = {
    ReleaseReason.NONE: "nothing",
    ReleaseReason.TIMEOUT: "no command in time",
    ReleaseReason.CRC: "a wrong checksum",
    ReleaseReason.COUNTER: "a wrong counter",
    ReleaseReason.OVERRIDE: "the driver has taken over",
    ReleaseReason.SEAT_BELT: "the seat belt is open",
    ReleaseReason.DOOR: "a door is open",
    ReleaseReason.LOCKOUT_SPEED: "locked out by the speed",
    ReleaseReason.LOCKOUT_ACCELERATION: "locked out by the acceleration",
    ReleaseReason.LOCKOUT_REVERSE: "locked out by the reverse gear",
    ReleaseReason.REQUESTED: "it was asked to",
    ReleaseReason.DISABLED: "a command without its enable bit, or none",
    ReleaseReason.FAULT: "a fault",
    ReleaseReason.REMOTE: "the remote's switch",
}
REJECTS: Final = {
    GearRejection.IN_PROGRESS: "it is shifting",
    GearRejection.OVERRIDE: "the driver has moved the shifter",
    GearRejection.VEHICLE: "the brake is not pressed, or the car moves",
    GearRejection.UNSUPPORTED: "this car has no such gear",
    GearRejection.FAULT: "a fault",
}


def enabled(state: KitState) -> tuple[str, ...]:
    """List the axes that obey."""
    return tuple(axis for axis in AXES if state.actuators[axis].is_enabled)


def overridden(state: KitState) -> tuple[str, ...]:
    """List what the driver has taken over."""
    axes = [axis for axis in AXES if state.actuators[axis].is_overridden]
    return (*axes, "gear") if state.is_gear_overridden else tuple(axes)


def _of_enabled(state: KitState, before: Any) -> str:
    axes = enabled(state)
    if set(axes) > set(before):
        return f"obeys: {', '.join(axes)}"
    return f"lets go: {REASONS[state.disengaged]}" + (f"; obeys still: {', '.join(axes)}" if axes else "")


def _of_overridden(state: KitState, _: Any) -> str:
    return f"taken over by the driver: {', '.join(overridden(state)) or 'nothing any more'}"


def _of_gear(state: KitState, _: Any) -> str:
    return f"gear {state.gear.name}"


def _of_rejected(state: KitState, _: Any) -> str:
    why = REJECTS.get(state.gear_reject)
    return f"gear {state.gear_order} refused: {why}" if why else "no gear refused any more"


def _of_watchdog(state: KitState, _: Any) -> str:
    if state.watchdog == ReleaseReason.NONE:
        return "watchdog cleared"
    why = f"{REASONS[state.watchdog]} ({state.watchdog_axis})"
    return (
        f"watchdog brakes: {why}" if state.watchdog_brakes else f"watchdog brakes no more, and waits for CLEAR: {why}"
    )


def _of_readiness(state: KitState, _: Any) -> str:
    return f"not ready: {REASONS[state.not_ready]}" if state.not_ready != ReleaseReason.NONE else "ready"


TOLD: Final[dict[str, tuple[Callable[[KitState], Hashable], Callable[[KitState, Any], str]]]] = {
    "enabled": (enabled, _of_enabled),
    "overridden": (overridden, _of_overridden),
    "gear": (lambda state: state.gear, _of_gear),
    "rejected": (lambda state: (state.gear_reject, state.gear_order if state.gear_reject else 0), _of_rejected),
    "watchdog": (lambda state: (state.watchdog, state.watchdog_brakes), _of_watchdog),
    "readiness": (lambda state: state.not_ready, _of_readiness),
}
"""By kind: what is looked at, and the words for it once it has changed, from the state and what was seen before."""


class StateObserver:
    """Looks at a kit again and again and tells what has changed."""

    def __init__(self, state: KitState) -> None:
        self._seen = [look(state) for look, _ in TOLD.values()]

    def look(self, state: KitState, now_ns: int) -> list[KitEvent]:
        """Tell what has changed since the last look."""
        seen = [look(state) for look, _ in TOLD.values()]
        if seen == self._seen:
            return []
        before, self._seen = self._seen, seen
        told = zip(TOLD.items(), before, seen, strict=True)
        return [KitEvent(now_ns, kind, words(state, was)) for (kind, (_, words)), was, now in told if was != now]
