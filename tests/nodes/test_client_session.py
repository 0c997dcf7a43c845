from __future__ import annotations

import pytest

from lavt.domain import NS_PER_S, SafetyState, SessionReply, State
from lavt.nodes.client_session import ClientSession

GRANTED = SessionReply(True, "", 5, bytes(16), 5600, "kernel", 0)
REFUSED = SessionReply(False, "held by bob", 0, b"", 5600, "kernel", 70)


def new_session(*, rearm: bool = False) -> ClientSession:
    return ClientSession("alice", 7, rearm=rearm, start_ns=100)


def test_it_holds_the_vehicle_and_waits_for_the_condition_of_the_network() -> None:
    """A session that waits asks for the vehicle, but does not command it until the condition is in force."""
    session = ClientSession("alice", 7, rearm=False, start_ns=100, waits=True)
    assert session.request_due(100) is not None
    session.note_reply(GRANTED, 200)
    assert (session.phase, session.commanding) == ("arming", False)
    assert session.because == "the network's condition is not in force yet"
    session.note_condition("the server does not delay the video: no")
    assert (session.because, session.commanding) == ("the server does not delay the video: no", False)
    session.note_condition("")
    assert (session.because, session.commanding) == ("", True)
    session.note_condition("later")
    assert (session.because, session.commanding) == ("", True)


def state(safety: SafetyState, speed_mps: float = 0.0) -> State:
    return State(1, 1, speed_mps, 0.0, "drive", safety, "because", -1, "")


def driving(*, rearm: bool = False) -> ClientSession:
    session = new_session(rearm=rearm)
    session.note_reply(GRANTED, 200)
    session.note_state(state("driving"), 300)
    assert session.phase == "driving"
    return session


def test_it_asks_at_once_and_every_second_until_armed() -> None:
    """The vehicle is asked for at the start and once a second, also when refused, until it drives."""
    session = new_session()
    assert session.request_due(99) is None
    request = session.request_due(100)
    assert request is not None
    assert (request.operation, request.who, request.instance) == ("hold", "alice", 7)
    assert session.request_due(100 + NS_PER_S - 1) is None
    session.note_reply(REFUSED, 200)
    assert (session.phase, session.because, session.commanding) == ("seeking", "held by bob", False)
    assert session.request_due(100 + NS_PER_S) is not None
    session.note_reply(GRANTED, NS_PER_S)
    assert (session.phase, session.epoch, session.host, session.commanding) == ("arming", 5, "kernel", True)
    session.note_state(state("driving"), 300)
    assert session.next_wake_ns() is None
    assert session.request_due(10 * NS_PER_S) is None


def test_a_new_epoch_is_taken_over_while_arming() -> None:
    """A vehicle that stopped while arming hands out a new epoch, and commands go on under it."""
    session = new_session()
    session.note_reply(GRANTED, 200)
    session.note_reply(SessionReply(True, "", 6, bytes(16), 5600, "kernel", 0), 300)
    assert session.epoch == 6


def test_a_grant_without_an_epoch_gives_none() -> None:
    """The granted answer to an emergency stop or a release, which hands nothing out, begins no session."""
    session = new_session()
    session.note_reply(SessionReply(True, "", 0, b"", 5600, "kernel", 3), 200)
    assert (session.phase, session.commanding) == ("seeking", False)
    session = driving()
    session.note_reply(SessionReply(True, "", 0, b"", 5600, "kernel", 3), 200)
    assert session.epoch == 5


@pytest.mark.parametrize("safety", ["disarmed", "safe_stop", "emergency_stop"])
def test_a_stopped_vehicle_stays_stopped(safety: SafetyState) -> None:
    """After a stop nothing is commanded or asked any more: a person begins anew."""
    session = driving()
    session.note_state(state("degraded"), 400)
    assert session.phase == "driving"
    session.note_state(state(safety), 500)
    assert (session.phase, session.commanding, session.because) == ("stopped", False, "because")
    session.note_state(state(safety), 600)
    assert session.request_due(10 * NS_PER_S) is None


def test_with_rearm_it_asks_again_at_standstill() -> None:
    """With `rearm` a stopped vehicle is asked for again once it stands, and not before."""
    session = driving(rearm=True)
    session.note_state(state("safe_stop", 3.0), 500)
    session.note_state(state("safe_stop", 2.0), 600)
    assert session.next_wake_ns() is None
    session.note_state(state("safe_stop", 0.0), 700)
    assert session.phase == "seeking"
    assert session.request_due(700) is not None


def test_an_emergency_stop_has_a_number_beyond_all_seen() -> None:
    """The number is the wall clock's or, where that is behind, one more than the highest seen, and it only grows."""
    session = new_session()
    session.note_reply(REFUSED, 200)
    request = session.stop_now(60)
    assert (request.operation, request.number, session.emergency_stop) == ("emergency_stop", 71, 71)
    assert session.stop_now(1000).number == 1000
    assert session.stop_now(1000).number == 1001


def test_an_emergency_stop_taken_for_an_old_one_is_raised_again() -> None:
    """A client whose wall clock is behind learns the higher number from the refusal, and carries a newer one."""
    session = driving()
    assert session.stop_now(60).number == 60
    session.note_reply(REFUSED, 300)
    assert session.emergency_stop == 71
