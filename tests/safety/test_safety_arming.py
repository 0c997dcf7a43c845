"""Arming and emergency stops."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.safety.rig import COMMAND_PERIOD_NS, Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.safety.gate import RejectionReason
from lavt.safety.limits import LIMITS
from lavt.safety.session import REMEMBERED_STOPS

STOP_NUMBER = 1
"""The number of an emergency stop. A command with the number 0 requests no emergency stop."""


def test_arming_takes_a_full_second() -> None:
    """The vehicle is armed when all arming conditions have been met for 1 s, and not a nanosecond earlier."""
    rig = Rig().acquire()
    rig.take_picture()
    rig.send()
    began_ns = rig.now_ns
    assert rig.state == "arming"
    for _ in range(49):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.take_picture()
        rig.send()
    rig.pass_time(began_ns + NS_PER_S - 1 - rig.now_ns)
    rig.take_picture()
    rig.send()
    assert rig.state == "arming"
    rig.pass_time(1)
    rig.send()
    assert rig.state == "driving"


def roll(rig: Rig) -> None:
    rig.vehicle = vehicle_at(LIMITS.standstill_mps)
    rig.send()
    rig.vehicle = vehicle_at()


def roll_back(rig: Rig) -> None:
    rig.vehicle = vehicle_at(-LIMITS.standstill_mps)
    rig.send()
    rig.vehicle = vehicle_at()


def freeze_pictures(rig: Rig) -> None:
    for _ in range(5):
        rig.take_picture(crc=-1)
    rig.send()


def send_without_new_pictures(rig: Rig) -> None:
    for _ in range(300 // 20):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.send()


def roll_between_commands(rig: Rig) -> None:
    rig.vehicle = vehicle_at(LIMITS.standstill_mps)
    rig.actuation()
    rig.vehicle = vehicle_at()


ARMING_VIOLATIONS: dict[str, Callable[[Rig], object]] = {
    "throttle": lambda rig: rig.send(throttle=0.01),
    "brake eased": lambda rig: rig.send(brake=0.29),
    "steering to the left": lambda rig: rig.send(steering_rad=0.11),
    "steering to the right": lambda rig: rig.send(steering_rad=-0.11),
    "a drive command": lambda rig: rig.send_drive(),
    "a stop command": lambda rig: rig.send(mode="stop"),
    "rolling": roll,
    "rolling back": roll_back,
    "rolling between two commands": roll_between_commands,
    "frozen pictures": freeze_pictures,
    "no newer pictures": send_without_new_pictures,
    "no commands": lambda rig: rig.pass_time(300 * NS_PER_MS),
    "release": lambda rig: (rig.request("release"), rig.acquire()),
    "emergency stop": lambda rig: (
        rig.request("emergency_stop", "bob", instance=3, number=1),
        rig.clear_emergency_stop(),
    ),
}


@pytest.mark.parametrize("name", sorted(ARMING_VIOLATIONS))
def test_an_unmet_condition_restarts_arming(name: str) -> None:
    """If an arming condition fails after 0.6 s of arming, the full second begins again."""
    rig = Rig().acquire()
    rig.arm_for(600 * NS_PER_MS)
    assert rig.state == "arming"
    ARMING_VIOLATIONS[name](rig)
    assert rig.state in ("disarmed", "arming")
    rig.arm_for(980 * NS_PER_MS)
    assert rig.state == "arming"
    rig.arm_for(60 * NS_PER_MS)
    assert rig.state == "driving"


@pytest.mark.parametrize("name", ["throttle", "brake eased", "steering to the left", "frozen pictures"])
def test_arming_does_not_begin_with_an_unmet_condition(name: str) -> None:
    """A command that does not meet an arming condition leaves the vehicle disarmed."""
    rig = Rig().acquire()
    rig.take_picture()
    ARMING_VIOLATIONS[name](rig)
    assert rig.state == "disarmed"


@pytest.mark.parametrize(
    "changes",
    [
        {"brake": LIMITS.arming_brake},
        {"steering_rad": LIMITS.arming_steering_rad},
        {"steering_rad": -LIMITS.arming_steering_rad},
        {"sequence": 0},
    ],
    ids=str,
)
def test_arming_begins_at_the_bounds_of_its_conditions(changes: dict[str, Any]) -> None:
    """Arming begins with the lightest allowed brake, with the largest neutral steering angle, and with sequence 0."""
    rig = Rig().acquire()
    rig.take_picture()
    assert rig.send(**changes).accepted
    assert rig.state == "arming"


def test_arming_begins_from_the_first_picture() -> None:
    """Arming begins with a command from the first picture, whose frame number is 0."""
    rig = Rig().acquire()
    rig.frame = -1
    rig.take_picture()
    rig.send()
    assert rig.state == "arming"


def test_arming_does_not_begin_with_a_picture_already_used() -> None:
    """A command from a picture that was already used 300 ms ago is accepted, but does not begin arming."""
    rig = Rig().acquire()
    rig.take_picture()
    rig.send()
    rig.pass_time(300 * NS_PER_MS)
    assert rig.state == "disarmed"
    assert rig.send().accepted
    assert rig.state == "disarmed"


def test_the_vehicle_does_not_move_before_the_first_drive_command() -> None:
    """An armed vehicle without a drive command stays braked and does not steer, until the command timeout stops it."""
    rig = Rig()
    rig.vehicle = vehicle_at(0.0, steering_rad=0.2)
    rig.arm()
    for _ in range(299):
        rig.pass_time(NS_PER_MS)
        actuation = rig.actuation()
        assert (actuation.steering_rad, actuation.throttle) == (0.2, 0.0)
        assert actuation.brake >= LIMITS.arming_brake
    rig.pass_time(NS_PER_MS)
    assert rig.state == "degraded"
    assert (rig.actuation().throttle, rig.actuation().brake) == (0.0, LIMITS.arming_brake)
    rig.pass_time(200 * NS_PER_MS)
    assert rig.state == "safe_stop"


def test_arming_again_drops_the_last_command() -> None:
    """A vehicle that is armed again after a stop ignores the last command of the previous drive."""
    rig = Rig().start_driving(steering_rad=0.05)
    rig.pass_time(LIMITS.stop_after_ns)
    assert rig.state == "safe_stop"
    rig.request("acquire")
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"
    actuation = rig.actuation()
    assert (actuation.steering_rad, actuation.throttle) == (0.0, 0.0)
    assert actuation.brake >= LIMITS.arming_brake


def test_steering_begins_at_the_present_angle() -> None:
    """The first drive command turns the wheel from its present angle, at most at the allowed rate."""
    rig = Rig()
    rig.vehicle = vehicle_at(0.0, steering_rad=0.0)
    rig.actuation()
    rig.vehicle = vehicle_at(0.0, steering_rad=0.2)  # the wheel was turned since
    rig.arm()
    rig.pass_time(10 * NS_PER_MS)
    rig.take_picture()
    assert rig.send_drive(steering_rad=-0.3).accepted
    assert rig.actuation().steering_rad == pytest.approx(0.2 - 0.01 * LIMITS.steering_rate_radps)


@pytest.mark.parametrize("start", ["disarmed", "arming", "driving", "degraded", "safe_stop"])
def test_an_emergency_stop_works_in_every_state(start: str) -> None:
    """In every state an emergency stop latches full brake and begins a new epoch, and no command is accepted."""
    rig = Rig().acquire()
    if start == "arming":
        rig.arm_for(NS_PER_S // 2)
    elif start != "disarmed":
        rig.arm()
        rig.pass_time({"driving": 0, "degraded": 300, "safe_stop": 500}[start] * NS_PER_MS)
    assert rig.state == start
    rig.vehicle = vehicle_at(5.0)
    assert rig.request("emergency_stop", "bob", instance=4, number=17).granted
    assert rig.state == "emergency_stop"
    assert (rig.actuation().throttle, rig.actuation().brake) == (0.0, 1.0)
    rig.take_picture()
    assert rig.send_drive().reason == RejectionReason.WRONG_EPOCH
    rig.pass_time(NS_PER_S)
    assert rig.state == "emergency_stop"


@pytest.mark.parametrize(
    "changes",
    [{}, {"epoch": 1}, {"sequence": 0}, {"stamp_ns": 0}, {"stamp_ns": 5}, {"mode": "arm"}, {"mode": "stop"}],
    ids=str,
)
def test_an_emergency_stop_in_any_command_is_executed(changes: dict[str, Any]) -> None:
    """An emergency stop in a command is executed whatever else the command has, and the command is rejected."""
    rig = Rig().start_driving()
    assert not rig.send_drive(emergency_stop=STOP_NUMBER, **changes).accepted
    assert rig.state == "emergency_stop"


def test_an_emergency_stop_without_an_operator() -> None:
    """An emergency stop in a command stops a vehicle without an operator, and must be cleared before arming."""
    rig = Rig()
    rig.send(emergency_stop=STOP_NUMBER)
    assert rig.state == "emergency_stop"
    rig.acquire().arm_for(NS_PER_S)
    assert rig.state == "emergency_stop"
    assert rig.send().reason == RejectionReason.EMERGENCY_STOP_LATCHED


def test_an_emergency_stop_is_executed_once() -> None:
    """The repetition of a cleared emergency stop is rejected and counted as a replay; the vehicle drives on."""
    rig = Rig().arm()
    for number in (39, 40):
        assert rig.request("emergency_stop", number=number).granted
        assert rig.clear_emergency_stop().granted
    rig.request("acquire")
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"
    for number in (40, 39):
        reply = rig.request("emergency_stop", "bob", instance=2, number=number)
        assert reply.emergency_stop == number, "without this number the client repeats its stop for ever"
        assert not reply.granted, "the vehicle drives, so it must not confirm a stop"
    rig.take_picture()
    assert rig.send_drive(emergency_stop=40).reason == RejectionReason.EMERGENCY_STOP
    assert rig.state == "driving"
    assert rig.gate.counts["emergency stop with an old number"] == 3
    assert rig.request("emergency_stop", "bob", instance=2, number=41).granted
    assert rig.state == "emergency_stop"


@pytest.mark.parametrize("number", [0, 1, 39, 2**62 - 1, 2**62 + 1, 2**63 - 2])
@pytest.mark.parametrize("earlier", [40, 2**62, 2**63 - 1])
def test_an_emergency_stop_never_prevents_a_later_one(earlier: int, number: int) -> None:
    """After an emergency stop with any number, a stop with any different number works; both can be cleared."""
    rig = Rig().arm()
    rig.request("emergency_stop", "bob", instance=2, number=earlier)
    assert rig.clear_emergency_stop().granted
    assert rig.state == "disarmed"
    reply = rig.request("emergency_stop", "carol", instance=3, number=number)
    assert (reply.granted, rig.state) == (True, "emergency_stop")
    assert rig.clear_emergency_stop().granted
    assert rig.state == "disarmed"
    rig.send(epoch=5, emergency_stop=number + 1)
    is_repetition = number + 1 == earlier
    assert (rig.state == "emergency_stop") == (not is_repetition)


def test_the_last_emergency_stops_are_remembered() -> None:
    """The vehicle remembers a bounded number of emergency stops; the oldest, once forgotten, can stop it again."""
    rig = Rig().acquire()
    for number in range(REMEMBERED_STOPS + 1):
        rig.request("emergency_stop", "bob", instance=2, number=number)
    assert rig.clear_emergency_stop().granted
    for number, state in ((1, "disarmed"), (REMEMBERED_STOPS, "disarmed"), (0, "emergency_stop")):
        rig.request("emergency_stop", "bob", instance=2, number=number)
        assert rig.state == state
    assert len(rig.gate.session._executed_stops) == REMEMBERED_STOPS


def test_replayed_emergency_stops_do_not_block_the_operator_forever() -> None:
    """After a restart of the server, each captured stop works at most once when replayed; a new stop still works."""
    rig = Rig().acquire()  # the restarted server, which does not remember any emergency stop
    captured = [rig.command(epoch=5, emergency_stop=number) for number in (10, 20, 30)]
    for stop in captured:
        rig.gate.admit(stop, rig.vehicle, rig.now_ns, rig.now_ns)
        assert rig.state == "emergency_stop"
        assert rig.clear_emergency_stop().granted
    rig.request("acquire")
    for _ in range(60):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.take_picture()
        for stop in captured:
            rig.gate.admit(stop, rig.vehicle, rig.now_ns, rig.now_ns)
            rig.request("emergency_stop", "bob", instance=2, number=stop.emergency_stop)
        rig.send()
    assert rig.state == "driving"
    assert rig.request("emergency_stop", "bob", instance=2, number=9).granted
    assert rig.state == "emergency_stop"


def test_a_command_with_an_emergency_stop_never_moves_the_vehicle() -> None:
    """After clearing, a client whose commands still carry the old emergency stop can neither arm nor drive."""
    rig = Rig().acquire()
    rig.request("emergency_stop", number=3)
    rig.clear_emergency_stop()
    rig.request("acquire")
    for _ in range(100):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.take_picture()
        assert not rig.send(emergency_stop=3).accepted
    assert rig.state == "disarmed"


def test_a_repeated_emergency_stop_is_not_counted_as_a_replay() -> None:
    """The same number in command after command is not counted as a replay while the stop is latched."""
    rig = Rig().start_driving()
    for _ in range(10):
        rig.send_drive(emergency_stop=9)
    assert rig.gate.counts["emergency stop with an old number"] == 0


def test_only_the_active_operator_clears_an_emergency_stop() -> None:
    """Only the active operator can clear an emergency stop, and only at standstill and with the number of that stop."""
    rig = Rig().start_driving()
    rig.request("emergency_stop", "bob", instance=2, number=8)
    rig.vehicle = vehicle_at(1.0)
    assert "stationary" in rig.clear_emergency_stop().reason
    rig.vehicle = vehicle_at()
    assert not rig.request("clear_emergency_stop", "bob", instance=2, number=8).granted
    rig.request("emergency_stop", "bob", instance=2, number=9)
    reply_to_old_number = rig.clear_emergency_stop(number=8)
    assert not reply_to_old_number.granted
    assert "number" in reply_to_old_number.reason
    assert rig.state == "emergency_stop"
    assert rig.clear_emergency_stop(number=9).granted
    assert rig.state == "disarmed"


def test_an_emergency_stop_must_be_cleared_before_arming() -> None:
    """An emergency stop must be cleared before arming, and arming takes a full second after that."""
    rig = Rig().start_driving()
    rig.request("emergency_stop", number=8)
    rig.request("acquire")
    rig.take_picture()
    assert rig.send().reason == RejectionReason.EMERGENCY_STOP_LATCHED
    assert rig.clear_emergency_stop().granted
    assert rig.send_drive().reason == RejectionReason.NOT_ARMED
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"


def test_transitions_are_reported_with_reasons() -> None:
    """Each transition is reported once, with both states and a reason."""
    rig = Rig().start_driving()
    rig.pass_time(500 * NS_PER_MS)
    transitions = rig.gate.machine.take_transitions()
    assert [(before, after) for before, after, _ in transitions] == [
        ("disarmed", "arming"),
        ("arming", "driving"),
        ("driving", "degraded"),
        ("degraded", "safe_stop"),
    ]
    assert all(reason for _, _, reason in transitions)
    assert rig.gate.machine.take_transitions() == []
