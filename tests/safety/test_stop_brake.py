"""The brake of a safe stop follows the measured speed."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace
from tests.safety.rig import MAX_BRAKING_MPS2, START_NS, Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.safety.limits import LIMITS
from lavt.safety.stop_brake import StopBrake

PLANNED_PEDAL = LIMITS.stop_deceleration_mps2 / MAX_BRAKING_MPS2


def pedals(deceleration_mps2: float, lag_s: float = 0.2) -> list[float]:
    """Return the pedal every 20 ms of a stop from 8 m/s, whose deceleration is constant after a lag."""
    brake = StopBrake(LIMITS, MAX_BRAKING_MPS2)
    times_s = [index / 50 for index in range(150)]
    speeds_mps = [max(0.0, 8.0 - deceleration_mps2 * max(0.0, time_s - lag_s)) for time_s in times_s]
    return [
        brake.pedal(vehicle_at(speed_mps), START_NS + round(time_s * NS_PER_S))
        for time_s, speed_mps in zip(times_s, speeds_mps, strict=True)
    ]


def test_a_stop_that_decelerates_as_planned_keeps_its_pedal() -> None:
    """With the planned deceleration, the pedal is not pressed further."""
    assert set(pedals(LIMITS.stop_deceleration_mps2)) == {PLANNED_PEDAL}


@pytest.mark.parametrize("deceleration_mps2", [0.0, 1.0, 2.0, 3.0])
def test_a_stop_that_decelerates_too_little_brakes_fully(deceleration_mps2: float) -> None:
    """With too little deceleration, the pedal rises, up to full, and is not released."""
    pressed = pedals(deceleration_mps2)
    assert pressed[0] == PLANNED_PEDAL
    assert pressed == sorted(pressed)
    assert pressed[-1] == 1.0


@pytest.mark.parametrize("speed_mps", [math.nan, math.inf, -math.inf, 1e200, -101.0])
def test_a_stop_at_a_speed_that_is_no_speed(speed_mps: float) -> None:
    """If a vehicle reports a speed once that is not finite or above any vehicle's, it brakes fully until standstill."""
    brake = StopBrake(LIMITS, MAX_BRAKING_MPS2)
    assert brake.pedal(vehicle_at(speed_mps), START_NS) == 1.0
    assert brake.pedal(vehicle_at(8.0), START_NS + NS_PER_S) == 1.0


def test_an_implausible_speed_brakes_fully_and_is_not_standstill() -> None:
    """A safe stop at an implausible speed of 0 brakes fully at once; the vehicle stays engaged and is not at rest."""
    rig = Rig().start_driving()
    rig.vehicle = replace(vehicle_at(0.0), is_speed_plausible=False, inhibit_reason="speed", is_engaged=False)
    rig.gate.watchdog.should_engage(rig.vehicle)
    assert rig.actuation().brake == 1.0
    assert rig.state == "safe_stop"
    rig.pass_time(10 * NS_PER_S)
    assert rig.gate.watchdog.should_engage(rig.vehicle)
    assert not rig.gate.machine.is_at_rest(rig.vehicle)
    assert not rig.request("acquire", "bob").granted
    rig.vehicle = vehicle_at(0.0)
    assert not rig.gate.watchdog.should_engage(rig.vehicle)
    assert rig.gate.machine.is_at_rest(rig.vehicle)


def test_the_next_stop_begins_with_the_planned_pedal() -> None:
    """After a stop in which the pedal was raised, the next stop begins with the planned pedal."""
    brake = StopBrake(LIMITS, MAX_BRAKING_MPS2)
    brake.pedal(vehicle_at(8.0), START_NS)
    assert brake.pedal(vehicle_at(8.0), START_NS + 900 * NS_PER_MS) == 1.0
    brake.reset()
    assert brake.pedal(vehicle_at(8.0), START_NS + NS_PER_S) == PLANNED_PEDAL
