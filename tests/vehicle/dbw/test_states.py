"""The adapter's state table, row by row, without a car."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, combinations, product
from typing import Any, get_args

import pytest
from msgspec.structs import replace

from lavt.domain import NS_PER_MS
from lavt.vehicle.dbw import states
from lavt.vehicle.dbw.adapter import SEPARATOR
from lavt.vehicle.dbw.profile import AXES, Axis
from lavt.vehicle.dbw.states import TABLE, Situation, State, TransitionRow, next_state, states_after

ALL_AXES: frozenset[Axis] = frozenset(AXES)
NO_AXES: frozenset[Axis] = frozenset()
PAUSE_NS, LIMIT_NS, TIMEOUT_NS = 120 * NS_PER_MS, 3000 * NS_PER_MS, 100 * NS_PER_MS
GOOD = Situation(
    wanted=True,
    is_stationary=True,
    inhibit_reason="",
    missing_reports="",
    since_sent_ns=0,
    faults="",
    overrides="",
    watchdog_trips="",
    command_errors="",
    kit_reasons="",
    enabled=ALL_AXES,
    gear="drive",
    in_state_ns=0,
    expects_no_release=False,
)
STAYS: dict[State, Situation] = {
    "idle": replace(GOOD, wanted=False, enabled=NO_AXES, gear="park"),
    "clearing": replace(GOOD, enabled=NO_AXES, gear="park"),
    "enabling": replace(GOOD, enabled=NO_AXES, gear="park"),
    "engaged": GOOD,
    "parking": replace(GOOD, wanted=False),
    "overridden": replace(GOOD, enabled=NO_AXES),
    "lost": GOOD,
}
"""For each state a situation in which the state does not change."""


def target(state: State, **changes: Any) -> State:
    new_state, _ = next_state(state, replace(STAYS[state], **changes))
    return new_state


def reason(state: State, **changes: Any) -> str:
    _, reason_text = next_state(state, replace(STAYS[state], **changes))
    return reason_text


@pytest.mark.parametrize("state", STAYS)
def test_a_state_without_a_cause_does_not_change(state: State) -> None:
    """Without a cause a state does not change, and there is no reason."""
    assert next_state(state, STAYS[state]) == (state, "")


Cause = tuple[str, dict[str, Any], dict[State, State]]
"""The cause's name, its change of the situation, and the target of each state that it ends."""
MISSING_AXES: list[Cause] = [(f"without {axis}", {"enabled": ALL_AXES - {axis}}, {"engaged": "lost"}) for axis in AXES]
CAUSES: list[Cause] = [
    ("override", {"overrides": "o"}, dict.fromkeys(("enabling", "engaged", "parking", "lost"), "overridden")),
    ("report missing", {"missing_reports": "u"}, dict.fromkeys(("clearing", "enabling", "engaged", "parking"), "lost")),
    ("commands late", {"since_sent_ns": TIMEOUT_NS}, dict.fromkeys(("enabling", "engaged", "parking"), "lost")),
    ("commands in time", {"since_sent_ns": TIMEOUT_NS - 1}, {}),
    ("fault", {"faults": "f"}, dict.fromkeys(("clearing", "enabling", "engaged"), "lost")),
    ("trip", {"watchdog_trips": "t"}, dict.fromkeys(("enabling", "engaged"), "lost")),
    ("command error", {"command_errors": "c"}, {"engaged": "lost"}),
    ("reason only", {"kit_reasons": "r"}, {}),
    ("inhibit reason only", {"inhibit_reason": "i"}, {}),
    ("car moves", {"is_stationary": False}, {}),
    ("gear unknown", {"gear": None}, {"engaged": "lost"}),
    ("reverse", {"gear": "reverse"}, {"engaged": "lost"}),
    ("park", {"gear": "park"}, {"engaged": "lost"}),
    *MISSING_AXES,
]


@pytest.mark.parametrize("state", STAYS)
@pytest.mark.parametrize(
    ("changes", "targets"), [pytest.param(changes, targets, id=name) for name, changes, targets in CAUSES]
)
def test_a_cause_ends_its_states(state: State, changes: dict[str, Any], targets: dict[State, State]) -> None:
    """Each cause alone ends the states that it concerns, and no other."""
    assert target(state, **changes) == targets.get(state, state)


WANTED = {"wanted": True, "enabled": NO_AXES, "gear": "park"}
NOT_WANTED = {"wanted": False}
RELEASED = {"wanted": False, "enabled": NO_AXES}
INHIBITED = {**WANTED, "inhibit_reason": "h"}
READY = {"enabled": ALL_AXES, "gear": "drive"}
ROWS: list[tuple[State, dict[str, Any], State]] = [
    ("idle", WANTED, "clearing"),
    ("idle", {**WANTED, "is_stationary": False}, "idle"),
    ("idle", INHIBITED, "idle"),
    ("clearing", {"in_state_ns": PAUSE_NS - 1}, "clearing"),
    ("clearing", {"in_state_ns": PAUSE_NS}, "enabling"),
    ("clearing", {"in_state_ns": PAUSE_NS, "overrides": "o"}, "clearing"),
    ("clearing", {"in_state_ns": PAUSE_NS, "watchdog_trips": "t"}, "clearing"),
    ("clearing", {"in_state_ns": LIMIT_NS}, "enabling"),
    ("clearing", {"in_state_ns": LIMIT_NS - 1, "overrides": "o"}, "clearing"),
    ("clearing", {"in_state_ns": LIMIT_NS, "overrides": "o"}, "lost"),
    ("clearing", {"in_state_ns": LIMIT_NS, "watchdog_trips": "t"}, "lost"),
    ("clearing", NOT_WANTED, "parking"),
    ("enabling", READY, "engaged"),
    ("enabling", {**READY, "gear": "neutral"}, "enabling"),
    *(("enabling", {**READY, "enabled": ALL_AXES - {axis}}, "enabling") for axis in AXES),
    ("enabling", {**READY, "in_state_ns": LIMIT_NS}, "engaged"),
    ("enabling", {"in_state_ns": LIMIT_NS - 1}, "enabling"),
    ("enabling", {"in_state_ns": LIMIT_NS}, "lost"),
    ("enabling", {**NOT_WANTED, "in_state_ns": PAUSE_NS - 1}, "enabling"),
    ("enabling", {**NOT_WANTED, "in_state_ns": PAUSE_NS}, "parking"),
    ("engaged", {"in_state_ns": LIMIT_NS}, "engaged"),
    ("engaged", NOT_WANTED, "parking"),
    ("parking", {**RELEASED, "in_state_ns": PAUSE_NS - 1}, "parking"),
    ("parking", {**RELEASED, "in_state_ns": PAUSE_NS}, "idle"),
    ("parking", {**RELEASED, "wanted": True, "in_state_ns": PAUSE_NS}, "idle"),
    ("parking", {**RELEASED, "expects_no_release": True, "in_state_ns": PAUSE_NS - 1}, "parking"),
    ("parking", {**RELEASED, "expects_no_release": True, "in_state_ns": PAUSE_NS}, "lost"),
    ("parking", {"expects_no_release": True, "in_state_ns": LIMIT_NS}, "parking"),
    *(("parking", {"enabled": frozenset({axis}), "in_state_ns": LIMIT_NS}, "parking") for axis in AXES),
    ("lost", {"enabled": NO_AXES, "in_state_ns": LIMIT_NS}, "lost"),
    ("lost", NOT_WANTED, "parking"),
    ("lost", {**NOT_WANTED, "enabled": frozenset({"brake"})}, "parking"),
    ("lost", {**NOT_WANTED, "enabled": ALL_AXES - {"brake"}}, "lost"),
    ("lost", {**NOT_WANTED, "since_sent_ns": TIMEOUT_NS - 1}, "parking"),
    ("lost", {**NOT_WANTED, "since_sent_ns": TIMEOUT_NS}, "lost"),
    ("lost", {**RELEASED, "since_sent_ns": TIMEOUT_NS}, "idle"),
    ("parking", {**RELEASED, "since_sent_ns": TIMEOUT_NS}, "parking"),
    *(("parking", {"enabled": frozenset({axis}), "since_sent_ns": TIMEOUT_NS}, "lost") for axis in AXES),
    ("lost", {**NOT_WANTED, "missing_reports": "u"}, "lost"),
    ("lost", RELEASED, "idle"),
    ("lost", {**RELEASED, "is_stationary": False}, "idle"),
    ("lost", {**RELEASED, "missing_reports": "u"}, "lost"),
    ("overridden", RELEASED, "idle"),
    ("overridden", {**RELEASED, "overrides": "o"}, "idle"),
    ("overridden", {**RELEASED, "wanted": True}, "overridden"),
    ("overridden", {**RELEASED, "is_stationary": False}, "overridden"),
    ("overridden", {**RELEASED, "missing_reports": "u"}, "overridden"),
    *(("overridden", {"wanted": False, "enabled": frozenset({axis})}, "overridden") for axis in AXES),
]


@pytest.mark.parametrize(("state", "changes", "follows"), ROWS)
def test_a_row_needs_all_of_its_conditions(state: State, changes: dict[str, Any], follows: State) -> None:
    """A row applies only if all its conditions are met; a minimum duration is met exactly from its end on."""
    assert target(state, **changes) == follows


TEXTS = ("overrides", "missing_reports", "faults", "watchdog_trips", "command_errors")
"""Causes that have texts, in order of priority."""


@pytest.mark.parametrize("first", TEXTS)
def test_the_cause_of_the_highest_priority_is_the_reason(first: str) -> None:
    """Of several causes the reason is an override, then missing reports, faults, trips and command errors."""
    present = TEXTS[TEXTS.index(first) :]
    causes: dict[str, Any] = {name: name.upper() for name in present}
    next_name, reason_text = next_state("engaged", replace(GOOD, wanted=False, **causes))
    assert next_name == ("overridden" if first == "overrides" else "lost")
    assert [name for name in present if name.upper() in reason_text.partition(" (")[0]] == [first]


def test_a_cause_without_a_text_uses_its_row() -> None:
    """The reason for a cause without a text is the description of the table's row."""
    reason_text = reason("engaged", since_sent_ns=TIMEOUT_NS)
    assert reason_text in {row.description for row in TABLE if row.target == "lost"}
    assert reason("engaged", wanted=False) in {row.description for row in TABLE if row.target == "parking"}


def test_a_gear_is_named() -> None:
    """A gear that ends driving is named in the reason, even if it is unknown."""
    assert "neutral" in reason("engaged", gear="neutral")
    assert "unknown" in reason("engaged", gear=None)


DETAILS = {"watchdog_trips": "TRIP", "command_errors": "ERROR", "kit_reasons": "REASON"}
CASES: list[tuple[State, dict[str, Any]]] = [
    ("engaged", {"watchdog_trips": "TRIP"}),
    ("engaged", {"enabled": NO_AXES}),
    ("clearing", {"in_state_ns": LIMIT_NS, "overrides": "OVERRIDE"}),
    ("enabling", {"in_state_ns": LIMIT_NS}),
    ("parking", {"enabled": NO_AXES, "expects_no_release": True, "in_state_ns": PAUSE_NS}),
]


@pytest.mark.parametrize(
    ("state", "cause", "detail"),
    [
        (state, cause, detail)
        for state, cause in CASES
        for detail in DETAILS
        if (state, detail) != ("enabling", "watchdog_trips")
    ],
)  # a trip ends enabling immediately
def test_other_reported_problems_are_in_the_reason(state: State, cause: dict[str, Any], detail: str) -> None:
    """A reason contains the trips, command errors and reasons that the kit reports, and no empty part without them."""
    text = reason(state, **{**cause, detail: DETAILS[detail]})
    assert DETAILS[detail] in text
    assert cause.get("overrides", "") in text
    assert SEPARATOR + "REASON" in reason(state, **{**cause, "command_errors": "ERROR", "kit_reasons": "REASON"})
    for reason_text in (text, reason(state, **cause)):
        assert "()" not in reason_text
        assert "; ;" not in reason_text
        assert not reason_text.endswith(("; ", " "))


@pytest.mark.parametrize("axis", AXES)
def test_axes_that_are_not_enabled_are_named(axis: Axis) -> None:
    """A reason names exactly the axes that the kit released or did not enable; in `clearing` it names no axis."""
    others = {"enabled": ALL_AXES - {axis}}
    for text in (reason("engaged", **others), reason("enabling", **others, in_state_ns=LIMIT_NS)):
        assert {name for name in AXES if name in text} == {axis}
    assert reason("engaged", enabled=NO_AXES).endswith(AXES[-1])
    assert not any(name in reason("clearing", in_state_ns=LIMIT_NS, watchdog_trips="TRIP") for name in AXES)


def test_a_gear_that_was_not_reached_is_named() -> None:
    """If DRIVE was not reached in time the reason names the gear; in DRIVE it names only the missing axes."""
    assert "park" in reason("enabling", enabled=ALL_AXES, in_state_ns=LIMIT_NS)
    assert "gear" not in reason("enabling", gear="drive", in_state_ns=LIMIT_NS)
    assert "gear" not in reason("clearing", in_state_ns=LIMIT_NS, watchdog_trips="TRIP")


AXIS_SETS = [frozenset(axes) for axes in chain.from_iterable(combinations(AXES, size) for size in range(4))]
CHOICES: dict[str, tuple[Any, ...]] = {
    "wanted": (False, True),
    "is_stationary": (False, True),
    "inhibit_reason": ("", "i"),
    "missing_reports": ("", "m"),
    "since_sent_ns": (TIMEOUT_NS - 1, TIMEOUT_NS),
    "faults": ("", "f"),
    "overrides": ("", "o"),
    "watchdog_trips": ("", "t"),
    "command_errors": ("", "c"),
    "kit_reasons": ("",),
    "enabled": tuple(AXIS_SETS),
    "gear": ("drive", "park"),
    "in_state_ns": (0, PAUSE_NS, LIMIT_NS),
    "expects_no_release": (False, True),
}
"""Inputs on either side of every condition in the table."""


def situations() -> Iterator[Situation]:
    return (Situation(*values) for values in product(*CHOICES.values()))


def test_no_states_follow_each_other_in_a_cycle_at_one_instant() -> None:
    """For any inputs, a chain of transitions at one instant ends, and reaches no state twice."""
    assert list(CHOICES) == list(Situation.__struct_fields__)
    for now in situations():
        at_once = replace(now, in_state_ns=0)
        following = {state: next_state(state, at_once)[0] for state in get_args(State)}
        for state in get_args(State):
            path = [state, next_state(state, now)[0]]
            while path[-1] != following[path[-1]]:
                path.append(following[path[-1]])
                assert len(path) <= len(following), (path, now)
            assert len(set(path[1:])) == len(path[1:]), (path, now)
            assert state not in path[2:], (path, now)


def test_transitions_of_one_instant_follow_the_table() -> None:
    """The states of one instant are those that the table gives one after another, with its reasons."""
    stalled = replace(STAYS["parking"], since_sent_ns=TIMEOUT_NS)
    (lost,) = states_after("parking", stalled)
    assert lost == next_state("parking", stalled)
    missed = replace(GOOD, wanted=False, enabled=NO_AXES, in_state_ns=LIMIT_NS)
    assert [state for state, _ in states_after("engaged", missed)] == ["lost", "idle"]
    assert states_after("idle", STAYS["idle"]) == []


def test_a_cycle_in_the_table_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even with a table that has a cycle, no state is reached twice at one instant."""
    cycle = (
        TransitionRow(("engaged",), "", lambda _: True, "lost"),
        TransitionRow(("lost",), "", lambda _: True, "parking"),
        TransitionRow(("parking",), "", lambda _: True, "lost"),
    )
    monkeypatch.setattr(states, "TABLE", cycle)
    assert [state for state, _ in states_after("engaged", GOOD)] == ["lost", "parking"]
