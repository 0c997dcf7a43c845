"""How the vehicle is armed, and how an emergency stop holds it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.safety.rig import TICK_NS, Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.safety.gate import LARGEST_STORED_NUMBER
from lavt.safety.limits import LIMITS


def test_arming_takes_a_full_second() -> None:
    """All conditions held for 1 s arm the vehicle; a nanosecond less does not."""
    rig = Rig().hold()
    rig.picture()
    rig.send()
    begun_ns = rig.now_ns
    assert rig.state == "arming"
    for _ in range(49):
        rig.go(TICK_NS)
        rig.picture()
        rig.send()
    rig.go(begun_ns + NS_PER_S - 1 - rig.now_ns)
    rig.picture()
    rig.send()
    assert rig.state == "arming"
    rig.go(1)
    rig.send()
    assert rig.state == "driving"


def rolls(rig: Rig) -> None:
    rig.vehicle = vehicle_at(LIMITS.standstill_mps)
    rig.send()
    rig.vehicle = vehicle_at()


def rolls_back(rig: Rig) -> None:
    rig.vehicle = vehicle_at(-LIMITS.standstill_mps)
    rig.send()
    rig.vehicle = vehicle_at()


def freezes(rig: Rig) -> None:
    for _ in range(5):
        rig.picture(crc=-1)
    rig.send()


def no_new_pictures(rig: Rig) -> None:
    for _ in range(300 // 20):
        rig.go(TICK_NS)
        rig.send()


BREAKS: dict[str, Callable[[Rig], object]] = {
    "throttle": lambda rig: rig.send(throttle=0.01),
    "brake eased": lambda rig: rig.send(brake=0.29),
    "steering to the left": lambda rig: rig.send(steering_rad=0.11),
    "steering to the right": lambda rig: rig.send(steering_rad=-0.11),
    "a drive command": lambda rig: rig.drive(),
    "a stop command": lambda rig: rig.send(mode="stop"),
    "rolling": rolls,
    "rolling back": rolls_back,
    "frozen pictures": freezes,
    "no newer pictures": no_new_pictures,
    "no commands": lambda rig: rig.go(300 * NS_PER_MS),
    "release": lambda rig: (rig.ask("release"), rig.hold()),
    "emergency stop": lambda rig: (rig.ask("emergency_stop", "bob", 3, number=1), rig.clear()),
}


@pytest.mark.parametrize("name", sorted(BREAKS))
def test_each_broken_condition_starts_the_second_anew(name: str) -> None:
    """Whatever breaks a condition 0.6 s into arming, only a whole further second arms the vehicle."""
    rig = Rig().hold()
    rig.arm_for(600 * NS_PER_MS)
    assert rig.state == "arming"
    BREAKS[name](rig)
    assert rig.state in ("disarmed", "arming")
    rig.arm_for(980 * NS_PER_MS)
    assert rig.state == "arming"
    rig.arm_for(60 * NS_PER_MS)
    assert rig.state == "driving"


@pytest.mark.parametrize("name", ["throttle", "brake eased", "steering to the left", "frozen pictures"])
def test_arming_does_not_even_begin_without_its_conditions(name: str) -> None:
    """A command that asks for arming with a condition missing leaves the vehicle disarmed."""
    rig = Rig().hold()
    rig.picture()
    BREAKS[name](rig)
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
    """The lightest brake, the largest steering input to either side and the first sequence number are enough."""
    rig = Rig().hold()
    rig.picture()
    assert rig.send(**changes).accepted
    assert rig.state == "arming"


def test_arming_begins_from_the_first_picture_of_all() -> None:
    """A picture with frame number 0 is newer than none."""
    rig = Rig().hold()
    rig.frame = -1
    rig.picture()
    rig.send()
    assert rig.state == "arming"


def test_arming_does_not_begin_with_a_picture_already_used() -> None:
    """Pictures must be fresh when arming begins: one that was used 300 ms ago is not, though young enough to obey."""
    rig = Rig().hold()
    rig.picture()
    rig.send()
    rig.go(300 * NS_PER_MS)
    assert rig.state == "disarmed"
    assert rig.send().accepted
    assert rig.state == "disarmed"


def test_the_vehicle_does_not_move_before_the_first_drive_command() -> None:
    """Armed, the brake stays on and the wheel where it is, until a drive command comes; without one it stops again."""
    rig = Rig()
    rig.vehicle = vehicle_at(0.0, steering_rad=0.2)
    rig.armed()
    for _ in range(299):
        rig.go(NS_PER_MS)
        actuation = rig.actuation()
        assert (actuation.steering_rad, actuation.throttle) == (0.2, 0.0)
        assert actuation.brake >= LIMITS.arming_brake
    rig.go(NS_PER_MS)
    assert rig.state == "degraded"
    assert (rig.actuation().throttle, rig.actuation().brake) == (0.0, LIMITS.arming_brake)
    rig.go(200 * NS_PER_MS)
    assert rig.state == "safe_stop"


def test_armed_anew_the_last_drives_command_is_forgotten() -> None:
    """Armed again after a stop, the vehicle keeps its brake on and its wheel where it is until a new drive command."""
    rig = Rig().driving(steering_rad=0.05)
    rig.go(LIMITS.stop_after_ns)
    assert rig.state == "safe_stop"
    rig.ask("hold")
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"
    actuation = rig.actuation()
    assert (actuation.steering_rad, actuation.throttle) == (0.0, 0.0)
    assert actuation.brake >= LIMITS.arming_brake


def test_the_first_steering_target_is_where_the_wheel_is() -> None:
    """From the moment of arming the wheel is turned from where it stands, at most at the rate allowed."""
    rig = Rig()
    rig.vehicle = vehicle_at(0.0, steering_rad=0.0)
    rig.actuation()
    rig.vehicle = vehicle_at(0.0, steering_rad=0.2)  # somebody turned the wheel since
    rig.armed()
    rig.go(10 * NS_PER_MS)
    rig.picture()
    assert rig.drive(steering_rad=-0.3).accepted
    assert rig.actuation().steering_rad == pytest.approx(0.2 - 0.01 * LIMITS.steering_rate_radps)


@pytest.mark.parametrize("start", ["disarmed", "arming", "driving", "degraded", "safe_stop"])
def test_an_emergency_stop_works_in_every_state(start: str) -> None:
    """From every state the query leads to the latched emergency stop: full brake, new epoch, nothing obeyed."""
    rig = Rig().hold()
    if start == "arming":
        rig.arm_for(NS_PER_S // 2)
    elif start != "disarmed":
        rig.armed()
        rig.go({"driving": 0, "degraded": 300, "safe_stop": 500}[start] * NS_PER_MS)
    assert rig.state == start
    rig.vehicle = vehicle_at(5.0)
    assert rig.ask("emergency_stop", "bob", 4, number=17).granted
    assert rig.state == "emergency_stop"
    assert (rig.actuation().throttle, rig.actuation().brake) == (0.0, 1.0)
    rig.picture()
    assert rig.drive().reason == "not the epoch in force"
    rig.go(NS_PER_S)
    assert rig.state == "emergency_stop"


@pytest.mark.parametrize(
    "changes",
    [{}, {"epoch": 1}, {"sequence": 0}, {"stamp_ns": 0}, {"stamp_ns": 5}, {"mode": "arm"}, {"mode": "stop"}],
    ids=str,
)
def test_the_flag_in_a_command_counts_whatever_the_command(changes: dict[str, Any]) -> None:
    """An emergency stop in a command is honoured whatever its epoch, sequence and picture; the command is refused."""
    rig = Rig().driving()
    assert not rig.drive(emergency_stop=1, **changes).accepted
    assert rig.state == "emergency_stop"


def test_the_flag_counts_when_nobody_holds_the_vehicle() -> None:
    """Also a vehicle that nobody holds is stopped by a flag, and nobody can arm it then but by clearing."""
    rig = Rig()
    rig.send(emergency_stop=1)
    assert rig.state == "emergency_stop"
    rig.hold().arm_for(NS_PER_S)
    assert rig.state == "emergency_stop"
    assert rig.send().reason == "the emergency stop must be cleared first"


def test_the_number_of_an_emergency_stop_only_grows() -> None:
    """A number that is not higher than all before, over epochs, is a replay: refused, counted, without effect."""
    rig = Rig().armed()
    assert rig.ask("emergency_stop", number=40).granted
    assert rig.clear().granted
    rig.ask("hold")
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"
    for number in (40, 39, 1, 0):
        reply = rig.ask("emergency_stop", "bob", 2, number=number)
        assert isinstance(reply.reason, str)
        assert reply.reason != ""
        assert (reply.granted, reply.emergency_stop) == (False, 40)
    rig.picture()
    assert rig.drive(emergency_stop=40).reason == "it carries an emergency stop"
    assert rig.state == "driving"
    assert rig.gate.counts["emergency stop with an old number"] == 5
    assert rig.ask("emergency_stop", "bob", 2, number=41).granted
    assert rig.state == "emergency_stop"


@pytest.mark.parametrize("beyond", [0, 1])
def test_a_number_too_large_to_be_followed_stops_and_is_forgotten(beyond: int) -> None:
    """An emergency stop with any higher number stops the vehicle; one that leaves no room for a next is not kept."""
    rig = Rig().armed()
    rig.ask("emergency_stop", "bob", 2, number=40)
    rig.clear()
    reply = rig.ask("emergency_stop", "bob", 2, number=LARGEST_STORED_NUMBER + beyond)
    assert (reply.granted, rig.state) == (True, "emergency_stop")
    assert reply.emergency_stop == (40 if beyond else LARGEST_STORED_NUMBER)
    assert rig.clear().granted
    assert rig.state == "disarmed"


def test_a_command_that_carries_an_emergency_stop_never_moves_the_vehicle() -> None:
    """After clearing, a client that still carries its old emergency stop can neither arm nor drive."""
    rig = Rig().hold()
    rig.ask("emergency_stop", number=3)
    rig.clear()
    rig.ask("hold")
    for _ in range(100):
        rig.go(TICK_NS)
        rig.picture()
        assert not rig.send(emergency_stop=3).accepted
    assert rig.state == "disarmed"


def test_the_flag_that_every_command_repeats_is_no_replay() -> None:
    """While the stop is in force, the same number in command after command is not counted as a replay."""
    rig = Rig().driving()
    for _ in range(10):
        rig.drive(emergency_stop=9)
    assert rig.gate.counts["emergency stop with an old number"] == 0


def test_only_the_active_operator_clears_at_standstill_and_by_number() -> None:
    """Clearing is refused to others, to a moving vehicle, and to a request that names another emergency stop."""
    rig = Rig().driving()
    rig.ask("emergency_stop", "bob", 2, number=8)
    rig.vehicle = vehicle_at(1.0)
    assert rig.clear().reason == "the vehicle does not stand yet"
    rig.vehicle = vehicle_at()
    assert not rig.ask("clear_emergency_stop", "bob", 2, number=8).granted
    rig.ask("emergency_stop", "bob", 2, number=9)
    late = rig.clear(number=8)
    assert (late.granted, late.reason) == (False, "this is not the number of the last emergency stop")
    assert rig.state == "emergency_stop"
    assert rig.clear(number=9).granted
    assert rig.state == "disarmed"


def test_arming_is_rejected_before_clearing_and_needed_after_it() -> None:
    """Until it is cleared the emergency stop refuses arming; cleared, the vehicle is disarmed and needs its second."""
    rig = Rig().driving()
    rig.ask("emergency_stop", number=8)
    rig.ask("hold")
    rig.picture()
    assert rig.send().reason == "the emergency stop must be cleared first"
    assert rig.clear().granted
    assert rig.drive().reason == "the vehicle is not armed"
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"


def test_transitions_are_told_with_their_reasons() -> None:
    """Every transition is told once: from, to, and why."""
    rig = Rig().driving()
    rig.go(500 * NS_PER_MS)
    told = rig.gate.take_transitions()
    assert [(before, after) for before, after, _ in told] == [
        ("disarmed", "arming"),
        ("arming", "driving"),
        ("driving", "degraded"),
        ("degraded", "safe_stop"),
    ]
    assert all(reason for _, _, reason in told)
    assert rig.gate.take_transitions() == []
