"""The state machine of the by-wire adapter as a table, from which docs/by_wire.md is generated."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal

from msgspec import Struct
from msgspec.structs import replace

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.dbw.profile import AXES, COMMAND_TIMEOUT_NS, Axis, Gear

State = Literal["idle", "clearing", "enabling", "engaged", "parking", "overridden", "lost"]

STATIONARY_BELOW_MPS: Final = 0.1
"""Our choice: the car is stationary if it is slower than this."""
KIT_RESPONSE_LIMIT_NS: Final = 3 * NS_PER_S
"""Our choice: clearing fails if it takes longer than this, and so does enabling. Parking goes on, but is reported."""
PAUSE_NS: Final = 120 * NS_PER_MS
"""Shortest duration of `clearing` and `parking`, and of `enabling` if it is cancelled. In `clearing` no request to
enable is sent, because a kit that has disengaged ignores such requests until none came for 100 ms. In `parking` a kit
is surely disengaged only after it was commanded to disable for this long. In `enabling` a kit needs this long to report
which axes it has enabled."""

SENT_IN_STATE: Final[dict[State, str]] = {
    "idle": "nothing",
    "clearing": "CLEAR every 50 ms; no axis enabled",
    "enabling": "all axes enabled, throttle 0, at least the holding brake. When all axes are reported enabled and "
    "driving is still wanted: DRIVE",
    "engaged": "the requested actuation",
    "parking": "steering as requested, brake as requested but at least the holding brake, throttle 0. When the car has "
    "been stationary for 300 ms: PARK. When PARK is reported: no axis enabled. If before PARK the brake or, in "
    "generation 2, any axis is released: nothing",
    "overridden": "no axis enabled",
    "lost": "steering and brake as requested and throttle 0, on the axes that are still enabled. If the brake or, in "
    "generation 2, any axis is released: nothing",
}
"""Frames sent in each state."""


class Situation(Struct, frozen=True):
    """The inputs of the state machine. A text is empty if there is nothing to say."""

    wanted: bool
    """Whether driving is wanted."""
    is_stationary: bool
    inhibit_reason: str
    """Why driving cannot begin; empty if it can."""
    missing_reports: str
    """Reports that are missing, or why the bus is gone."""
    since_sent_ns: int
    """Time since the last set of frames was sent."""
    faults: str
    """Faults that the kit reports, an implausible speed, and another sender of commands."""
    overrides: str
    """What the driver overrides, as the kit reports it."""
    watchdog_trips: str
    """That the kit's watchdog has tripped, as the kit reports it."""
    command_errors: str
    """What the kit reports about late or invalid commands."""
    kit_reasons: str
    """Reasons that the kit reports for its behaviour."""
    enabled: frozenset[Axis]
    gear: Gear | None
    in_state_ns: int
    """Time in the current state."""
    expects_no_release: bool
    """Whether a release of all axes would be unexpected: an axis was enabled when `parking` began, and no command to
    disable it has been sent since then."""


class TransitionRow(Struct, frozen=True):
    """A row of the table of transitions. The first row whose condition is met applies."""

    sources: tuple[State, ...]
    """The states in which the row applies."""
    description: str
    condition: Callable[[Situation], str | bool]
    """Returns whether the condition is met, or why it is met (an empty text if it is not)."""
    target: State
    """The next state."""


def _released_axes(situation: Situation) -> str:
    """Return a text with the axes that are not enabled; empty if all are enabled."""
    axes = [axis for axis in AXES if axis not in situation.enabled]
    return f"the kit released {' and '.join(axes)}{_details(situation)}" if axes else ""


def _released_before_park(situation: Situation) -> str:
    return f"the kit released all axes before the car was parked{_details(situation)}"


def _out_of_gear(situation: Situation) -> str:
    return "" if situation.gear == "drive" else f"the gear is {situation.gear or 'unknown'} instead of drive"


def _timed_out(action: str) -> Callable[[Situation], str]:
    def condition(situation: Situation) -> str:
        if situation.in_state_ns < KIT_RESPONSE_LIMIT_NS:
            return ""
        causes = [situation.overrides, situation.watchdog_trips, situation.command_errors]
        if action == "enable":
            causes += [f"not enabled: {axis}" for axis in AXES if axis not in situation.enabled]
            causes += [_out_of_gear(situation)]
        text = "; ".join(filter(None, [*causes, situation.kit_reasons]))
        return f"the kit did not {action} within {KIT_RESPONSE_LIMIT_NS // NS_PER_S} s: {text}"

    return condition


def _details(situation: Situation) -> str:
    text = "; ".join(filter(None, [situation.watchdog_trips, situation.command_errors, situation.kit_reasons]))
    return f" ({text})" if text else ""


TABLE: Final[tuple[TransitionRow, ...]] = (
    TransitionRow(
        ("enabling", "engaged", "parking", "lost"),
        "override by the driver",
        lambda situation: situation.overrides and f"override by the driver: {situation.overrides}",
        "overridden",
    ),
    TransitionRow(
        ("clearing", "enabling", "engaged", "parking"),
        "the bus is gone, or a report is missing",
        lambda situation: situation.missing_reports,
        "lost",
    ),
    TransitionRow(
        ("enabling", "engaged"),
        "no command was sent for 100 ms",
        lambda situation: situation.since_sent_ns >= COMMAND_TIMEOUT_NS,
        "lost",
    ),
    TransitionRow(
        ("parking",),
        "no command was sent for 100 ms, and an axis is reported enabled",
        lambda situation: situation.since_sent_ns >= COMMAND_TIMEOUT_NS and bool(situation.enabled),
        "lost",
    ),
    TransitionRow(
        ("clearing", "enabling", "engaged"),
        "the kit reports a fault, or another sender commands it",
        lambda situation: situation.faults,
        "lost",
    ),
    TransitionRow(
        ("enabling", "engaged"),
        "the kit's watchdog has tripped",
        lambda situation: situation.watchdog_trips and situation.watchdog_trips + _details(situation),
        "lost",
    ),
    TransitionRow(("engaged",), "the kit released an axis", _released_axes, "lost"),
    TransitionRow(
        ("engaged",), "the kit reports late or invalid commands", lambda situation: situation.command_errors, "lost"
    ),
    TransitionRow(("engaged",), "the gear is not DRIVE", _out_of_gear, "lost"),
    TransitionRow(
        ("clearing", "engaged"), "driving is no longer wanted", lambda situation: not situation.wanted, "parking"
    ),
    TransitionRow(
        ("enabling",),
        "driving is no longer wanted, after at least 120 ms",
        lambda situation: not situation.wanted and situation.in_state_ns >= PAUSE_NS,
        "parking",
    ),
    TransitionRow(
        ("idle",),
        "driving is wanted, the car is stationary, and there is no inhibit reason",
        lambda situation: situation.wanted and situation.is_stationary and not situation.inhibit_reason,
        "clearing",
    ),
    TransitionRow(
        ("clearing",),
        "no override and no trip is reported, after at least 120 ms",
        lambda situation: situation.in_state_ns >= PAUSE_NS and not (situation.overrides or situation.watchdog_trips),
        "enabling",
    ),
    TransitionRow(("clearing",), "3 s have passed", _timed_out("clear"), "lost"),
    TransitionRow(
        ("enabling",),
        "all axes are reported enabled, and the gear is DRIVE",
        lambda situation: len(situation.enabled) == len(AXES) and situation.gear == "drive",
        "engaged",
    ),
    TransitionRow(("enabling",), "3 s have passed", _timed_out("enable"), "lost"),
    TransitionRow(
        ("parking",),
        "the kit released all axes before it was commanded to, after at least 120 ms",
        lambda situation: (
            _released_before_park(situation)
            if situation.expects_no_release and situation.in_state_ns >= PAUSE_NS and not situation.enabled
            else ""
        ),
        "lost",
    ),
    TransitionRow(
        ("parking",),
        "no axis is reported enabled, after at least 120 ms",
        lambda situation: situation.in_state_ns >= PAUSE_NS and not situation.enabled,
        "idle",
    ),
    TransitionRow(
        ("lost",),
        "driving is no longer wanted, no report is missing, the brake is still enabled, and a command was sent within "
        "100 ms",
        lambda situation: (
            not situation.wanted
            and not situation.missing_reports
            and "brake" in situation.enabled
            and situation.since_sent_ns < COMMAND_TIMEOUT_NS
        ),
        "parking",
    ),
    TransitionRow(
        ("lost",),
        "driving is no longer wanted, no report is missing, and no axis is enabled",
        lambda situation: not situation.wanted and not situation.missing_reports and not situation.enabled,
        "idle",
    ),
    TransitionRow(
        ("overridden",),
        "driving is no longer wanted, no report is missing, no axis is enabled, and the car is stationary",
        lambda situation: (
            not situation.wanted and situation.is_stationary and not situation.missing_reports and not situation.enabled
        ),
        "idle",
    ),
)
"""Transitions between the states."""


def next_state(state: State, situation: Situation) -> tuple[State, str]:
    """Return the next state and the reason; the same state and an empty reason if no row applies."""
    for row in TABLE:
        if state in row.sources and (reason := row.condition(situation)):
            return row.target, reason if isinstance(reason, str) else row.description
    return state, ""


def states_after(state: State, situation: Situation) -> list[tuple[State, str]]:
    """Return the states that follow `state` at this instant, in order, with their reasons; no state comes twice."""
    found: list[tuple[State, str]] = []
    visited = {state}
    while True:
        state, reason = next_state(state, situation)
        if state in visited:
            return found
        visited.add(state)
        found.append((state, reason))
        situation = replace(situation, in_state_ns=0)
