"""Who may command the vehicle."""

from __future__ import annotations

import pytest
from tests.control.rig import Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S, Operation, SessionRequest


def test_nobody_is_obeyed_before_somebody_holds_the_vehicle() -> None:
    """Without a holder no command is obeyed, not even one that guessed the epoch in force."""
    rig = Rig()
    rig.picture()
    for epoch in range(999, 1003):
        verdict = rig.send(epoch=epoch)
        assert (verdict.obeyed, verdict.reason) == (False, "not the epoch in force")
    assert rig.state == "disarmed"


def test_the_holder_gets_an_epoch_and_a_token() -> None:
    """Holding hands out the epoch to command under and the token that opens the path of the video."""
    reply = Rig().ask("hold")
    assert (reply.granted, reply.because) == (True, "")
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
    assert rig.drive().obeyed


@pytest.mark.parametrize("other", [("bob", 1), ("alice", 2)])
def test_a_second_client_is_refused_while_the_vehicle_is_armed_or_moves(other: tuple[str, int]) -> None:
    """While arming, driving, degraded, or still rolling in a stop, nobody else gets the vehicle, an epoch or a token.

    A client that was started anew is somebody else.
    """
    rig = Rig().hold()

    def refused() -> bool:
        reply = rig.gate.answer(SessionRequest("hold", *other, 0), rig.vehicle)
        return (reply.granted, reply.epoch, reply.token) == (False, 0, b"")

    rig.arm_for(NS_PER_S // 2)
    assert rig.state == "arming"
    assert refused()
    rig.arm_for(NS_PER_S // 2)
    assert rig.state == "driving"
    assert refused()
    rig.vehicle = vehicle_at(8.0)
    rig.go(300 * NS_PER_MS)
    assert rig.state == "degraded"
    assert refused()
    rig.go(200 * NS_PER_MS)
    assert rig.state == "safe_stop"
    assert refused()
    rig.vehicle = vehicle_at(0.0)
    assert not refused()


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
    assert rig.send(epoch=second.epoch).obeyed
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
    assert not rig.send().obeyed
    assert not rig.ask("release").granted


@pytest.mark.parametrize("operation", ["release", "clear_emergency_stop"])
def test_only_the_holder_changes_the_session(operation: Operation) -> None:
    """Release and clearing are refused to others, and to the holder's name under another instance."""
    rig = Rig().armed()
    for who, instance in (("bob", 1), ("alice", 2)):
        reply = rig.ask(operation, who, instance)
        assert not reply.granted
        assert reply.epoch == 0
    assert rig.state == "driving"


def test_whoever_stops_the_vehicle_does_not_get_to_drive_it() -> None:
    """The answer to a bystander's emergency stop has neither epoch nor token."""
    rig = Rig().driving()
    reply = rig.ask("emergency_stop", "bob", 9, number=5)
    assert reply.granted
    assert (reply.epoch, reply.token) == (0, b"")


def test_what_was_asked_is_counted() -> None:
    """Each operation is counted, granted and refused apart."""
    rig = Rig().armed()
    rig.ask("hold", "bob", 1)
    counts = rig.gate.counts
    assert (counts["session hold granted"], counts["session hold refused"]) == (1, 1)
