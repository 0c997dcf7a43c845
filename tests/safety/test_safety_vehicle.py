"""Vehicle faults, driver overrides and engagement."""

from __future__ import annotations

import math
from typing import Any

import pytest
from msgspec.structs import replace
from tests.safety.rig import Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.safety.gate import RejectionReason

FAULT: dict[str, Any] = {"inhibit_reason": "brake: fault", "is_engaged": False}
OVERRIDE: dict[str, Any] = {"inhibit_reason": "the driver steers", "is_engaged": False, "is_overridden": True}


def test_an_inhibited_vehicle_is_not_armed() -> None:
    """While the vehicle has an inhibit reason, arming is rejected with that reason."""
    rig = Rig().acquire()
    rig.vehicle = replace(vehicle_at(), inhibit_reason="no report of the speed for 100 ms", is_engaged=False)
    rig.take_picture()
    verdict = rig.send()
    assert verdict.reason is RejectionReason.INHIBITED
    assert verdict.message.endswith(": no report of the speed for 100 ms")
    assert rig.state == "disarmed"
    rig.vehicle = vehicle_at()
    assert rig.send().accepted
    assert rig.state == "arming"


def test_a_vehicle_with_an_impossible_angle_is_not_armed() -> None:
    """While the vehicle reports an angle that no wheel has, arming is rejected."""
    rig = Rig().acquire()
    rig.vehicle = replace(vehicle_at(), steering_rad=2.0)
    rig.take_picture()
    assert rig.send().reason is RejectionReason.INHIBITED
    assert rig.state == "disarmed"


def test_arming_waits_until_the_vehicle_is_engaged() -> None:
    """Arming completes when the vehicle is engaged, if that takes longer than 1 s."""
    rig = Rig().acquire()
    rig.vehicle = replace(vehicle_at(), is_engaged=False)
    rig.arm_for(2 * NS_PER_S)
    assert rig.state == "arming"
    rig.vehicle = vehicle_at()
    rig.send()
    assert rig.state == "driving"


def test_engaging_does_not_turn_the_wheel() -> None:
    """When arming begins, the steering target is the wheel's present angle."""
    rig = Rig().start_driving(steering_rad=0.2)
    rig.request("release")
    rig.acquire()
    rig.vehicle = vehicle_at(steering_rad=-0.1)
    rig.take_picture()
    rig.send()
    assert rig.state == "arming"
    assert rig.actuation().steering_rad == -0.1


@pytest.mark.parametrize("state", ["driving", "degraded"])
def test_a_vehicle_fault_stops_the_vehicle(state: str) -> None:
    """A fault while driving leads to a braked safe stop that reports the inhibit reason."""
    rig = Rig().start_driving()
    if state == "degraded":
        rig.pass_time(400 * NS_PER_MS)
    assert rig.state == state
    rig.vehicle = replace(vehicle_at(8.0), **FAULT)
    requested = rig.actuation()
    assert rig.state == "safe_stop"
    assert rig.gate.machine.reason.endswith(": brake: fault")
    assert (requested.throttle, requested.brake) == (0.0, 4.0 / 6.0)


def test_a_vehicle_that_disengages_without_a_reason_is_stopped() -> None:
    """A vehicle that disengages without a reason while driving is stopped."""
    rig = Rig().start_driving()
    rig.vehicle = replace(vehicle_at(8.0), is_engaged=False)
    rig.actuation()
    assert rig.state == "safe_stop"


@pytest.mark.parametrize("state", ["arming", "driving", "degraded", "safe_stop"])
def test_a_driver_override_disarms(state: str) -> None:
    """A driver override disarms the vehicle under a new epoch."""
    rig = Rig().start_driving() if state != "arming" else Rig().acquire()
    if state == "arming":
        rig.take_picture()
        rig.send()
    else:
        rig.pass_time({"driving": 0, "degraded": 400 * NS_PER_MS, "safe_stop": 600 * NS_PER_MS}[state])
    assert rig.state == state
    rig.vehicle = replace(vehicle_at(8.0), **OVERRIDE)
    epoch = rig.epoch
    rig.actuation()
    assert rig.state == "disarmed"
    assert "taken over" in rig.gate.machine.reason
    rig.take_picture()
    assert rig.send_drive(epoch=epoch).reason == RejectionReason.WRONG_EPOCH


def test_a_driver_override_keeps_an_emergency_stop() -> None:
    """A driver override does not clear an emergency stop."""
    rig = Rig().start_driving()
    rig.request("emergency_stop", number=7)
    rig.vehicle = replace(vehicle_at(8.0), **OVERRIDE)
    rig.actuation()
    assert rig.state == "emergency_stop"


def test_a_command_that_arrives_with_a_fault_is_rejected() -> None:
    """A command that arrives together with a fault is rejected."""
    rig = Rig().start_driving()
    rig.vehicle = replace(vehicle_at(8.0), **FAULT)
    rig.take_picture()
    assert not rig.send_drive().accepted
    assert rig.state == "safe_stop"


def test_the_vehicle_is_engaged_until_it_is_stationary() -> None:
    """The vehicle is engaged while it is armed or driven, and after a stop until standstill."""
    rig = Rig()
    assert not rig.gate.watchdog.should_engage(vehicle_at())
    assert not rig.gate.watchdog.should_engage(vehicle_at(8.0)), "a driver moves a vehicle that was never armed"
    rig.start_driving()
    assert rig.gate.watchdog.should_engage(vehicle_at())
    rig.pass_time(600 * NS_PER_MS)
    assert rig.gate.watchdog.should_engage(vehicle_at(8.0))
    assert not rig.gate.watchdog.should_engage(vehicle_at())


@pytest.mark.parametrize("stop", ["safe_stop", "emergency_stop"])
def test_after_a_stop_only_arming_engages_the_vehicle_again(stop: str) -> None:
    """Once stationary after a stop, the vehicle is engaged again by arming only, though the stop is latched."""
    rig = Rig().start_driving()
    assert rig.gate.watchdog.should_engage(vehicle_at(8.0))
    if stop == "emergency_stop":
        rig.request("emergency_stop", number=7)
    else:
        rig.pass_time(600 * NS_PER_MS)
    assert rig.state == stop
    assert rig.gate.watchdog.should_engage(vehicle_at(8.0))
    assert not rig.gate.watchdog.should_engage(vehicle_at())
    assert not rig.gate.watchdog.should_engage(vehicle_at(0.07))
    assert not rig.gate.watchdog.should_engage(vehicle_at(8.0))


def test_an_emergency_stop_does_not_engage_a_disarmed_vehicle() -> None:
    """An emergency stop does not engage a disarmed car that is driven by hand."""
    rig = Rig().acquire()
    rig.vehicle = vehicle_at(8.0)
    assert not rig.gate.watchdog.should_engage(rig.vehicle)
    assert rig.request("emergency_stop", number=7).granted
    assert not rig.gate.watchdog.should_engage(rig.vehicle)


@pytest.mark.parametrize("field", ["speed_mps", "steering_rad"])
@pytest.mark.parametrize("reported", [math.nan, math.inf, 101.0, -1e300])
def test_an_impossible_state_is_a_vehicle_fault(field: str, reported: float) -> None:
    """A speed or an angle that is not finite, or larger than any vehicle's, stops the vehicle."""
    changes = {field: reported}
    rig = Rig().start_driving()
    rig.vehicle = replace(vehicle_at(5.0), **changes)
    actuation = rig.actuation()
    assert rig.state == "safe_stop"
    assert actuation.throttle == 0.0
    assert math.isfinite(actuation.steering_rad)


@pytest.mark.parametrize("state", ["arming", "driving", "degraded"])
@pytest.mark.parametrize("speed_mps", [0.0, 11.0])
def test_an_implausible_speed_is_a_vehicle_fault(state: str, speed_mps: float) -> None:
    """A report that the speed is implausible causes full brake, even without an inhibit reason."""
    rig = Rig().acquire()
    rig.take_picture()
    rig.send()
    if state != "arming":
        rig = Rig().start_driving()
    if state == "degraded":
        rig.pass_time(400 * NS_PER_MS)
    assert rig.state == state
    rig.vehicle = replace(vehicle_at(speed_mps), is_speed_plausible=False)
    actuation = rig.actuation()
    assert rig.state == ("disarmed" if state == "arming" else "safe_stop")
    assert (actuation.throttle, actuation.brake) == (0.0, 1.0)
