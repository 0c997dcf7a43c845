"""What the gate does about a vehicle that does not obey, or that somebody else drives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from tests.safety.rig import Rig, vehicle_at

from lavt.domain import NS_PER_S

FAULT: dict[str, Any] = {"inhibit_reason": "brake: fault", "is_engaged": False}
OVERRIDE: dict[str, Any] = {"inhibit_reason": "the driver steers", "is_engaged": False, "is_overridden": True}


def test_a_vehicle_that_cannot_be_driven_is_not_armed() -> None:
    """While the vehicle says why it cannot be driven, arming is refused in its words; without them it begins."""
    rig = Rig().hold()
    rig.vehicle = replace(vehicle_at(), inhibit_reason="no report of the speed for 100 ms", is_engaged=False)
    rig.picture()
    assert rig.send().reason.endswith(": no report of the speed for 100 ms")
    assert rig.state == "disarmed"
    rig.vehicle = vehicle_at()
    assert rig.send().accepted
    assert rig.state == "arming"


def test_the_drive_begins_once_the_vehicle_is_engaged() -> None:
    """A vehicle that takes its time to be engaged is armed when it is, not after the second alone."""
    rig = Rig().hold()
    rig.vehicle = replace(vehicle_at(), is_engaged=False)
    rig.arm_for(2 * NS_PER_S)
    assert rig.state == "arming"
    rig.vehicle = vehicle_at()
    rig.send()
    assert rig.state == "driving"


def test_a_vehicle_that_gets_engaged_does_not_turn_its_wheel() -> None:
    """From the first moment of arming the target is where the wheel is, whatever was commanded before."""
    rig = Rig().driving(steering_rad=0.2)
    rig.ask("release")
    rig.hold()
    rig.vehicle = vehicle_at(steering_rad=-0.1)
    rig.picture()
    rig.send()
    assert rig.state == "arming"
    assert rig.actuation().steering_rad == -0.1


@pytest.mark.parametrize("state", ["driving", "degraded"])
def test_a_vehicle_that_ceases_to_accept_is_stopped(state: str) -> None:
    """A fault in the drive is a safe stop, told in the vehicle's words; what still obeys is braked."""
    rig = Rig().driving()
    if state == "degraded":
        rig.go(400_000_000)
    assert rig.state == state
    rig.vehicle = replace(vehicle_at(8.0), **FAULT)
    requested = rig.actuation()
    assert (rig.state, rig.gate.reason) == ("safe_stop", "the vehicle does not obey: brake: fault")
    assert (requested.throttle, requested.brake) == (0.0, 4.0 / 6.0)


def test_a_vehicle_that_lets_go_without_a_word_is_stopped() -> None:
    """A vehicle that is engaged no more in the drive is stopped, also when it does not say why."""
    rig = Rig().driving()
    rig.vehicle = replace(vehicle_at(8.0), is_engaged=False)
    rig.actuation()
    assert rig.state == "safe_stop"


@pytest.mark.parametrize("state", ["arming", "driving", "degraded", "safe_stop"])
def test_who_drives_the_car_by_hand_has_it(state: str) -> None:
    """A driver's override disarms, ends the epoch, and is not arming again by itself: commands are refused."""
    rig = Rig().driving() if state != "arming" else Rig().hold()
    if state == "arming":
        rig.picture()
        rig.send()
    else:
        rig.go({"driving": 0, "degraded": 400_000_000, "safe_stop": 600_000_000}[state])
    assert rig.state == state
    rig.vehicle = replace(vehicle_at(8.0), **OVERRIDE)
    epoch = rig.epoch
    rig.actuation()
    assert (rig.state, rig.gate.reason) == ("disarmed", "the driver in the car has taken over")
    rig.picture()
    assert rig.drive(epoch=epoch).reason == "not the epoch in force"


def test_an_emergency_stop_stays_one_under_a_drivers_hands() -> None:
    """A driver's override does not clear an emergency stop."""
    rig = Rig().driving()
    rig.ask("emergency_stop", number=7)
    rig.vehicle = replace(vehicle_at(8.0), **OVERRIDE)
    rig.actuation()
    assert rig.state == "emergency_stop"


def test_a_fault_counts_before_a_command() -> None:
    """A command that comes with a fault is not obeyed as if all were well."""
    rig = Rig().driving()
    rig.vehicle = replace(vehicle_at(8.0), **FAULT)
    rig.picture()
    assert not rig.drive().accepted
    assert rig.state == "safe_stop"


def test_a_vehicle_is_needed_until_it_stands() -> None:
    """It has to be engaged while somebody drives or is about to, and after a stop until standstill."""
    rig = Rig()
    assert not rig.gate.needs(vehicle_at())
    assert not rig.gate.needs(vehicle_at(8.0)), "nobody has armed it: whoever moves it has it"
    rig.driving()
    assert rig.gate.needs(vehicle_at())
    rig.go(600_000_000)
    assert rig.gate.needs(vehicle_at(8.0))
    assert not rig.gate.needs(vehicle_at())


@pytest.mark.parametrize("stop", ["safe_stop", "emergency_stop"])
def test_a_vehicle_that_was_left_is_taken_back_by_arming_alone(stop: str) -> None:
    """Once it has stood after a stop, the vehicle is whose who moves it, though the stop is latched."""
    rig = Rig().driving()
    assert rig.gate.needs(vehicle_at(8.0))
    if stop == "emergency_stop":
        rig.ask("emergency_stop", number=7)
    else:
        rig.go(600_000_000)
    assert rig.state == stop
    assert rig.gate.needs(vehicle_at(8.0))
    assert not rig.gate.needs(vehicle_at())
    assert not rig.gate.needs(vehicle_at(0.07))
    assert not rig.gate.needs(vehicle_at(8.0))


def test_an_emergency_stop_takes_no_car_from_its_driver() -> None:
    """Who drives a disarmed car by hand goes on doing so, though an emergency stop is asked for by the link."""
    rig = Rig().hold()
    rig.vehicle = vehicle_at(8.0)
    assert not rig.gate.needs(rig.vehicle)
    assert rig.ask("emergency_stop", number=7).granted
    assert not rig.gate.needs(rig.vehicle)
