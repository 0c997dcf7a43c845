"""Who may command the vehicle."""

from __future__ import annotations

import pytest
from tests.safety.rig import TICK_NS, Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S, Operation, SessionRequest
from lavt.safety.limits import LIMITS


def test_nobody_is_accepted_before_somebody_holds_the_vehicle() -> None:
    """Without a holder no command is obeyed, not even one that guessed the epoch in force."""
    rig = Rig()
    rig.picture()
    for epoch in range(999, 1003):
        verdict = rig.send(epoch=epoch)
        assert (verdict.accepted, verdict.reason) == (False, "not the epoch in force")
    assert rig.state == "disarmed"


def test_what_is_in_force_is_known_from_the_start() -> None:
    """Epoch and last accepted sequence can be read before the first session; a new epoch has no sequence yet."""
    rig = Rig()
    before, sequence = rig.gate.in_force
    assert sequence == -1
    rig.hold()
    assert rig.gate.in_force == (rig.epoch, -1)
    assert rig.epoch != before
    rig.picture()
    assert rig.send().accepted
    assert rig.gate.in_force == (rig.epoch, rig.sequence)
    rig.ask("release")
    assert rig.gate.in_force[0] not in (before, rig.epoch)
    assert rig.gate.in_force[1] == -1


def test_the_active_operator_gets_an_epoch_and_a_token() -> None:
    """Holding hands out the epoch to command under and the token that opens the path of the video."""
    reply = Rig().ask("hold")
    assert (reply.granted, reply.reason) == (True, "")
    assert reply.epoch != 0
    assert len(reply.token) == 16
    assert (reply.video_port, reply.host, reply.emergency_stop) == (5600, "bench", 0)


def test_asking_again_changes_nothing() -> None:
    """The same instance asking again, also while it drives, gets the same epoch and token and goes on driving."""
    rig = Rig()
    first = rig.ask("hold")
    assert rig.ask("hold") == first
    rig.arm_for(NS_PER_S)
    assert rig.ask("hold") == first
    assert rig.state == "driving"
    rig.picture()
    assert rig.drive().accepted


@pytest.mark.parametrize("other", [("bob", 1), ("alice", 2)])
def test_a_second_client_is_rejected_while_the_vehicle_is_armed_or_moves(other: tuple[str, int]) -> None:
    """While arming, driving, degraded, or still rolling in a stop, nobody else gets the vehicle, an epoch or a token.

    A client that was started anew is somebody else.
    """
    rig = Rig().hold()

    def rejected() -> bool:
        reply = rig.gate.answer(SessionRequest("hold", *other, 0), rig.vehicle, rig.now_ns)
        return (reply.granted, reply.epoch, reply.token) == (False, 0, b"")

    rig.arm_for(NS_PER_S // 2)
    assert rig.state == "arming"
    assert rejected()
    rig.arm_for(NS_PER_S // 2)
    assert rig.state == "driving"
    assert rejected()
    rig.vehicle = vehicle_at(8.0)
    rig.go(300 * NS_PER_MS)
    assert rig.state == "degraded"
    assert rejected()
    rig.go(200 * NS_PER_MS)
    assert rig.state == "safe_stop"
    assert rejected()
    rig.vehicle = vehicle_at(0.0)
    assert not rejected()


def test_take_over_at_standstill_ends_the_first_ones_epoch() -> None:
    """At standstill and disarmed another client takes over: new epoch, new token, the first is no longer obeyed."""
    rig = Rig()
    first = rig.ask("hold")
    second = rig.ask("hold", "bob", 7)
    assert second.granted
    assert second.epoch != first.epoch
    assert second.token != first.token
    rig.picture()
    assert rig.send().reason == "not the epoch in force"
    assert rig.send(epoch=second.epoch).accepted
    assert not rig.ask("release").granted


def test_release_gives_the_vehicle_up_and_stops_it() -> None:
    """Released while driving it stops for safety, obeys nothing more, and is free for whoever comes."""
    rig = Rig().driving()
    rig.vehicle = vehicle_at(5.0)
    assert rig.ask("release").granted
    assert rig.state == "safe_stop"
    rig.picture()
    assert rig.drive().reason == "not the epoch in force"
    assert rig.ask("hold", "bob", 1).granted


def test_release_hands_out_nothing() -> None:
    """The answer to a release has neither epoch nor token, and nothing is obeyed after it."""
    rig = Rig().hold()
    reply = rig.ask("release")
    assert (reply.granted, reply.epoch, reply.token) == (True, 0, b"")
    rig.picture()
    assert not rig.send().accepted
    assert not rig.ask("release").granted


@pytest.mark.parametrize("operation", ["release", "clear_emergency_stop"])
def test_only_the_active_operator_changes_the_session(operation: Operation) -> None:
    """Release and clearing are refused to others, and to the holder's name under another instance."""
    rig = Rig().armed()
    for who, instance in (("bob", 1), ("alice", 2)):
        reply = rig.ask(operation, who, instance)
        assert not reply.granted
        assert isinstance(reply.reason, str)
        assert reply.reason != ""
        assert reply.epoch == 0
    assert rig.state == "driving"


def test_whoever_stops_the_vehicle_does_not_get_to_drive_it() -> None:
    """The answer to a bystander's emergency stop has neither epoch nor token."""
    rig = Rig().driving()
    reply = rig.ask("emergency_stop", "bob", 9, number=5)
    assert reply.granted
    assert (reply.epoch, reply.token) == (0, b"")


def test_what_was_requested_is_counted() -> None:
    """Each operation is counted, granted and refused apart."""
    rig = Rig().armed()
    rig.ask("hold", "bob", 1)
    counts = rig.gate.counts
    assert (counts["session hold granted"], counts["session hold refused"]) == (1, 1)


def requested_by(rig: Rig) -> str:
    return rig.gate.claims.requested_by(rig.now_ns)


def test_who_asks_is_told_to_the_active_operator_and_changes_nothing_else() -> None:
    """An ask is granted without epoch or token, named for whoever holds the vehicle, and the drive goes on."""
    rig = Rig().driving()
    reply = rig.ask("ask", "bob", 7)
    assert (reply.granted, reply.epoch, reply.token) == (True, 0, b"")
    assert requested_by(rig) == "bob"
    rig.picture()
    assert rig.drive().accepted
    assert rig.gate.active_operator == ("alice", 1)


def test_without_consent_a_driven_vehicle_is_not_handed_over() -> None:
    """Asking alone, for however long, gives nobody a vehicle that is driven."""
    rig = Rig().driving()
    for _ in range(5):
        rig.ask("ask", "bob", 7)
        reply = rig.ask("hold", "bob", 7)
        assert (reply.granted, reply.reason) == (
            False, "held by alice, and the vehicle is not disarmed at standstill",
        )  # fmt: skip
        for _ in range(50):
            rig.go(TICK_NS)
            rig.picture()
            assert rig.drive().accepted


def test_with_consent_the_vehicle_stops_and_goes_to_who_requested() -> None:
    """A release while somebody asks stops the vehicle, keeps it from all others, and who asked gets it at once."""
    rig = Rig().driving()
    rig.vehicle = vehicle_at(5.0)
    rig.ask("ask", "bob", 7)
    assert rig.ask("release").granted
    assert (rig.state, rig.gate.active_operator, requested_by(rig)) == ("safe_stop", None, "")
    for who, instance in (("carol", 1), ("alice", 1), ("bob", 8)):
        reply = rig.ask("hold", who, instance)
        assert (reply.granted, reply.reason) == (False, "handed over to bob, who has not taken it yet")
    assert rig.ask("hold", "bob", 7).epoch != 0
    rig.vehicle = vehicle_at(0.0)
    assert rig.ask("hold", "carol").granted


def test_a_new_active_operator_arms_at_standstill() -> None:
    """Who took over a rolling vehicle arms it like anybody: not before it stands, and then for a second."""
    rig = Rig().driving()
    rig.vehicle = vehicle_at(5.0)
    rig.ask("ask", "bob", 7)
    rig.ask("release")
    rig.epoch = rig.ask("hold", "bob", 7).epoch
    rig.picture()
    assert rig.send().reason == "arming needs standstill"
    rig.vehicle = vehicle_at(0.0)
    rig.arm_for(NS_PER_S - TICK_NS)
    assert rig.state == "arming"
    rig.arm_for(TICK_NS)
    assert rig.state == "driving"


def test_what_is_kept_for_who_requested_becomes_free() -> None:
    """Who asked and then does not come has the vehicle kept for 5 s, and no longer."""
    rig = Rig().driving()
    rig.ask("ask", "bob", 7)
    rig.ask("release")
    rig.go(LIMITS.kept_ns - 1)
    assert not rig.ask("hold", "carol").granted
    rig.go(1)
    assert rig.ask("hold", "carol").granted
    assert LIMITS.kept_ns == 5 * NS_PER_S


def test_an_ask_lapses() -> None:
    """Who has not asked for 3 s does not ask any more, and a release then keeps the vehicle for nobody."""
    rig = Rig().driving()
    rig.ask("ask", "bob", 7)
    rig.go(LIMITS.handover_request_timeout_ns - 1)
    assert requested_by(rig) == "bob"
    rig.ask("ask", "bob", 7)
    rig.go(LIMITS.handover_request_timeout_ns - 1)
    assert requested_by(rig) == "bob"
    rig.go(1)
    assert requested_by(rig) == ""
    rig.ask("release")
    assert rig.ask("hold", "carol").granted
    assert LIMITS.handover_request_timeout_ns == 3 * NS_PER_S


def test_the_first_who_asks_comes_first() -> None:
    """While somebody asks, another is refused with that one's name; once the ask has lapsed the other may."""
    rig = Rig().driving()
    rig.ask("ask", "bob", 7)
    for who, instance in (("carol", 1), ("bob", 8)):
        reply = rig.ask("ask", who, instance)
        assert (reply.granted, reply.reason) == (False, "bob asks for it already")
    rig.go(LIMITS.handover_request_timeout_ns)
    assert rig.ask("ask", "carol").granted
    assert requested_by(rig) == "carol"


def test_asking_is_for_what_somebody_else_holds() -> None:
    """The holder, and anybody while nobody holds the vehicle, is refused with the reason."""
    rig = Rig()
    assert rig.ask("ask").reason == "nobody holds the vehicle"
    rig.hold()
    rejected = rig.ask("ask")
    assert rejected.reason == "you hold the vehicle"
    assert (rejected.granted, rejected.epoch, rejected.token) == (False, 0, b"")
    assert requested_by(rig) == ""


def test_at_rest_no_consent_is_needed() -> None:
    """At standstill and disarmed another gets the vehicle also while a third one asks, whose ask is over then."""
    rig = Rig().hold()
    rig.ask("ask", "bob", 7)
    assert rig.ask("hold", "carol").granted
    assert requested_by(rig) == ""


def test_an_emergency_stop_by_another_is_named_and_leaves_the_session_as_it_is() -> None:
    """Anybody stops the vehicle, also who asks for it; the state says who did, and the holder stays the holder."""
    rig = Rig().driving()
    rig.ask("ask", "bob", 7)
    assert rig.ask("emergency_stop", "bob", 7, number=5).granted
    assert (rig.state, rig.gate.reason) == ("emergency_stop", "emergency stop by bob")
    assert (rig.gate.active_operator, requested_by(rig)) == (("alice", 1), "bob")
    rig.ask("emergency_stop", "carol", 1, number=5)
    assert rig.gate.reason == "emergency stop by bob"


def test_a_server_that_ends_stops_the_vehicle_for_good() -> None:
    """When the server is about to end the vehicle stops, its holder is obeyed no more, and nobody gets it."""
    rig = Rig().driving()
    rig.vehicle = vehicle_at(5.0)
    rig.gate.end()
    assert (rig.state, rig.gate.reason, rig.gate.active_operator) == ("safe_stop", "the server was told to end", None)
    rig.picture()
    assert rig.drive().reason == "not the epoch in force"
    rig.vehicle = vehicle_at(0.0)
    assert rig.ask("hold", "bob").reason == "the server is about to end"
