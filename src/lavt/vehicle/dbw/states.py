"""The states of the by-wire adapter as a table, from which docs/by_wire.md is drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.value import value
from lavt.vehicle.dbw.profile import AXES, COMMAND_TIMEOUT_NS, Axis, Gear

State = Literal["idle", "clearing", "enabling", "engaged", "parking", "overridden", "lost"]

STATIONARY_BELOW_MPS: Final = 0.1
"""Ours: below it the car stands."""
ENABLING_LIMIT_NS: Final = 3 * NS_PER_S
"""Ours: what a kit does not do in so long it does not do."""
PAUSE_NS: Final = 120 * NS_PER_MS
"""Clearing takes at least so long, in which the system is not asked to enable: a kit that has let go does not hear it
before it was quiet for 100 ms. And so long the kit is told to let go before it is taken to have."""

SAID: Final[dict[State, str]] = {
    "idle": "nothing: the adapter is silent",
    "clearing": "CLEAR, every 50 ms; no axis enabled",
    "enabling": "all axes enabled, throttle 0, the holding brake; DRIVE, once all are reported enabled",
    "engaged": "what is asked",
    "parking": "as asked, but throttle 0, at least the holding brake; PARK after 300 ms of standing; then all off",
    "overridden": "no axis enabled",
    "lost": "steering and brake as asked, throttle 0, on the axes that are still enabled",
}
"""What is sent in each state."""


@value
class Situation:
    """What the table looks at."""

    wanted: bool
    """Somebody wants to drive."""
    is_stationary: bool
    inhibit_reason: str
    """Why driving cannot begin; empty: it can."""
    unheard: str
    """Bus gone, or reports missing."""
    silent_ns: int
    """How long ago the last set of frames left."""
    faults: str
    overrides: str
    trips: str
    lapses: str
    reasons: str
    """What the kit gives as reasons."""
    enabled: frozenset[Axis]
    gear: Gear | None
    since_ns: int
    """How long the state has lasted."""


@value
class TransitionRow:
    """From some states, in a case, to a state; the first row that fits counts.

    `case` gives what happened in words, or whether it did.
    """

    sources: tuple[State, ...]
    words: str
    case: Callable[[Situation], str | bool]
    target: State


def _release(now: Situation) -> str:
    """Tell which axes do not obey any more."""
    axes = [axis for axis in AXES if axis not in now.enabled]
    return f"the kit has let go of {' and '.join(axes)}{_reason(now)}" if axes else ""


def _out_of_gear(now: Situation) -> str:
    return "" if now.gear == "drive" else f"the gear is {now.gear or 'unknown'} instead of drive"


def _did_not(what: str) -> Callable[[Situation], str]:
    def case(now: Situation) -> str:
        if now.since_ns < ENABLING_LIMIT_NS:
            return ""
        left = [now.overrides, now.trips, now.lapses]
        if what == "enable":
            left += [f"not enabled: {axis}" for axis in AXES if axis not in now.enabled]
            left += [_out_of_gear(now)]
        said = "; ".join(filter(None, [*left, now.reasons]))
        return f"the kit did not {what} in {ENABLING_LIMIT_NS // NS_PER_S} s: {said}"

    return case


def _reason(now: Situation) -> str:
    said = "; ".join(filter(None, [now.trips, now.lapses, now.reasons]))
    return f" ({said})" if said else ""


TABLE: Final[tuple[TransitionRow, ...]] = (
    TransitionRow(
        ("enabling", "engaged", "parking", "lost"),
        "the driver in the car has taken over",
        lambda now: now.overrides and f"the driver has taken over: {now.overrides}",
        "overridden",
    ),
    TransitionRow(
        ("clearing", "enabling", "engaged", "parking"),
        "the bus is gone, or a report is missing",
        lambda now: now.unheard,
        "lost",
    ),
    TransitionRow(
        ("enabling", "engaged", "parking"),
        "no command has left for 100 ms",
        lambda now: now.silent_ns >= COMMAND_TIMEOUT_NS,
        "lost",
    ),
    TransitionRow(
        ("clearing", "enabling", "engaged"),
        "the kit reports a fault, or somebody else commands it",
        lambda now: now.faults,
        "lost",
    ),
    TransitionRow(
        ("enabling", "engaged"),
        "the kit's watchdog has tripped",
        lambda now: now.trips and now.trips + _reason(now),
        "lost",
    ),
    TransitionRow(("engaged",), "the kit has let go of an axis", _release, "lost"),
    TransitionRow(("engaged",), "the kit finds our commands late or wrong", lambda now: now.lapses, "lost"),
    TransitionRow(("engaged",), "the gear is not DRIVE", _out_of_gear, "lost"),
    TransitionRow(
        ("clearing", "enabling", "engaged"), "driving is not wanted any more", lambda now: not now.wanted, "parking"
    ),
    TransitionRow(
        ("idle",),
        "driving is wanted, the car stands, and nothing hinders it",
        lambda now: now.wanted and now.is_stationary and not now.inhibit_reason,
        "clearing",
    ),
    TransitionRow(
        ("clearing",),
        "no override and no trip is reported, at the earliest after 120 ms",
        lambda now: now.since_ns >= PAUSE_NS and not now.overrides and not now.trips,
        "enabling",
    ),
    TransitionRow(("clearing",), "it has taken 3 s", _did_not("clear"), "lost"),
    TransitionRow(
        ("enabling",),
        "all axes are reported enabled, and the gear is DRIVE",
        lambda now: len(now.enabled) == len(AXES) and now.gear == "drive",
        "engaged",
    ),
    TransitionRow(("enabling",), "it has taken 3 s", _did_not("enable"), "lost"),
    TransitionRow(
        ("parking",),
        "no axis is reported enabled, at the earliest after 120 ms",
        lambda now: now.since_ns >= PAUSE_NS and not now.enabled,
        "idle",
    ),
    TransitionRow(
        ("lost",),
        "driving is not wanted any more, reports come, and an axis is still enabled",
        lambda now: not now.wanted and not now.unheard and bool(now.enabled),
        "parking",
    ),
    TransitionRow(
        ("lost",),
        "driving is not wanted any more, reports come, and no axis is enabled",
        lambda now: not now.wanted and not now.unheard,
        "idle",
    ),
    TransitionRow(
        ("overridden",),
        "driving is not wanted any more, and the car stands",
        lambda now: not now.wanted and now.is_stationary and not now.unheard and not now.enabled,
        "idle",
    ),
)
"""What leads from state to state."""


def following(state: State, now: Situation) -> tuple[State, str]:
    """Give the state that follows, the same where no row fits, and why."""
    for row in TABLE:
        if state in row.sources and (why := row.case(now)):
            return row.target, why if isinstance(why, str) else row.words
    return state, ""
