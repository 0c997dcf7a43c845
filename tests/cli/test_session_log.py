from __future__ import annotations

import pytest
from msgspec.structs import replace

from lavt.cli.session_log import (
    FIRST_STATE_TIMEOUT_NS,
    MAX_SERVERS,
    NO_STATE_YET,
    STATE_AGAIN,
    SessionLog,
    client_end_line,
    phase_line,
    server_end_line,
    state_lines,
)
from lavt.domain import NS_PER_MS, NS_PER_S, State
from lavt.nodes.client_session import Phase

STATE = State(
    sent_wall_ns=0,
    state_mono_ns=0,
    speed_mps=0.0,
    steering_rad=0.0,
    gear="drive",
    safety="disarmed",
    reason="nobody has armed the vehicle yet",
    applied_sequence=-1,
    rejected="",
    instance=7,
)
CONTROLLED = replace(STATE, active_operator="operator-1")
DRIVING = replace(CONTROLLED, safety="driving", reason="armed by the client")
REQUESTED = replace(DRIVING, requested_by="operator-2")
STATE_PERIOD_NS = 20 * NS_PER_MS

CHANGES: dict[str, tuple[State | None, State, str, list[tuple[str, ...]]]] = {
    "no change": (STATE, STATE, "", []),
    "first state": (None, DRIVING, "", [("operator-1", "control"), ("driving", "operator-1")]),
    "control acquired": (STATE, CONTROLLED, "", [("operator-1", "control")]),
    "handed over": (DRIVING, replace(DRIVING, active_operator="operator-2"), "", [("operator-2", "control")]),
    "armed": (CONTROLLED, DRIVING, "", [("driving", "operator-1")]),
    "command timeout": (
        DRIVING,
        replace(DRIVING, safety="degraded", reason="no command from a newer picture"),
        "",
        [("degraded", "no command from a newer picture")],
    ),
    "released": (
        DRIVING,
        replace(STATE, safety="safe_stop", reason="the client released the vehicle"),
        "",
        [("no operator",), ("safe_stop", "operator-1", "released")],
    ),
    "requested, on other sides": (DRIVING, REQUESTED, "", [("operator-2", "from operator-1")]),
    "requested, on the active operator's side": (DRIVING, REQUESTED, "operator-1", [("operator-2", "SIGUSR2")]),
    "request expired": (REQUESTED, DRIVING, "operator-1", [("operator-2", "no longer")]),
    "server restarted": (STATE, replace(STATE, instance=8), "", [("server", "restarted")]),
}
"""The previous state, the new state, the operator of this side ("" on a server), and parts of each logged line."""


@pytest.mark.parametrize("case", CHANGES)
def test_each_state_change_has_its_own_line(case: str) -> None:
    """Each difference between two states has a line, and an unchanged state has none."""
    before, after, operator, parts = CHANGES[case]
    lines = state_lines(before, after, operator=operator)
    assert len(lines) == len(parts)
    assert all(part in line for line, line_parts in zip(lines, parts, strict=True) for part in line_parts), lines


PHASES: dict[tuple[Phase, str], tuple[str, ...]] = {
    ("seeking", ""): (),
    ("seeking", "held by operator-1"): ("waiting", "held by operator-1"),
    ("arming", ""): ("arming",),
    ("arming", "no delay yet"): ("arming", "no delay yet"),
    ("driving", ""): (),
    ("stopped", "command timeout"): ("command timeout",),
    ("watching", "released"): ("released", "watches"),
}
"""Parts of the line for each phase and reason; without parts there is no line."""


@pytest.mark.parametrize(("phase", "reason"), PHASES)
def test_each_phase_of_the_client_has_its_line(phase: Phase, reason: str) -> None:
    """A client logs waiting, arming, loss of control and release; driving is logged from the vehicle's state."""
    line, parts = phase_line(phase, reason), PHASES[phase, reason]
    assert bool(line) == bool(parts)
    assert all(part in line for part in parts)


def test_each_change_is_logged_once() -> None:
    """A repeated state, phase or ending is logged once."""
    log = SessionLog("operator-1")
    for number in range(50):
        log.add_state(DRIVING, number * STATE_PERIOD_NS, has_control=True)
        log.set_phase("stopped", "why")
        log.set_ending("completed")
    control, safety, phase, ending = log.take_lines(NS_PER_S)
    assert "operator-1" in control
    assert safety.startswith("driving: ")
    assert phase.endswith(": why")
    assert ending.endswith(": completed")
    assert log.take_lines(NS_PER_S + STATE_PERIOD_NS) == []
    log.set_ending(None)
    log.set_ending("completed")
    assert log.take_lines(NS_PER_S + STATE_PERIOD_NS) == [ending]


def test_alternating_states_of_two_servers_are_logged_once() -> None:
    """If two servers have the same name, each change of either vehicle is logged once, not with every state."""
    log, other = SessionLog("operator-1"), replace(STATE, instance=8)
    for number in range(50):
        log.add_state(DRIVING, number * STATE_PERIOD_NS, has_control=True)
        log.add_state(other, number * STATE_PERIOD_NS, has_control=True)
    lines = log.take_lines(NS_PER_S)
    assert lines.count("the server has restarted") == 1
    assert len(lines) == len(set(lines))
    log.add_state(replace(DRIVING, safety="safe_stop", reason="why"), NS_PER_S, has_control=True)
    log.add_state(other, NS_PER_S, has_control=True)
    assert log.take_lines(NS_PER_S) == ["safe_stop: why"]


def test_many_servers_are_not_remembered_without_limit() -> None:
    """The log remembers the states of a limited number of servers."""
    log = SessionLog("operator-1")
    for instance in range(3 * MAX_SERVERS):
        log.add_state(replace(STATE, instance=instance), 0)
    log.take_lines(0)
    log.add_state(replace(STATE, instance=3 * MAX_SERVERS - MAX_SERVERS), 0)
    assert log.take_lines(0) == []
    log.add_state(replace(STATE, instance=0), 0)
    assert log.take_lines(0) == ["the server has restarted"]


def test_rejections_are_logged_at_most_once_a_second_with_their_count() -> None:
    """The first rejection is logged immediately; the rejections of the next second are logged together."""
    log = SessionLog()
    logged = {}
    for number in range(100):
        log.add_rejection("too old")
        if lines := log.take_lines(number * STATE_PERIOD_NS):
            logged[number] = lines
    assert list(logged) == [0, 50]
    assert all(line.endswith(": too old") for (line,) in logged.values())
    assert logged[50][0].startswith("50 ")


def test_a_client_logs_the_rejections_in_the_state() -> None:
    """A client takes rejections from the vehicle's state, and logs one each time that the reason changes."""
    log = SessionLog("operator-1")
    log.add_state(STATE, 0)
    log.take_lines(0)
    for number in range(10):
        log.add_state(replace(STATE, rejected="too old"), number * STATE_PERIOD_NS)
    (line,) = log.take_lines(NS_PER_S)
    assert line.endswith(": too old")


def test_a_limit_is_logged_when_it_comes_into_force() -> None:
    """A limit that applies, even intermittently, is logged once, and again after a second without this limit."""
    log, logged = SessionLog(), []
    log.add_state(STATE, 0)
    log.take_lines(0)
    for number in range(200):
        limited = "lateral acceleration, speed" if number % 3 == 0 and not 50 <= number < 150 else ""
        log.add_state(replace(STATE, limited=limited), number * STATE_PERIOD_NS)
        logged += [(number, line) for line in log.take_lines(number * STATE_PERIOD_NS)]
    assert logged == [
        (0, "limited: lateral acceleration"),
        (0, "limited: speed"),
        (150, "limited: lateral acceleration"),
        (150, "limited: speed"),
    ]


def test_a_missing_state_is_logged() -> None:
    """A client logs once that no state has come for a second, and logs when the next state arrives."""
    log = SessionLog("operator-1")
    log.add_state(STATE, 0)
    log.take_lines(0)
    assert log.take_lines(999 * NS_PER_MS) == []
    (line,) = log.take_lines(1_200 * NS_PER_MS)
    assert line.endswith(" 1.2 s")
    assert log.take_lines(9 * NS_PER_S) == []
    log.add_state(STATE, 10 * NS_PER_S)
    assert log.take_lines(10 * NS_PER_S) == [STATE_AGAIN]


def test_a_client_without_a_first_state_logs_what_to_check() -> None:
    """A client without a state 3 s after its start logs once what to check; a server never does."""
    client_log, server_log = SessionLog("operator-1"), SessionLog()
    for session_log in (client_log, server_log):
        assert session_log.take_lines(5) == []
        assert session_log.take_lines(5 + FIRST_STATE_TIMEOUT_NS - 1) == []
    assert client_log.take_lines(5 + FIRST_STATE_TIMEOUT_NS) == [NO_STATE_YET]
    assert client_log.take_lines(5 + 9 * NS_PER_S) == []
    assert server_log.take_lines(5 + 9 * NS_PER_S) == []


def test_the_last_line_describes_the_vehicle() -> None:
    """A client's last line says whether its release was confirmed, a server's whether its vehicle is stationary."""
    assert "released" in client_end_line(released=True)
    assert "not confirmed" in client_end_line(released=False)
    assert "stationary" in server_end_line(None)
    assert "3.1 m/s" in server_end_line(3.14)
