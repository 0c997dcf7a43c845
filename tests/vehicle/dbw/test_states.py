"""The table of the adapter's states, row by row, without a car."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from lavt.domain import NS_PER_MS
from lavt.vehicle.dbw.adapter import SEPARATOR
from lavt.vehicle.dbw.profile import AXES, Axis
from lavt.vehicle.dbw.states import TABLE, Situation, State, following

ALL: frozenset[Axis] = frozenset(AXES)
NONE: frozenset[Axis] = frozenset()
PAUSE_NS, LIMIT_NS, TIMEOUT_NS = 120 * NS_PER_MS, 3000 * NS_PER_MS, 100 * NS_PER_MS
GOOD = Situation(
    wanted=True,
    is_stationary=True,
    inhibit_reason="",
    unheard="",
    silent_ns=0,
    faults="",
    overrides="",
    trips="",
    lapses="",
    reasons="",
    enabled=ALL,
    gear="drive",
    since_ns=0,
)
STAYS: dict[State, Situation] = {
    "idle": replace(GOOD, wanted=False, enabled=NONE, gear="park"),
    "clearing": replace(GOOD, enabled=NONE, gear="park"),
    "enabling": replace(GOOD, enabled=NONE, gear="park"),
    "engaged": GOOD,
    "parking": replace(GOOD, wanted=False),
    "overridden": replace(GOOD, enabled=NONE),
    "lost": GOOD,
}
"""For each state a situation in which it remains."""


def target(state: State, **changes: Any) -> State:
    return following(state, replace(STAYS[state], **changes))[0]


def reason(state: State, **changes: Any) -> str:
    return following(state, replace(STAYS[state], **changes))[1]


@pytest.mark.parametrize("state", STAYS)
def test_a_state_remains_without_a_cause(state: State) -> None:
    """Where nothing happens a state remains, and there is no reason."""
    assert following(state, STAYS[state]) == (state, "")


Cause = tuple[str, dict[str, Any], dict[State, State]]
"""Its name, how it changes a situation, and to which state it leads from which."""
WITHOUT: list[Cause] = [(f"without {axis}", {"enabled": ALL - {axis}}, {"engaged": "lost"}) for axis in AXES]
CAUSES: list[Cause] = [
    ("override", {"overrides": "o"}, dict.fromkeys(("enabling", "engaged", "parking", "lost"), "overridden")),
    ("report missing", {"unheard": "u"}, dict.fromkeys(("clearing", "enabling", "engaged", "parking"), "lost")),
    ("commands late", {"silent_ns": TIMEOUT_NS}, dict.fromkeys(("enabling", "engaged", "parking"), "lost")),
    ("commands in time", {"silent_ns": TIMEOUT_NS - 1}, {}),
    ("fault", {"faults": "f"}, dict.fromkeys(("clearing", "enabling", "engaged"), "lost")),
    ("trip", {"trips": "t"}, dict.fromkeys(("enabling", "engaged"), "lost")),
    ("lapse", {"lapses": "l"}, {"engaged": "lost"}),
    ("reason only", {"reasons": "r"}, {}),
    ("hindrance only", {"inhibit_reason": "h"}, {}),
    ("car moves", {"is_stationary": False}, {}),
    ("gear unknown", {"gear": None}, {"engaged": "lost"}),
    ("reverse", {"gear": "reverse"}, {"engaged": "lost"}),
    ("park", {"gear": "park"}, {"engaged": "lost"}),
    *WITHOUT,
]


@pytest.mark.parametrize("state", STAYS)
@pytest.mark.parametrize(
    ("changes", "targets"), [pytest.param(changes, targets, id=name) for name, changes, targets in CAUSES]
)
def test_a_cause_ends_the_states_that_it_concerns(
    state: State, changes: dict[str, Any], targets: dict[State, State]
) -> None:
    """Each cause on its own ends the states that it concerns, and no other."""
    assert target(state, **changes) == targets.get(state, state)


WANTED = {"wanted": True, "enabled": NONE, "gear": "park"}
NOT_WANTED = {"wanted": False}
RELEASED = {"wanted": False, "enabled": NONE}
HINDERED = {**WANTED, "inhibit_reason": "h"}
READY = {"enabled": ALL, "gear": "drive"}
ROWS: list[tuple[State, dict[str, Any], State]] = [
    ("idle", WANTED, "clearing"),
    ("idle", {**WANTED, "is_stationary": False}, "idle"),
    ("idle", HINDERED, "idle"),
    ("clearing", {"since_ns": PAUSE_NS - 1}, "clearing"),
    ("clearing", {"since_ns": PAUSE_NS}, "enabling"),
    ("clearing", {"since_ns": PAUSE_NS, "overrides": "o"}, "clearing"),
    ("clearing", {"since_ns": PAUSE_NS, "trips": "t"}, "clearing"),
    ("clearing", {"since_ns": LIMIT_NS}, "enabling"),
    ("clearing", {"since_ns": LIMIT_NS - 1, "overrides": "o"}, "clearing"),
    ("clearing", {"since_ns": LIMIT_NS, "overrides": "o"}, "lost"),
    ("clearing", {"since_ns": LIMIT_NS, "trips": "t"}, "lost"),
    ("clearing", NOT_WANTED, "parking"),
    ("enabling", READY, "engaged"),
    ("enabling", {**READY, "gear": "neutral"}, "enabling"),
    *(("enabling", {**READY, "enabled": ALL - {axis}}, "enabling") for axis in AXES),
    ("enabling", {**READY, "since_ns": LIMIT_NS}, "engaged"),
    ("enabling", {"since_ns": LIMIT_NS - 1}, "enabling"),
    ("enabling", {"since_ns": LIMIT_NS}, "lost"),
    ("enabling", NOT_WANTED, "parking"),
    ("engaged", {"since_ns": LIMIT_NS}, "engaged"),
    ("engaged", NOT_WANTED, "parking"),
    ("parking", {**RELEASED, "since_ns": PAUSE_NS - 1}, "parking"),
    ("parking", {**RELEASED, "since_ns": PAUSE_NS}, "idle"),
    ("parking", {**RELEASED, "wanted": True, "since_ns": PAUSE_NS}, "idle"),
    *(("parking", {"enabled": frozenset({axis}), "since_ns": LIMIT_NS}, "parking") for axis in AXES),
    ("lost", {"enabled": NONE, "since_ns": LIMIT_NS}, "lost"),
    ("lost", NOT_WANTED, "parking"),
    *(("lost", {"wanted": False, "enabled": frozenset({axis})}, "parking") for axis in AXES),
    ("lost", {**NOT_WANTED, "unheard": "u"}, "lost"),
    ("lost", RELEASED, "idle"),
    ("lost", {**RELEASED, "is_stationary": False}, "idle"),
    ("lost", {**RELEASED, "unheard": "u"}, "lost"),
    ("overridden", RELEASED, "idle"),
    ("overridden", {**RELEASED, "overrides": "o"}, "idle"),
    ("overridden", {**RELEASED, "wanted": True}, "overridden"),
    ("overridden", {**RELEASED, "is_stationary": False}, "overridden"),
    ("overridden", {**RELEASED, "unheard": "u"}, "overridden"),
    *(("overridden", {"wanted": False, "enabled": frozenset({axis})}, "overridden") for axis in AXES),
]


@pytest.mark.parametrize(("state", "changes", "follows"), ROWS)
def test_a_row_needs_all_of_its_conditions(state: State, changes: dict[str, Any], follows: State) -> None:
    """A state is left only where every condition of a row is met, and at the nanosecond at which its time is over."""
    assert target(state, **changes) == follows


TEXTS = ("overrides", "unheard", "faults", "trips", "lapses")
"""What ends driving with words of its own, the most important first."""


@pytest.mark.parametrize("first", TEXTS)
def test_the_most_important_cause_is_the_reason(first: str) -> None:
    """Where several causes coincide the reason is the driver, then missing reports, faults, trips and late commands."""
    given = TEXTS[TEXTS.index(first) :]
    causes: dict[str, Any] = {name: name.upper() for name in given}
    found, why = following("engaged", replace(GOOD, wanted=False, **causes))
    assert found == ("overridden" if first == "overrides" else "lost")
    assert [name for name in given if name.upper() in why.partition(" (")[0]] == [first]


def test_a_cause_without_words_has_those_of_its_row() -> None:
    """Where a cause has no words of its own the reason is that of the table's row."""
    why = reason("engaged", silent_ns=TIMEOUT_NS)
    assert why in {row.words for row in TABLE if row.target == "lost"}
    assert reason("engaged", wanted=False) in {row.words for row in TABLE if row.target == "parking"}


def test_a_gear_is_named() -> None:
    """A gear that ends driving is named, also where it is not known."""
    assert "neutral" in reason("engaged", gear="neutral")
    assert "unknown" in reason("engaged", gear=None)


DETAILS = {"trips": "TRIP", "lapses": "LAPSE", "reasons": "REASON"}
SEVERAL: list[tuple[State, dict[str, Any]]] = [
    ("engaged", {"trips": "TRIP"}),
    ("engaged", {"enabled": NONE}),
    ("clearing", {"since_ns": LIMIT_NS, "overrides": "OVERRIDE"}),
    ("enabling", {"since_ns": LIMIT_NS}),
]


@pytest.mark.parametrize(
    ("state", "cause", "known"),
    [(*each, known) for each in SEVERAL for known in DETAILS if (each[0], known) != ("enabling", "trips")],
)  # a trip ends enabling at once
def test_what_else_the_kit_reports_is_a_part_of_the_reason(state: State, cause: dict[str, Any], known: str) -> None:
    """A reason has what the kit reports besides, and no empty part where it reports nothing."""
    said = reason(state, **{**cause, known: DETAILS[known]})
    assert DETAILS[known] in said
    assert cause.get("overrides", "") in said
    assert SEPARATOR + "REASON" in reason(state, **{**cause, "lapses": "LAPSE", "reasons": "REASON"})
    for text in (said, reason(state, **cause)):
        assert "()" not in text
        assert "; ;" not in text
        assert not text.endswith(("; ", " "))


@pytest.mark.parametrize("axis", AXES)
def test_the_axes_that_do_not_accept_are_named(axis: Axis) -> None:
    """An axis that the kit has let go of or did not enable is named, and no other; clearing is about no axis."""
    others = {"enabled": ALL - {axis}}
    for said in (reason("engaged", **others), reason("enabling", **others, since_ns=LIMIT_NS)):
        assert {each for each in AXES if each in said} == {axis}
    assert reason("engaged", enabled=NONE).endswith(AXES[-1])
    assert not any(each in reason("clearing", since_ns=LIMIT_NS, trips="TRIP") for each in AXES)


def test_a_gear_that_was_not_reached_is_named() -> None:
    """Where DRIVE was not reached in time the reason has the gear; where an axis is missing in DRIVE it has not."""
    assert "park" in reason("enabling", enabled=ALL, since_ns=LIMIT_NS)
    assert "gear" not in reason("enabling", gear="drive", since_ns=LIMIT_NS)
    assert "gear" not in reason("clearing", since_ns=LIMIT_NS, trips="TRIP")
