from __future__ import annotations

from dataclasses import replace

import pytest

from lavt.cli.session_log import (
    FIRST_STATE_NS,
    NO_STATE_YET,
    SessionLog,
    end_words,
    phase_words,
    release_words,
    state_words,
)
from lavt.domain import NS_PER_MS, NS_PER_S, State
from lavt.nodes.client_session import Phase

STATE = State(
    sent_wall_ns=0, state_mono_ns=0, speed_mps=0.0, steering_rad=0.0, gear="drive", safety="disarmed",
    reason="nobody has armed the vehicle yet", applied_sequence=-1, rejected="", instance=7,
)  # fmt: skip
HELD = replace(STATE, active_operator="operator-1")
DRIVING = replace(HELD, safety="driving", reason="armed by the client")
REQUESTED = replace(DRIVING, requested_by="operator-2")
TICK_NS = 20 * NS_PER_MS

CHANGES: dict[str, tuple[State | None, State, str, list[tuple[str, ...]]]] = {
    "nothing": (STATE, STATE, "", []),
    "the first": (None, DRIVING, "", [("operator-1", "holds"), ("driving", "operator-1")]),
    "held": (STATE, HELD, "", [("operator-1", "holds")]),
    "handed over": (DRIVING, replace(DRIVING, active_operator="operator-2"), "", [("operator-2", "holds")]),
    "armed": (HELD, DRIVING, "", [("driving", "operator-1")]),
    "silence": (
        DRIVING, replace(DRIVING, safety="degraded", reason="no command from a newer picture"), "",
        [("degraded", "no command from a newer picture")],
    ),
    "released": (
        DRIVING, replace(STATE, safety="safe_stop", reason="the client released the vehicle"), "",
        [("nobody",), ("safe_stop", "operator-1", "released")],
    ),
    "asked, for others": (DRIVING, REQUESTED, "", [("operator-2", "asks operator-1")]),
    "asked, for the holder": (DRIVING, REQUESTED, "operator-1", [("operator-2", "SIGUSR2")]),
    "not asked any more": (REQUESTED, DRIVING, "operator-1", [("operator-2", "not ask")]),
    "another server": (STATE, replace(STATE, instance=8), "", [("server", "anew")]),
}  # fmt: skip


@pytest.mark.parametrize("case", CHANGES)
def test_what_changed_is_said_in_words(case: str) -> None:
    """Each change from state to state has its line, and what stays has none."""
    before, after, this_client, parts = CHANGES[case]
    lines = state_words(before, after, this_client=this_client)
    assert len(lines) == len(parts)
    assert all(part in line for line, of_line in zip(lines, parts, strict=True) for part in of_line), lines


PHASES: dict[tuple[Phase, str], tuple[str, ...]] = {
    ("seeking", ""): (),
    ("seeking", "held by operator-1"): ("waiting", "held by operator-1"),
    ("arming", ""): ("arming",),
    ("arming", "no delay yet"): ("arming", "no delay yet"),
    ("driving", ""): (),
    ("stopped", "long silence"): ("long silence",),
    ("watching", "released"): ("released", "watches"),
}


@pytest.mark.parametrize(("phase", "reason"), PHASES)
def test_the_clients_phase_is_said_in_words(phase: Phase, reason: str) -> None:
    """A client says what it waits for, that it arms, and that it is over; of its drive the vehicle tells."""
    said, parts = phase_words(phase, reason), PHASES[phase, reason]
    assert bool(said) == bool(parts)
    assert all(part in said for part in parts)


def test_each_change_is_told_once() -> None:
    """A narrator that hears the same state and phase again and again says each of them once."""
    narrator = SessionLog("operator-1")
    for number in range(50):
        narrator.state(DRIVING, number * TICK_NS, holds=True)
        narrator.phase("stopped", "why")
        narrator.ending("completed")
    active_operator, armed, phase, ending = narrator.take(NS_PER_S)
    assert "operator-1" in active_operator
    assert armed.startswith("driving: ")
    assert phase.endswith(": why")
    assert ending.endswith(": completed")
    assert narrator.take(NS_PER_S + TICK_NS) == []
    narrator.ending(None)
    narrator.ending("completed")
    assert narrator.take(NS_PER_S + TICK_NS) == [ending]


def test_rejections_are_told_at_most_once_a_second_with_their_count() -> None:
    """The first refusal is told at once, those of the second after it together."""
    narrator = SessionLog()
    told = {}
    for number in range(100):
        narrator.rejection("too old")
        if lines := narrator.take(number * TICK_NS):
            told[number] = lines
    assert list(told) == [0, 50]
    assert all(line.endswith(": too old") for (line,) in told.values())
    assert told[50][0].startswith("50 ")


def test_a_client_tells_rejections_of_the_state() -> None:
    """A client hears of refusals by the vehicle's state: it tells one when the reason changes."""
    narrator = SessionLog("operator-1")
    narrator.state(STATE, 0)
    narrator.take(0)
    for number in range(10):
        narrator.state(replace(STATE, rejected="too old"), number * TICK_NS)
    (line,) = narrator.take(NS_PER_S)
    assert line.endswith(": too old")


def test_a_limit_is_told_when_it_begins_to_hold() -> None:
    """A limit is told once while it is in force, though not at every moment, and again after a second without it."""
    narrator, told = SessionLog(), []
    narrator.state(STATE, 0)
    narrator.take(0)
    for number in range(200):
        limited = "lateral acceleration, speed" if number % 3 == 0 and not 50 <= number < 150 else ""
        narrator.state(replace(STATE, limited=limited), number * TICK_NS)
        told += [(number, line) for line in narrator.take(number * TICK_NS)]
    assert told == [
        (0, "limited: lateral acceleration"),
        (0, "limited: speed"),
        (150, "limited: lateral acceleration"),
        (150, "limited: speed"),
    ]


def test_a_quiet_vehicle_is_told_of() -> None:
    """A client says that no state has come for a second, once, and when one comes again."""
    narrator = SessionLog("operator-1")
    narrator.state(STATE, 0)
    narrator.take(0)
    assert narrator.take(999 * NS_PER_MS) == []
    (line,) = narrator.take(1_200 * NS_PER_MS)
    assert line.endswith(" 1.2 s")
    assert narrator.take(9 * NS_PER_S) == []
    narrator.state(STATE, 10 * NS_PER_S)
    (line,) = narrator.take(10 * NS_PER_S)
    assert line.endswith("again")


def test_a_vehicle_that_never_told_its_state_is_told_of() -> None:
    """A client that has heard nothing 3 s after its start says what to look for, once; a server says no such thing."""
    narrator, server = SessionLog("operator-1"), SessionLog()
    for each in (narrator, server):
        assert each.take(5) == []
        assert each.take(5 + FIRST_STATE_NS - 1) == []
    assert narrator.take(5 + FIRST_STATE_NS) == [NO_STATE_YET]
    assert narrator.take(5 + 9 * NS_PER_S) == []
    assert server.take(5 + 9 * NS_PER_S) == []


def test_how_sides_end_is_said_in_words() -> None:
    """A client says whether its release was confirmed, a server whether its vehicle stands."""
    assert "released" in release_words(released=True)
    assert "nobody confirms" in release_words(released=False)
    assert "stands" in end_words(None)
    assert "3.1 m/s" in end_words(3.14)
