from __future__ import annotations

from dataclasses import replace

import pytest

from lavt.domain import NS_PER_S, Now, SafetyState, SessionReply, State
from lavt.nodes.client_session import ClientSession

GRANTED = SessionReply(True, "", 5, bytes(16), 5600, "kernel", 0)
REJECTED = SessionReply(False, "held by bob", 0, b"", 5600, "kernel", 70)


def new_session(*, rearm: bool = False) -> ClientSession:
    return ClientSession("alice", 7, rearm=rearm, start_ns=100)


def test_it_holds_the_vehicle_and_waits_for_the_condition_of_the_network() -> None:
    """A session that waits asks for the vehicle, but does not command it until the condition is in force."""
    session = ClientSession("alice", 7, rearm=False, start_ns=100, waits=True)
    assert session.request_due(100) is not None
    session.note_reply(GRANTED, 200)
    assert (session.phase, session.commanding) == ("arming", False)
    assert session.reason
    session.note_condition("no tc")
    assert (session.reason, session.commanding) == ("no tc", False)
    session.note_condition("")
    assert (session.reason, session.commanding) == ("", True)
    session.note_condition("later")
    assert (session.reason, session.commanding) == ("", True)


def state(safety: SafetyState, speed_mps: float = 0.0) -> State:
    return State(1, 1, speed_mps, 0.0, "drive", safety, "reason", -1, "")


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
    session.note_reply(REJECTED, 200)
    assert (session.phase, session.reason, session.commanding) == ("seeking", "held by bob", False)
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
    assert (session.phase, session.commanding, session.reason) == ("stopped", False, "reason")
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


@pytest.mark.parametrize("stopped", [False, True])
def test_who_took_over_in_the_car_keeps_it_also_with_rearm(stopped: bool) -> None:
    """A vehicle disarmed while it is driven, or while it stops, is not asked for again, whatever its server does."""
    session = driving(rearm=True)
    if stopped:
        session.note_state(state("safe_stop", 3.0), 500)
    session.note_state(state("disarmed", 3.0), 600)
    session.note_state(state("disarmed"), 700)
    session.note_state(replace(state("disarmed"), instance=2), 800)
    assert (session.phase, session.request_due(10 * NS_PER_S)) == ("stopped", None)


@pytest.mark.parametrize("stopped", [False, True])
def test_with_rearm_it_asks_a_server_that_was_started_again(stopped: bool) -> None:
    """A new process of the server knows of no session and tells a disarmed vehicle: nobody has taken that over."""
    session = driving(rearm=True)
    if stopped:
        session.note_state(state("safe_stop", 3.0), 500)
    session.note_state(replace(state("disarmed"), instance=2), 600)
    session.note_state(replace(state("disarmed"), instance=2), 700)
    assert session.phase == "seeking"
    assert session.request_due(700) is not None


def test_an_emergency_stop_has_a_number_beyond_all_seen() -> None:
    """The number is the wall clock's or, where that is behind, one more than the highest seen, and it only grows."""
    session = new_session()
    session.note_reply(REJECTED, 200)
    request = session.stop_now(Now(0, 60))
    assert (request.operation, request.number, session.emergency_stop) == ("emergency_stop", 71, 71)
    assert session.stop_now(Now(0, 1000)).number == 1000
    assert session.stop_now(Now(0, 1000)).number == 1001


def test_an_emergency_stop_taken_for_an_old_one_is_raised_again() -> None:
    """A client whose wall clock is behind learns the higher number from the refusal, and carries a newer one."""
    session = driving()
    assert session.stop_now(Now(0, 60)).number == 60
    session.note_reply(REJECTED, 300)
    assert session.emergency_stop == 71


@pytest.mark.parametrize("released", [False, True])
def test_an_emergency_stop_is_requested_again_until_the_vehicle_knows_of_it(released: bool) -> None:
    """Who waits for the vehicle, or has released it, sends no commands: of the query each second one may be lost."""
    session = new_session()
    if released:
        session.note_reply(GRANTED, 200)
        session.release(300)
    first = session.stop_now(Now(400, 60))
    others = {due(session, 400), due(session, 400 + NS_PER_S - 1)}
    assert others <= {"hold", "release", ""}
    assert session.next_wake_ns() == 400 + NS_PER_S
    assert session.request_due(400 + NS_PER_S) == first
    assert session.request_due(400 + 2 * NS_PER_S) == first
    session.note_reply(replace(REJECTED, emergency_stop=60), 400 + 2 * NS_PER_S)
    assert "emergency_stop" not in {due(session, number * NS_PER_S) for number in range(3, 10)}


def test_an_emergency_stop_that_is_seen_to_be_in_force_is_not_requested_again() -> None:
    """Where the vehicle's state tells of the stop its reply may be lost; one with an old number is raised at once."""
    session = driving()
    session.stop_now(Now(0, 60))
    session.note_reply(REJECTED, 300)
    request = session.request_due(300)
    assert request is not None
    assert (request.operation, request.number) == ("emergency_stop", 71)
    session.note_state(state("emergency_stop"), 400)
    assert (session.phase, session.next_wake_ns()) == ("stopped", None)


NOTED = SessionReply(True, "", 0, b"", 5600, "kernel", 0)
"""The answer to an ask, or to a release."""


def held_by(active_operator: str, safety: SafetyState = "driving", instance: int = 7) -> State:
    return replace(state(safety), active_operator=active_operator, active_operator_instance=instance)


def due(session: ClientSession, now_ns: int) -> str:
    request = session.request_due(now_ns)
    return "" if request is None else request.operation


def test_a_rejected_client_waits_and_asks_nobody() -> None:
    """Without `take_over` a client whose hold is refused only asks to hold, and says who holds the vehicle."""
    session = new_session()
    for second in range(3):
        assert due(session, 100 + second * NS_PER_S) == "hold"
        session.note_reply(REJECTED, 200 + second * NS_PER_S)
        assert due(session, 300 + second * NS_PER_S) == ""
        assert (session.phase, session.reason) == ("seeking", "held by bob")


def test_with_take_over_it_asks_for_what_somebody_holds() -> None:
    """With `take_over` a refused hold is followed by an ask at once, each second anew, until the vehicle is granted."""
    session = ClientSession("alice", 7, rearm=False, start_ns=0, take_over=True)
    for second in range(3):
        begin_ns = second * NS_PER_S
        assert due(session, begin_ns) == "hold"
        session.note_reply(REJECTED, begin_ns)
        assert due(session, begin_ns) == "ask"
        session.note_reply(NOTED, begin_ns)
        assert (session.phase, session.reason) == ("seeking", "held by bob; asked for it")
        assert due(session, begin_ns + NS_PER_S - 1) == ""
    assert due(session, 3 * NS_PER_S) == "hold"
    session.note_reply(GRANTED, 3 * NS_PER_S)
    assert (session.phase, session.reason) == ("arming", "")
    assert due(session, 4 * NS_PER_S) == "hold"


def test_an_ask_that_is_rejected_says_why() -> None:
    """Where somebody else asks already, both reasons are known, and stay while hold and ask go on in turn."""
    session = ClientSession("alice", 7, rearm=False, start_ns=0, take_over=True)
    assert due(session, 0) == "hold"
    session.note_reply(REJECTED, 0)
    assert due(session, 0) == "ask"
    session.note_reply(replace(REJECTED, reason="carol asks"), 0)
    assert session.reason == f"{REJECTED.reason}; carol asks"
    assert due(session, NS_PER_S) == "hold"
    session.note_reply(REJECTED, NS_PER_S)
    assert session.reason == f"{REJECTED.reason}; carol asks"


def test_release_is_repeated_until_it_is_answered() -> None:
    """A release ends commanding at once, is asked again each second, and its answer ends the session for good."""
    session = driving()
    session.release(1000)
    assert (session.phase, session.reason, session.commanding, session.holds) == ("watching", "released", False, False)
    assert due(session, 1000) == "release"
    assert due(session, 1000 + NS_PER_S - 1) == ""
    session.note_reply(GRANTED, 2000)  # to a hold that was on its way
    assert (session.released, session.phase) == (False, "watching")
    assert due(session, 1000 + NS_PER_S) == "release"
    session.note_reply(NOTED, 2 * NS_PER_S)
    assert (session.released, session.next_wake_ns()) == (True, None)
    session.note_state(held_by("", "safe_stop"), 3 * NS_PER_S)
    session.note_state(held_by("bob"), 4 * NS_PER_S)
    assert (session.phase, session.reason, due(session, 10 * NS_PER_S)) == ("watching", "released", "")


def test_a_released_vehicle_is_not_taken_again_by_rearm() -> None:
    """A client that arms again by itself after a stop does not do so after a release."""
    session = driving(rearm=True)
    session.release(1000)
    session.note_reply(NOTED, 2000)
    session.note_state(state("safe_stop", 0.0), 3000)
    assert (session.phase, due(session, NS_PER_S)) == ("watching", "")


@pytest.mark.parametrize("safety", ["disarmed", "safe_stop"])
def test_who_was_taken_over_does_not_take_it_back(safety: SafetyState) -> None:
    """When somebody else holds a vehicle that was this client's at standstill, it only watches from then on."""
    session = new_session(rearm=True)
    session.note_reply(GRANTED, 200)
    session.note_state(held_by("alice", "disarmed"), 300)
    session.note_state(held_by("bob", safety), 400)
    assert (session.phase, session.reason) == ("watching", "bob has taken the vehicle over")
    assert (session.holds, due(session, 10 * NS_PER_S)) == (False, "")


def test_another_client_of_the_same_name_is_somebody_else() -> None:
    """A twin that drives under this client's name is not this client: its drive does not count, nor is it undone."""
    session = new_session(rearm=True)
    session.note_reply(GRANTED, 200)
    session.note_state(held_by("alice", "driving", instance=8), 300)
    assert session.phase == "arming"
    session.note_state(held_by("alice", "disarmed"), 400)
    session.note_state(held_by("alice", "safe_stop", instance=8), 500)
    assert (session.phase, session.reason) == ("watching", "alice has taken the vehicle over")


def test_a_state_from_before_the_grant_says_nothing_about_it() -> None:
    """States that still name the holder before, also as driving, neither end a new session nor count as its drive."""
    session = new_session()
    session.note_reply(GRANTED, 200)
    session.note_state(held_by("bob", "driving"), 300)
    session.note_state(held_by("", "safe_stop"), 400)
    assert session.phase == "arming"
    session.note_state(held_by("alice", "arming"), 500)
    session.note_state(held_by("alice", "driving"), 600)
    assert (session.phase, session.holds) == ("driving", True)
