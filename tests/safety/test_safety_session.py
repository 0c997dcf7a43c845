"""Control of the vehicle: acquire, hand over, release."""

from __future__ import annotations

import pytest
from tests.safety.rig import COMMAND_PERIOD_NS, Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S, Operation, SessionRequest
from lavt.safety.gate import RejectionReason
from lavt.safety.limits import LIMITS


def test_without_an_operator_every_command_is_rejected() -> None:
    """While no client has control, every command is rejected, even with the present epoch."""
    rig = Rig()
    rig.take_picture()
    for epoch in range(999, 1003):
        verdict = rig.send(epoch=epoch)
        assert (verdict.accepted, verdict.reason) == (False, RejectionReason.WRONG_EPOCH)
    assert rig.state == "disarmed"


def test_epoch_and_sequence_are_always_known() -> None:
    """Epoch and last accepted sequence number are known at any time; a new epoch has no sequence yet."""
    rig = Rig()
    before, sequence = rig.gate.in_force()
    assert sequence == -1
    rig.acquire()
    assert rig.gate.in_force() == (rig.epoch, -1)
    assert rig.epoch != before
    rig.take_picture()
    assert rig.send().accepted
    assert rig.gate.in_force() == (rig.epoch, rig.sequence)
    rig.request("release")
    assert rig.gate.in_force()[0] not in (before, rig.epoch)
    assert rig.gate.in_force()[1] == -1


def test_the_active_operator_gets_an_epoch_and_a_token() -> None:
    """A client that acquires control gets an epoch for commands and a token for the video path."""
    reply = Rig().request("acquire")
    assert (reply.granted, reply.reason) == (True, "")
    assert reply.epoch != 0
    assert len(reply.token) == 16
    assert (reply.video_port, reply.host, reply.emergency_stop) == (5600, "bench", 0)


def test_a_run_is_reserved_for_one_operator() -> None:
    """With an only operator, no other one gets control, not even by a handover, but every one can stop the vehicle."""
    rig = Rig(only_operator="alice")
    assert not rig.request("acquire", "bob").granted
    rig.acquire()
    rig.request("request_handover", "bob")
    rig.request("release")
    assert not rig.request("acquire", "bob").granted
    assert rig.request("emergency_stop", "bob", number=5).granted
    assert rig.state == "emergency_stop"


def test_acquiring_control_again_changes_nothing() -> None:
    """An instance that acquires control again, also while driving, gets the same epoch and token."""
    rig = Rig()
    first = rig.request("acquire")
    assert rig.request("acquire") == first
    rig.arm_for(NS_PER_S)
    assert rig.request("acquire") == first
    assert rig.state == "driving"
    rig.take_picture()
    assert rig.send_drive().accepted


@pytest.mark.parametrize("other", [("bob", 1), ("alice", 2)])
def test_a_second_client_is_rejected_while_the_vehicle_is_armed_or_moves(other: tuple[str, int]) -> None:
    """While the vehicle is arming, driven or moving, no other client or instance acquires control."""
    rig = Rig().acquire()

    def is_rejected() -> bool:
        reply = rig.gate.session.answer(SessionRequest("acquire", *other, 0), rig.vehicle, rig.now_ns)
        return (reply.granted, reply.epoch, reply.token) == (False, 0, b"")

    rig.arm_for(NS_PER_S // 2)
    assert rig.state == "arming"
    assert is_rejected()
    rig.arm_for(NS_PER_S // 2)
    assert rig.state == "driving"
    assert is_rejected()
    rig.vehicle = vehicle_at(8.0)
    rig.pass_time(300 * NS_PER_MS)
    assert rig.state == "degraded"
    assert is_rejected()
    rig.pass_time(200 * NS_PER_MS)
    assert rig.state == "safe_stop"
    assert is_rejected()
    rig.vehicle = vehicle_at(0.0)
    assert not is_rejected()


def test_a_takeover_at_standstill_renews_the_epoch() -> None:
    """At standstill and disarmed, another client acquires control under a new epoch and token."""
    rig = Rig()
    first = rig.request("acquire")
    second = rig.request("acquire", "bob", instance=7)
    assert second.granted
    assert second.epoch != first.epoch
    assert second.token != first.token
    rig.take_picture()
    assert rig.send().reason == RejectionReason.WRONG_EPOCH
    assert rig.send(epoch=second.epoch).accepted
    assert not rig.request("release").granted


def test_a_release_stops_and_frees_the_vehicle() -> None:
    """A release while driving leads to the safe stop, rejects later commands and frees the vehicle."""
    rig = Rig().start_driving()
    rig.vehicle = vehicle_at(5.0)
    assert rig.request("release").granted
    assert rig.state == "safe_stop"
    rig.take_picture()
    assert rig.send_drive().reason == RejectionReason.WRONG_EPOCH
    assert rig.request("acquire", "bob", instance=1).granted


def test_the_reply_to_a_release_has_no_epoch() -> None:
    """The reply to a release has neither epoch nor token."""
    rig = Rig().acquire()
    reply = rig.request("release")
    assert (reply.granted, reply.epoch, reply.token) == (True, 0, b"")
    rig.take_picture()
    assert not rig.send().accepted
    assert not rig.request("release").granted


@pytest.mark.parametrize("operation", ["release", "clear_emergency_stop"])
def test_only_the_active_operator_changes_the_session(operation: Operation) -> None:
    """Release and clearing are rejected from other clients, and from another instance of the same name."""
    rig = Rig().arm()
    for who, instance in (("bob", 1), ("alice", 2)):
        reply = rig.request(operation, who, instance=instance)
        assert not reply.granted
        assert isinstance(reply.reason, str)
        assert reply.reason != ""
        assert reply.epoch == 0
    assert rig.state == "driving"


def test_an_emergency_stop_grants_no_control() -> None:
    """The reply to another client's emergency stop has neither epoch nor token."""
    rig = Rig().start_driving()
    reply = rig.request("emergency_stop", "bob", instance=9, number=5)
    assert reply.granted
    assert (reply.epoch, reply.token) == (0, b"")


def test_session_requests_are_counted() -> None:
    """Granted and rejected requests are counted separately."""
    rig = Rig().arm()
    rig.request("acquire", "bob", instance=1)
    counts = rig.gate.counts
    assert (counts["session acquire granted"], counts["session acquire rejected"]) == (1, 1)


def requested_by(rig: Rig) -> str:
    return rig.gate.session.takeover_requests.requested_by(rig.now_ns)


def test_a_handover_request_is_reported_and_changes_nothing_else() -> None:
    """A handover request is granted without epoch or token, is reported, and leaves the drive unchanged."""
    rig = Rig().start_driving()
    reply = rig.request("request_handover", "bob", instance=7)
    assert (reply.granted, reply.epoch, reply.token) == (True, 0, b"")
    assert requested_by(rig) == "bob"
    rig.take_picture()
    assert rig.send_drive().accepted
    assert rig.gate.session.active_operator == ("alice", 1)


def test_without_consent_a_driven_vehicle_is_not_handed_over() -> None:
    """Handover requests alone never transfer control of a driven vehicle."""
    rig = Rig().start_driving()
    for _ in range(5):
        rig.request("request_handover", "bob", instance=7)
        reply = rig.request("acquire", "bob", instance=7)
        assert not reply.granted
        assert "alice has control" in reply.reason
        for _ in range(50):
            rig.pass_time(COMMAND_PERIOD_NS)
            rig.take_picture()
            assert rig.send_drive().accepted


def test_with_consent_the_vehicle_stops_and_is_reserved_for_the_requester() -> None:
    """A release during a handover request stops the vehicle and reserves it for the requester."""
    rig = Rig().start_driving()
    rig.vehicle = vehicle_at(5.0)
    rig.request("request_handover", "bob", instance=7)
    assert rig.request("release").granted
    assert (rig.state, rig.gate.session.active_operator, requested_by(rig)) == ("safe_stop", None, "")
    for who, instance in (("carol", 1), ("alice", 1), ("bob", 8)):
        reply = rig.request("acquire", who, instance=instance)
        assert not reply.granted
        assert "reserved for bob" in reply.reason
    assert rig.request("acquire", "bob", instance=7).epoch != 0
    rig.vehicle = vehicle_at(0.0)
    assert rig.request("acquire", "carol").granted


def test_a_new_active_operator_arms_at_standstill() -> None:
    """A client that took over a moving vehicle can arm it only at standstill, which takes 1 s."""
    rig = Rig().start_driving()
    rig.vehicle = vehicle_at(5.0)
    rig.request("request_handover", "bob", instance=7)
    rig.request("release")
    rig.epoch = rig.request("acquire", "bob", instance=7).epoch
    rig.take_picture()
    assert rig.send().reason == RejectionReason.NOT_STATIONARY
    rig.vehicle = vehicle_at(0.0)
    rig.arm_for(NS_PER_S - COMMAND_PERIOD_NS)
    assert rig.state == "arming"
    rig.arm_for(COMMAND_PERIOD_NS)
    assert rig.state == "driving"


def test_a_reservation_expires() -> None:
    """The reservation for a requester ends after 5 s."""
    rig = Rig().start_driving()
    rig.request("request_handover", "bob", instance=7)
    rig.request("release")
    rig.pass_time(LIMITS.reservation_ns - 1)
    assert not rig.request("acquire", "carol").granted
    rig.pass_time(1)
    assert rig.request("acquire", "carol").granted
    assert LIMITS.reservation_ns == 5 * NS_PER_S


def test_a_handover_request_expires() -> None:
    """A handover request that is not renewed expires after 3 s, and a release then reserves nothing."""
    rig = Rig().start_driving()
    rig.request("request_handover", "bob", instance=7)
    rig.pass_time(LIMITS.handover_request_timeout_ns - 1)
    assert requested_by(rig) == "bob"
    rig.request("request_handover", "bob", instance=7)
    rig.pass_time(LIMITS.handover_request_timeout_ns - 1)
    assert requested_by(rig) == "bob"
    rig.pass_time(1)
    assert requested_by(rig) == ""
    rig.request("release")
    assert rig.request("acquire", "carol").granted
    assert LIMITS.handover_request_timeout_ns == 3 * NS_PER_S


def test_the_first_handover_request_has_priority() -> None:
    """A second handover request is rejected until the first has expired."""
    rig = Rig().start_driving()
    rig.request("request_handover", "bob", instance=7)
    for who, instance in (("carol", 1), ("bob", 8)):
        reply = rig.request("request_handover", who, instance=instance)
        assert not reply.granted
        assert "bob" in reply.reason
    rig.pass_time(LIMITS.handover_request_timeout_ns)
    assert rig.request("request_handover", "carol").granted
    assert requested_by(rig) == "carol"


def test_a_handover_request_needs_another_active_operator() -> None:
    """A handover request is rejected if the active operator sends it, or while no client has control."""
    rig = Rig()
    without_operator = rig.request("request_handover")
    assert not without_operator.granted
    rig.acquire()
    rejected = rig.request("request_handover")
    assert rejected.reason not in ("", without_operator.reason)
    assert (rejected.granted, rejected.epoch, rejected.token) == (False, 0, b"")
    assert requested_by(rig) == ""


def test_at_rest_no_consent_is_needed() -> None:
    """At standstill and disarmed, a third client acquires control in spite of a pending handover request."""
    rig = Rig().acquire()
    rig.request("request_handover", "bob", instance=7)
    assert rig.request("acquire", "carol").granted
    assert requested_by(rig) == ""


def test_an_emergency_stop_by_another_client_keeps_the_session() -> None:
    """Another client's emergency stop is reported with its name and leaves the session unchanged."""
    rig = Rig().start_driving()
    rig.request("request_handover", "bob", instance=7)
    assert rig.request("emergency_stop", "bob", instance=7, number=5).granted
    assert (rig.state, rig.gate.machine.reason) == ("emergency_stop", "emergency stop by bob")
    assert (rig.gate.session.active_operator, requested_by(rig)) == (("alice", 1), "bob")
    rig.request("emergency_stop", "carol", instance=1, number=5)
    assert rig.gate.machine.reason == "emergency stop by bob"


def test_a_server_shutdown_stops_the_vehicle() -> None:
    """A server shutdown stops the vehicle, rejects commands and grants no control."""
    rig = Rig().start_driving()
    rig.vehicle = vehicle_at(5.0)
    rig.gate.session.close()
    assert (rig.state, rig.gate.session.active_operator) == ("safe_stop", None)
    assert "shutting down" in rig.gate.machine.reason
    rig.take_picture()
    assert rig.send_drive().reason == RejectionReason.WRONG_EPOCH
    rig.vehicle = vehicle_at(0.0)
    assert "shutting down" in rig.request("acquire", "bob").reason
