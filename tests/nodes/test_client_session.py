from __future__ import annotations

import pytest
from msgspec.structs import replace

from lavt.domain import NS_PER_S, Now, SafetyState, SessionReply, State
from lavt.nodes.client_session import RESTART_HINT, SAME_NAME, ClientSession
from lavt.safety.session import CLEARED_BEFORE, RELEASED_BEFORE
from lavt.safety.state_machine import TRIGGER_MESSAGES

GRANTED = SessionReply(
    granted=True, reason="", epoch=5, token=bytes(16), video_port=5600, host="kernel", emergency_stop=0
)
REJECTED = replace(GRANTED, granted=False, reason="bob has control", epoch=0, token=b"", emergency_stop=70)


def new_session(*, rearm: bool = False) -> ClientSession:
    return ClientSession("alice", 7, rearm=rearm, start_ns=100)


def test_commands_wait_for_the_network_condition() -> None:
    """With `waits_for_condition`, control is acquired, but commands wait until the network condition is in force."""
    session = ClientSession("alice", 7, rearm=False, start_ns=100, waits_for_condition=True)
    assert session.take_request(100) is not None
    session.handle_reply(GRANTED, 200)
    assert (session.phase, session.may_command) == ("arming", False)
    assert session.reason
    session.handle_condition("no tc")
    assert (session.reason, session.may_command) == ("no tc", False)
    session.handle_condition("")
    assert (session.reason, session.may_command) == ("", True)
    session.handle_condition("later")
    assert (session.reason, session.may_command) == ("", True)


def state(safety: SafetyState, speed_mps: float = 0.0) -> State:
    return State(1, 1, speed_mps, 0.0, "drive", safety, "reason", -1, "")


def driving_session(*, rearm: bool = False) -> ClientSession:
    session = new_session(rearm=rearm)
    session.handle_reply(GRANTED, 200)
    session.handle_state(state("driving"), 300)
    assert session.phase == "driving"
    return session


def test_control_is_requested_every_second_until_driving() -> None:
    """Control is requested at the start and every second until the vehicle drives, also after a rejection."""
    session = new_session()
    assert session.take_request(99) is None
    request = session.take_request(100)
    assert request is not None
    assert (request.operation, request.who, request.instance) == ("acquire", "alice", 7)
    assert session.take_request(100 + NS_PER_S - 1) is None
    session.handle_reply(REJECTED, 200)
    assert (session.phase, session.reason) == ("seeking", REJECTED.reason)
    assert not session.may_command
    assert not session.has_control
    assert session.take_request(100 + NS_PER_S) is not None
    session.handle_reply(GRANTED, NS_PER_S)
    assert (session.phase, session.epoch, session.host, session.may_command) == ("arming", 5, "kernel", True)
    session.handle_state(state("driving"), 300)
    assert session.next_wake_ns() is None
    assert session.take_request(10 * NS_PER_S) is None


def test_a_new_epoch_while_arming() -> None:
    """A new epoch during arming replaces the old one."""
    session = new_session()
    session.handle_reply(GRANTED, 200)
    session.handle_reply(replace(GRANTED, epoch=6), 300)
    assert session.epoch == 6


def test_a_grant_without_an_epoch_changes_nothing() -> None:
    """A granted reply without an epoch, as to an emergency stop, does not change control."""
    session = new_session()
    session.handle_reply(replace(GRANTED, epoch=0, token=b"", emergency_stop=3), 200)
    assert (session.phase, session.may_command) == ("seeking", False)
    session = driving_session()
    session.handle_reply(replace(GRANTED, epoch=0, token=b"", emergency_stop=3), 200)
    assert session.epoch == 5


@pytest.mark.parametrize("safety", ["disarmed", "safe_stop", "emergency_stop"])
def test_a_stopped_vehicle_stays_stopped(safety: SafetyState) -> None:
    """After a stop the client sends neither commands nor requests."""
    session = driving_session()
    session.handle_state(state("degraded"), 400)
    assert session.phase == "driving"
    session.handle_state(state(safety), 500)
    assert (session.phase, session.may_command, session.reason) == (
        "stopped",
        False,
        "reason; restart this client to drive",
    )
    session.handle_state(state(safety), 600)
    assert session.take_request(10 * NS_PER_S) is None


def test_rearm_requests_control_again_at_standstill() -> None:
    """With `rearm`, control is requested again once the stopped vehicle is stationary."""
    session = driving_session(rearm=True)
    session.handle_state(state("safe_stop", 3.0), 500)
    session.handle_state(state("safe_stop", 2.0), 600)
    assert (session.reason, session.next_wake_ns()) == ("reason", None)
    session.handle_state(state("safe_stop", 0.0), 700)
    assert session.phase == "seeking"
    assert session.take_request(700) is not None


@pytest.mark.parametrize("stopped", [False, True])
def test_rearm_respects_a_driver_override(stopped: bool) -> None:
    """After a driver override, `rearm` does not request control again, not even after a restart of the server."""
    session = driving_session(rearm=True)
    if stopped:
        session.handle_state(state("safe_stop", 3.0), 500)
    session.handle_state(state("disarmed", 3.0), 600)
    session.handle_state(state("disarmed"), 700)
    session.handle_state(replace(state("disarmed"), instance=2), 800)
    assert (session.phase, session.take_request(10 * NS_PER_S)) == ("stopped", None)


@pytest.mark.parametrize("stopped", [False, True])
def test_rearm_requests_control_from_a_restarted_server(stopped: bool) -> None:
    """With `rearm`, control is requested from a restarted server, whose vehicle is disarmed without an override."""
    session = driving_session(rearm=True)
    if stopped:
        session.handle_state(state("safe_stop", 3.0), 500)
    session.handle_state(replace(state("disarmed"), instance=2), 600)
    session.handle_state(replace(state("disarmed"), instance=2), 700)
    assert session.phase == "seeking"
    assert session.take_request(700) is not None


@pytest.mark.parametrize("rearm", [False, True])
def test_two_servers_of_one_name_await_a_person(rearm: bool) -> None:
    """If the states of two servers alternate, the client stops and does not arm, even with `rearm`."""
    session = driving_session(rearm=rearm)
    for time_ns in range(500, 900, 100):
        session.handle_state(replace(state("disarmed"), instance=2), time_ns)
        session.handle_state(state("driving", 5.0), time_ns + 50)
    assert (session.phase, session.reason) == ("stopped", SAME_NAME + RESTART_HINT)
    session.handle_state(state("safe_stop"), 1000)
    session.handle_reply(GRANTED, 1100)
    assert (session.phase, session.may_command, session.take_request(10 * NS_PER_S)) == ("stopped", False, None)


@pytest.mark.parametrize("servers", [2, 3, 8])
def test_a_client_that_waits_for_one_of_several_servers_does_not_arm(servers: int) -> None:
    """A client that sees several servers of one name in turns, before it drives, does not arm any of them."""
    session = new_session()
    for time_ns, instance in enumerate((*range(1, servers + 1), 1)):
        session.handle_reply(GRANTED, time_ns)
        session.handle_state(replace(state("disarmed"), instance=instance), time_ns)
    assert (session.phase, session.reason) == ("stopped", SAME_NAME + RESTART_HINT)


def test_a_stop_of_two_servers_is_the_last_reason() -> None:
    """After an emergency stop of two servers of one name, the reason does not alternate between stop and name."""
    session = new_session()
    for instance in (1, 2, 1):
        session.handle_state(replace(state("disarmed"), instance=instance), 100)
    for instance in (2, 1, 2, 1):
        session.handle_state(replace(state("emergency_stop"), instance=instance), 200)
        assert session.reason == "reason" + RESTART_HINT


def test_a_server_that_restarts_twice_is_one_server() -> None:
    """Restarts of one server, each with a new instance, do not count as several servers."""
    session = driving_session(rearm=True)
    for instance in (2, 3, 4):
        session.handle_state(replace(state("disarmed"), instance=instance), 500)
        session.handle_state(replace(state("disarmed"), instance=instance), 600)
    assert session.phase == "seeking"


def test_an_emergency_stop_has_a_new_number() -> None:
    """The number of an emergency stop is the wall clock's time, at least one more than that of the client's last one.

    The number of the vehicle's last stop does not matter.
    """
    session = new_session()
    session.handle_reply(REJECTED, 200)
    request = session.raise_emergency_stop(Now(0, 60))
    assert (request.operation, request.number, session.emergency_stop) == ("emergency_stop", 60, 60)
    assert session.raise_emergency_stop(Now(0, 1000)).number == 1000
    assert session.raise_emergency_stop(Now(0, 1000)).number == 1001


@pytest.mark.parametrize("released", [False, True])
def test_an_emergency_stop_is_repeated_until_answered(released: bool) -> None:
    """An emergency stop is requested every second until the vehicle answers, also without control."""
    session = new_session()
    if released:
        session.handle_reply(GRANTED, 200)
        session.release(300)
    first = session.raise_emergency_stop(Now(400, 60))
    earlier_operations = {take_operation(session, 400), take_operation(session, 400 + NS_PER_S - 1)}
    assert earlier_operations <= {"acquire", "release", ""}
    assert session.next_wake_ns() == 400 + NS_PER_S
    assert session.take_request(400 + NS_PER_S) == first
    assert session.take_request(400 + 2 * NS_PER_S) == first
    session.handle_reply(replace(NOTED, emergency_stop=60), 400 + 2 * NS_PER_S)
    assert "emergency_stop" not in {take_operation(session, number * NS_PER_S) for number in range(3, 10)}


def test_a_state_does_not_end_the_repetition_of_a_stop() -> None:
    """An emergency stop is repeated although a state reports one, which may be an earlier one."""
    session = driving_session()
    first = session.raise_emergency_stop(Now(0, 60))
    session.handle_state(state("emergency_stop"), 400)
    assert session.take_request(NS_PER_S) == first
    session.handle_reply(replace(GRANTED, emergency_stop=60), NS_PER_S)
    assert (session.phase, session.next_wake_ns()) == ("stopped", None)


STOPPED = replace(GRANTED, emergency_stop=70)
"""The first reply, while the vehicle's last emergency stop is number 70."""


def clearing_session() -> ClientSession:
    """Return a session that is to clear the emergency stop 70, and has control."""
    session = ClientSession("alice", 7, rearm=True, start_ns=100, clear_stop=True)
    session.handle_reply(STOPPED, 200)
    session.handle_state(state("emergency_stop"), 300)
    return session


def test_the_emergency_stop_of_the_first_reply_is_cleared() -> None:
    """With `clear_stop`, the emergency stop of the first reply is cleared, also if its client has no control yet."""
    session = ClientSession("alice", 7, rearm=False, start_ns=100, clear_stop=True)
    session.handle_reply(REJECTED, 200)
    session.handle_reply(STOPPED, 300)
    session.handle_state(state("emergency_stop"), 300)
    request = session.take_request(NS_PER_S)
    assert request is not None
    assert (request.operation, request.number) == ("clear_emergency_stop", 70)


def test_another_emergency_stop_is_not_cleared() -> None:
    """A client with `clear_stop` clears no later stop: neither somebody's, nor one while it waits, nor its own."""
    later = clearing_session()
    later.handle_reply(replace(REJECTED, emergency_stop=71), 400)
    while_waiting = ClientSession("alice", 7, rearm=False, start_ns=100, clear_stop=True)
    while_waiting.handle_reply(REJECTED, 200)
    while_waiting.handle_reply(replace(GRANTED, emergency_stop=71), 300)
    while_waiting.handle_state(state("emergency_stop"), 400)
    own = clearing_session()
    stop = own.raise_emergency_stop(Now(400, 60))
    own.handle_reply(replace(GRANTED, emergency_stop=stop.number), 500)
    after_driving = clearing_session()
    after_driving.handle_state(state("driving"), 400)
    after_driving.handle_state(state("emergency_stop"), 500)
    none_at_first = ClientSession("alice", 7, rearm=False, start_ns=100, clear_stop=True)
    none_at_first.handle_reply(GRANTED, 200)
    none_at_first.handle_state(state("emergency_stop"), 300)  # of number 0, which stands for no stop in replies
    for session in (later, while_waiting, own, after_driving, none_at_first):
        operations = {take_operation(session, number * NS_PER_S) for number in range(1, 10)}
        assert "clear_emergency_stop" not in operations


@pytest.mark.parametrize("restarted", [False, True])
def test_rearm_does_not_follow_an_emergency_stop(restarted: bool) -> None:
    """After an emergency stop, `rearm` requests no control, even if the stop is cleared or the server restarted."""
    session = driving_session(rearm=True)
    session.handle_state(state("emergency_stop", 3.0), 500)
    session.handle_state(state("emergency_stop"), 600)
    session.handle_state(replace(state("disarmed"), instance=2 if restarted else 0), 700)
    assert (session.phase, session.take_request(10 * NS_PER_S)) == ("stopped", None)


@pytest.mark.parametrize("rearm", [False, True])
@pytest.mark.parametrize("has_control", [False, True])
@pytest.mark.parametrize("restarted", [False, True])
def test_a_waiting_client_does_not_arm_after_an_emergency_stop(rearm: bool, has_control: bool, restarted: bool) -> None:
    """After an emergency stop, a client that waits or arms does not drive, even if the server restarts."""
    session = new_session(rearm=rearm)
    session.handle_reply(GRANTED if has_control else replace(REJECTED, emergency_stop=0), 200)
    session.handle_state(state("emergency_stop"), 300)
    session.handle_state(replace(state("disarmed"), instance=2 if restarted else 0), 400)
    assert (session.phase, session.may_command, session.take_request(10 * NS_PER_S)) == ("stopped", False, None)


@pytest.mark.parametrize("rearm", [False, True])
@pytest.mark.parametrize("before", ["arming", "driving", "safe_stop"])
@pytest.mark.parametrize("has_control", [False, True])
def test_a_waiting_client_does_not_arm_after_a_driver_override(
    rearm: bool, before: SafetyState, has_control: bool
) -> None:
    """If the driver in the car takes over, a client that waits or arms does not arm the vehicle any more."""
    override = replace(state("disarmed"), reason=TRIGGER_MESSAGES["driver override"])
    session = new_session(rearm=rearm)
    if has_control:
        session.handle_reply(GRANTED, 200)
    session.handle_state(replace(state(before), active_operator="" if has_control else "bob"), 300)
    session.handle_state(override, 400)
    session.handle_state(state("disarmed"), 500)
    assert (session.phase, session.may_command, session.take_request(10 * NS_PER_S)) == ("stopped", False, None)


@pytest.mark.parametrize("instance", [0, 2])
@pytest.mark.parametrize("rearm", [False, True])
def test_a_driver_override_between_lost_states_is_noticed(instance: int, rearm: bool) -> None:
    """An override is noticed if no state since arming began arrived, or none of a restarted server before it."""
    session = new_session(rearm=rearm)
    session.handle_state(state("disarmed"), 150)
    session.handle_reply(GRANTED, 200)
    override = replace(state("disarmed"), reason=TRIGGER_MESSAGES["driver override"], instance=instance)
    session.handle_state(override, 300)
    session.handle_state(override, 320)
    assert (session.phase, session.may_command, session.take_request(10 * NS_PER_S)) == ("stopped", False, None)


def test_the_reason_of_a_stop_remains() -> None:
    """A reply to an earlier request does not replace the reason why a client stopped."""
    session = driving_session()
    session.handle_state(state("emergency_stop"), 400)
    session.handle_reply(GRANTED, 500)
    assert session.reason == "reason; restart this client to drive"


def test_a_restart_during_a_second_stop_awaits_a_person() -> None:
    """With `clear_stop`, a restart of the server in an emergency stop awaits a person: it can be another stop."""
    session = clearing_session()
    session.handle_state(replace(state("disarmed"), instance=2), 400)
    session.handle_reply(GRANTED, 500)
    assert (session.phase, session.may_command) == ("stopped", False)


def test_a_new_client_arms_after_an_earlier_driver_override() -> None:
    """An override before this client started does not keep it from arming: a person has started it."""
    session = new_session()
    session.handle_state(replace(state("disarmed"), reason=TRIGGER_MESSAGES["driver override"]), 150)
    session.handle_reply(GRANTED, 200)
    session.handle_state(replace(state("disarmed"), reason=TRIGGER_MESSAGES["driver override"]), 300)
    assert (session.phase, session.may_command) == ("arming", True)


def test_a_client_that_is_to_clear_a_stop_does_not_arm_after_a_later_one() -> None:
    """With `clear_stop`, a stop after the one to be cleared awaits a person, even if the server restarts at once."""
    for seen_between in ("driving", "disarmed"):
        session = ClientSession("alice", 7, rearm=False, start_ns=100, clear_stop=True)
        session.handle_reply(STOPPED, 200)
        session.handle_state(replace(state(seen_between), active_operator="bob"), 300)
        session.handle_state(state("emergency_stop"), 400)
        assert session.phase == "stopped"
        session.handle_state(replace(state("disarmed"), instance=2), 500)
        session.handle_reply(GRANTED, 600)
        assert (session.phase, session.may_command) == ("stopped", False)


def test_a_stop_that_a_restarted_server_has_forgotten_is_not_cleared() -> None:
    """With `clear_stop`, a stop before the first reply awaits a person if the reply of a new server names none."""
    session = ClientSession("alice", 7, rearm=False, start_ns=100, clear_stop=True)
    session.handle_state(state("emergency_stop"), 150)
    session.handle_state(replace(state("disarmed"), instance=2), 200)
    session.handle_reply(GRANTED, 300)
    assert (session.phase, session.may_command) == ("stopped", False)


def test_a_client_that_is_to_clear_a_stop_acquires_control_again() -> None:
    """While the stop lasts, requests to clear it and requests for control alternate, because control may be lost."""
    session = clearing_session()
    operations = [take_operation(session, second * NS_PER_S) for second in range(1, 5)]
    assert operations == ["clear_emergency_stop", "acquire", "clear_emergency_stop", "acquire"]


@pytest.mark.parametrize("phase", ["stopped", "seeking"])
def test_rearm_takes_no_control_back(phase: str) -> None:
    """With `rearm`, a client whose control went to another one while it received no states only watches."""
    session = driving_session(rearm=True)
    session.handle_state(state_with_operator("alice", "driving"), 310)
    session.handle_state(replace(state_with_operator("alice", "safe_stop"), speed_mps=3.0), 400)
    if phase == "seeking":
        session.handle_state(state_with_operator("alice", "safe_stop"), 450)
    assert session.phase == phase
    session.handle_state(state_with_operator("bob", "safe_stop"), 500)
    assert (session.phase, session.take_request(10 * NS_PER_S)) == ("watching", None)


def test_an_own_emergency_stop_that_was_cleared_before_its_reply_is_repeated() -> None:
    """If the reply to a stop was lost and somebody has cleared the stop, another stop follows."""
    session = driving_session()
    stop = session.raise_emergency_stop(Now(400, 60))
    session.handle_state(state("emergency_stop"), 500)
    session.handle_state(state("disarmed"), 600)
    session.handle_reply(replace(REJECTED, reason=CLEARED_BEFORE, emergency_stop=stop.number), 700)
    repeated = session.take_request(400 + NS_PER_S)
    assert repeated is not None
    assert (repeated.operation, repeated.number) == ("emergency_stop", stop.number + 1)


def test_another_rejection_confirms_no_release() -> None:
    """After a release, a rejection of an earlier request does not confirm it; that of a repeated release does."""
    session = driving_session()
    session.release(1000)
    session.handle_reply(replace(REJECTED, reason="the vehicle is not stationary yet"), 1100)
    assert not session.released
    session.handle_reply(replace(REJECTED, reason=RELEASED_BEFORE), 1200)
    assert session.released


def test_an_emergency_stop_that_no_state_reported_is_noticed() -> None:
    """A reply with another number than before tells of an emergency stop, which may have been cleared since."""
    session = driving_session(rearm=True)
    session.handle_state(state("safe_stop"), 400)
    session.handle_state(state("safe_stop"), 410)
    assert session.phase == "seeking"
    session.handle_reply(replace(REJECTED, emergency_stop=71), 500)
    session.handle_state(state("disarmed"), 600)
    assert (session.phase, session.take_request(10 * NS_PER_S)) == ("stopped", None)


NOTED = replace(GRANTED, epoch=0, token=b"")
"""The reply to a handover request or a release."""


def state_with_operator(active_operator: str, safety: SafetyState = "driving", instance: int = 7) -> State:
    return replace(state(safety), active_operator=active_operator, active_operator_instance=instance)


def take_operation(session: ClientSession, now_ns: int) -> str:
    """Take the request that is due at this time, and return its operation; without a request, return ""."""
    request = session.take_request(now_ns)
    return "" if request is None else request.operation


def test_without_take_over_no_handover_is_requested() -> None:
    """Without `take_over`, a rejected client only repeats its request for control."""
    session = new_session()
    for second in range(3):
        assert take_operation(session, 100 + second * NS_PER_S) == "acquire"
        session.handle_reply(REJECTED, 200 + second * NS_PER_S)
        assert take_operation(session, 300 + second * NS_PER_S) == ""
        assert (session.phase, session.reason) == ("seeking", REJECTED.reason)


def test_take_over_requests_a_handover() -> None:
    """With `take_over`, each rejected request for control is followed by a handover request."""
    session = ClientSession("alice", 7, rearm=False, start_ns=0, take_over=True)
    for second in range(3):
        begin_ns = second * NS_PER_S
        assert take_operation(session, begin_ns) == "acquire"
        session.handle_reply(REJECTED, begin_ns)
        assert take_operation(session, begin_ns) == "request_handover"
        session.handle_reply(NOTED, begin_ns)
        assert (session.phase, session.reason) == ("seeking", f"{REJECTED.reason}; handover requested")
        assert take_operation(session, begin_ns + NS_PER_S - 1) == ""
    assert take_operation(session, 3 * NS_PER_S) == "acquire"
    session.handle_reply(GRANTED, 3 * NS_PER_S)
    assert (session.phase, session.reason) == ("arming", "")
    assert take_operation(session, 4 * NS_PER_S) == "acquire"


def test_both_rejection_reasons_are_shown() -> None:
    """The reasons of a rejected acquisition and a rejected handover request are both shown."""
    session = ClientSession("alice", 7, rearm=False, start_ns=0, take_over=True)
    assert take_operation(session, 0) == "acquire"
    session.handle_reply(REJECTED, 0)
    assert take_operation(session, 0) == "request_handover"
    session.handle_reply(replace(REJECTED, reason="carol asks"), 0)
    assert session.reason == f"{REJECTED.reason}; carol asks"
    assert take_operation(session, NS_PER_S) == "acquire"
    session.handle_reply(REJECTED, NS_PER_S)
    assert session.reason == f"{REJECTED.reason}; carol asks"


def test_a_release_is_repeated_until_answered() -> None:
    """A release ends commands at once and is repeated every second until it is answered."""
    session = driving_session()
    session.release(1000)
    assert (session.phase, session.reason, session.may_command, session.has_control) == (
        "watching",
        "released",
        False,
        False,
    )
    assert take_operation(session, 1000) == "release"
    assert take_operation(session, 1000 + NS_PER_S - 1) == ""
    session.handle_reply(GRANTED, 2000)  # the reply to an earlier request for control
    assert (session.released, session.phase) == (False, "watching")
    assert take_operation(session, 1000 + NS_PER_S) == "release"
    session.handle_reply(NOTED, 2 * NS_PER_S)
    assert (session.released, session.next_wake_ns()) == (True, None)
    session.handle_state(state_with_operator("", "safe_stop"), 3 * NS_PER_S)
    session.handle_state(state_with_operator("bob"), 4 * NS_PER_S)
    assert (session.phase, session.reason, take_operation(session, 10 * NS_PER_S)) == ("watching", "released", "")


def test_rearm_respects_a_release() -> None:
    """`rearm` does not request control again after a release."""
    session = driving_session(rearm=True)
    session.release(1000)
    session.handle_reply(NOTED, 2000)
    session.handle_state(state("safe_stop", 0.0), 3000)
    assert (session.phase, take_operation(session, NS_PER_S)) == ("watching", "")


@pytest.mark.parametrize("safety", ["disarmed", "safe_stop"])
def test_lost_control_is_not_taken_back(safety: SafetyState) -> None:
    """Even with `rearm`, a client that lost control to another client at standstill does not request it again."""
    session = new_session(rearm=True)
    session.handle_reply(GRANTED, 200)
    session.handle_state(state_with_operator("alice", "disarmed"), 300)
    session.handle_state(state_with_operator("bob", safety), 400)
    assert session.phase == "watching"
    assert "bob" in session.reason
    assert (session.has_control, take_operation(session, 10 * NS_PER_S)) == (False, "")


def test_another_instance_of_the_same_name_is_another_client() -> None:
    """A client with the same name but another instance is another client."""
    session = new_session(rearm=True)
    session.handle_reply(GRANTED, 200)
    session.handle_state(state_with_operator("alice", "driving", instance=8), 300)
    assert session.phase == "arming"
    session.handle_state(state_with_operator("alice", "disarmed"), 400)
    session.handle_state(state_with_operator("alice", "safe_stop", instance=8), 500)
    assert (session.phase, session.has_control) == ("watching", False)


def test_a_state_from_before_the_grant_has_no_effect() -> None:
    """States from before the grant, which name the previous operator, do not affect the session."""
    session = new_session()
    session.handle_reply(GRANTED, 200)
    session.handle_state(state_with_operator("bob", "driving"), 300)
    session.handle_state(state_with_operator("", "safe_stop"), 400)
    assert session.phase == "arming"
    session.handle_state(state_with_operator("alice", "arming"), 500)
    session.handle_state(state_with_operator("alice", "driving"), 600)
    assert (session.phase, session.has_control) == ("driving", True)
