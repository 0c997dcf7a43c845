"""Wrong speeds while driving: the car stops, whatever is reported, and is not parked before it is stationary."""

from __future__ import annotations

import itertools

import pytest
from tests.vehicle.dbw.rig import (
    COARSE_MS,
    SPEED_SOURCES,
    AdapterRig,
    driving_rig,
    mostly_generation_2,
    stationary_rig,
    with_one_speed,
)
from tests.vehicle.dbw.test_adapter_and_gate import decide, new_gate

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.safety.gate import SafetyGate
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.speed_monitor import FULL_BRAKE_NS
from lavt.vehicle.software_car.state import Gear

GEAR_COMMAND = {1: 0x066, 2: 0x203}
SPEED_REPORT = {1: 0x065, 2: 0x107}


def fast_rig(generation: int) -> tuple[AdapterRig, SafetyGate]:
    """Return a car that drives at 8.3 m/s, and a gate in the state `driving`."""
    rig = driving_rig(generation)
    rig.simulator._car.motion.speed_mps = 8.3
    rig.actuation = Actuation(0.0, 0.1, 0.0)
    rig.run_ms(100, step_ms=COARSE_MS)
    gate = new_gate()
    gate.machine.state = "driving"
    gate.watchdog.should_engage(rig.adapter.state())
    rig.sent.clear()
    return rig, gate


def run(rig: AdapterRig, gate: SafetyGate, duration_ns: int) -> None:
    """Let the gate decide for a time, as the actuator node does; check that no moving car is requested to park."""
    for _ in range(duration_ns // (COARSE_MS * NS_PER_MS)):
        decide(rig, gate)
        rig.run_ms(COARSE_MS, step_ms=COARSE_MS)
        if rig.speed_mps > 0.2:
            assert not requests_a_gear(rig)


def requests_a_gear(rig: AdapterRig) -> bool:
    """Return whether a gear is requested by the newest frames, those of the last two steps."""
    newest = itertools.takewhile(lambda sent: rig.now_ns - sent[0] < 2 * COARSE_MS * NS_PER_MS, reversed(rig.sent))
    return GEAR_COMMAND[rig.generation] in {frame.identifier for _, frame in newest}


@mostly_generation_2
@pytest.mark.parametrize("stuck_mps", [0.0, 3.0])
def test_a_stuck_speed_stops_the_car(generation: int, stuck_mps: float) -> None:
    """A speed stuck at 0 or at 3 m/s while the car drives at 8.3 m/s is a fault: full brake, and no PARK before
    every speed is 0.
    """
    rig, gate = fast_rig(generation)
    rig.kit.stick_speed("speed", stuck_mps)
    run(rig, gate, NS_PER_S)
    state = rig.adapter.state()
    assert (gate.state, state.is_speed_plausible) == ("safe_stop", False)
    assert state.inhibit_reason
    assert state.speed_mps > 2.0
    assert rig.kit.state.brake == pytest.approx(1.0, abs=1e-3)
    assert any(name.startswith("speed_") for name in rig.adapter.counts)
    assert {event.kind for event in rig.events} == {"fault"}
    run(rig, gate, 12 * NS_PER_S)
    assert rig.speed_mps == 0.0
    assert rig.kit.state.gear == (Gear.PARK if stuck_mps == 0.0 else Gear.DRIVE)
    assert rig.adapter.state().is_speed_plausible == (stuck_mps == 0.0)
    if stuck_mps:
        assert rig.kit.state.brake == pytest.approx(1.0, abs=1e-3)
        rig.kit.restore_speed("speed")
        run(rig, gate, 5 * NS_PER_S)
        assert rig.kit.state.gear == Gear.PARK


@mostly_generation_2
def test_all_speeds_stuck_at_zero(generation: int) -> None:
    """Even if all speeds drop to 0, the car brakes fully for long enough to stop before it is parked."""
    rig, gate = fast_rig(generation)
    for source in SPEED_SOURCES[generation]:
        rig.kit.stick_speed(source, 0.0)
    run(rig, gate, FULL_BRAKE_NS)
    assert rig.speed_mps == 0.0
    assert rig.kit.state.gear == Gear.DRIVE
    run(rig, gate, 2 * NS_PER_S)
    assert (rig.kit.state.gear, rig.state) == (Gear.PARK, "idle")


def with_speeds_stuck_at_zero(generation: int) -> tuple[AdapterRig, SafetyGate]:
    """Return a stationary engaged car whose reported speeds stay 0, and a gate in the state `driving`."""
    rig, gate = stationary_rig(generation).copy(), new_gate()
    rig.engage()
    for source in SPEED_SOURCES[generation]:
        rig.kit.stick_speed(source, 0.0)
    gate.machine.state = "driving"
    gate.watchdog.should_engage(rig.adapter.state())
    rig.sent.clear()
    return rig, gate


@mostly_generation_2
@pytest.mark.parametrize(
    "throttle", [*(pytest.param(throttle, marks=pytest.mark.full) for throttle in (0.1, 0.2)), 0.45, 1.0]
)
def test_all_speeds_stuck_at_zero_since_standstill(generation: int, throttle: float) -> None:
    """If all speeds stay 0 while the car drives off, the drive ends before it is faster than 3 m/s, whatever the
    throttle; the car is not parked before it is stationary.
    """
    rig, gate = with_speeds_stuck_at_zero(generation)
    rig.actuation = Actuation(0.0, throttle, 0.0)
    rig.run_until(lambda rig: not rig.adapter.state().is_speed_plausible, 40_000, step_ms=COARSE_MS)
    assert 1.0 < rig.speed_mps < 3.0
    run(rig, gate, 11 * NS_PER_S)
    assert gate.state == "safe_stop"
    assert (rig.speed_mps, rig.kit.state.gear) == (0.0, Gear.PARK)


@mostly_generation_2
@pytest.mark.parametrize(("brake_share", "coasting_ms"), [(1.0, 0), (1.0, 2000), (0.5, 0), (0.5, 2000), (0.3, 0)])
def test_a_stop_before_stuck_speeds_are_found(generation: int, brake_share: float, coasting_ms: int) -> None:
    """If all speeds stay 0 and the drive ends before this is found, the car is not parked before it is stationary, not
    even with weak brakes.
    """
    rig, gate = with_speeds_stuck_at_zero(generation)
    rig.kit.weaken_brake(brake_share)
    rig.actuation = Actuation(0.0, 0.45, 0.0)
    rig.run_ms(2500, step_ms=COARSE_MS)
    rig.actuation = Actuation(0.0, 0.0, 0.0)
    rig.run_ms(coasting_ms, step_ms=COARSE_MS)
    assert rig.speed_mps > 1.4
    gate.machine.trigger("stop requested")
    run(rig, gate, 6 * NS_PER_S)
    assert (rig.speed_mps, rig.kit.state.gear) == (0.0, Gear.PARK)
    assert not any(name.startswith("speed_") for name in rig.adapter.counts)


@mostly_generation_2
@pytest.mark.parametrize(("brake_share", "speed_mps"), [(0.5, 2.5), (0.25, 2.2)])
def test_a_parked_car_with_weak_brakes_and_stuck_speeds(generation: int, brake_share: float, speed_mps: float) -> None:
    """If all speeds stay 0 and driving is no longer wanted, even a car that the holding brake slows by a quarter of
    what the profile says is not parked before it is stationary.
    """
    rig, _ = with_speeds_stuck_at_zero(generation)
    rig.kit.weaken_brake(brake_share)
    rig.actuation = Actuation(0.0, 1.0, 0.0)
    rig.run_ms(1370, step_ms=COARSE_MS)
    rig.simulator._car.motion.speed_mps = speed_mps  # as of a drive train that answers without delay
    rig.actuation = Actuation(0.0, 0.0, 0.0)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(requests_a_gear, 10_000)
    assert rig.speed_mps == 0.0


@mostly_generation_2
def test_wheels_that_lock_on_ice(generation: int) -> None:
    """A car that slides on ice with locked wheels is not parked before it is stationary."""
    rig, gate = stationary_rig(generation).copy(), new_gate()
    rig.engage()
    rig.actuation = Actuation(0.0, 0.5, 0.0)
    rig.run_until(lambda rig: rig.speed_mps >= 2.6, step_ms=COARSE_MS)
    rig.kit.weaken_brake(0.8 / 6)
    rig.actuation = Actuation(0.0, 0.0, 1.0)
    rig.run_until(lambda rig: rig.speed_mps <= 2.4)
    for source in SPEED_SOURCES[generation]:
        rig.kit.stick_speed(source, 0.0)
    rig.sent.clear()
    gate.machine.state = "emergency_stop"
    run(rig, gate, 5 * NS_PER_S)
    assert (rig.speed_mps, rig.kit.state.gear) == (0.0, Gear.PARK)
    assert not any(name.startswith("speed_") for name in rig.adapter.counts)


@mostly_generation_2
@pytest.mark.parametrize("speed_mps", [0.0, 3.0])
def test_a_stuck_speed_under_throttle(generation: int, speed_mps: float) -> None:
    """A speed that is stuck at the start, or at 3 m/s, ends the drive before the car is much faster."""
    rig = stationary_rig(generation)
    rig.engage()
    rig.actuation = Actuation(0.0, 1.0, 0.0)
    rig.run_until(lambda rig: rig.speed_mps >= speed_mps, 5000, step_ms=COARSE_MS)
    rig.kit.stick_speed("speed")
    rig.run_until(lambda rig: rig.state == "lost", 4000, step_ms=COARSE_MS)
    assert rig.speed_mps < speed_mps + 3.5
    assert not rig.adapter.state().is_speed_plausible


@mostly_generation_2
def test_a_stuck_speed_of_a_kit_with_one_speed(generation: int) -> None:
    """If the kit reports only one speed, this speed, stuck at 3 m/s under throttle, still ends the drive."""
    rig = AdapterRig(generation, profile=with_one_speed(generation))
    rig.engage()
    rig.actuation = Actuation(0.0, 0.5, 0.0)
    rig.run_until(lambda rig: rig.speed_mps >= 3.0, 5000, step_ms=COARSE_MS)
    rig.kit.stick_speed("speed")
    rig.run_until(lambda rig: rig.state == "lost", 4000, step_ms=COARSE_MS)
    assert rig.speed_mps < 6.0
    assert not rig.adapter.state().is_speed_plausible


@mostly_generation_2
def test_a_scaled_speed_stops_the_car(generation: int) -> None:
    """A reported speed that becomes half the real speed is a fault."""
    rig, gate = fast_rig(generation)
    rig.kit.scale_speed("speed", 0.5)
    run(rig, gate, NS_PER_S)
    assert (gate.state, rig.adapter.state().is_speed_plausible) == ("safe_stop", False)


@mostly_generation_2
@pytest.mark.parametrize("source", ["speed", "wheel_speed"])
def test_a_missing_speed_stops_the_car(generation: int, source: str) -> None:
    """A speed or wheel speeds that are no longer reported stop the car."""
    rig, gate = fast_rig(generation)
    rig.kit.drop_speed(source)
    run(rig, gate, 4 * NS_PER_S)
    assert gate.state == "safe_stop"
    assert rig.speed_mps == 0.0
    assert rig.kit.state.gear == Gear.DRIVE
    assert not rig.adapter.state().is_engaged


@mostly_generation_2
def test_unknown_wheel_speeds_stop_the_car(generation: int) -> None:
    """Wheel speeds that are reported as unknown stop the car, like missing wheel speeds."""
    rig, gate = fast_rig(generation)
    rig.kit.set_unknown("wheel_speed")
    run(rig, gate, 4 * NS_PER_S)
    assert (gate.state, rig.speed_mps) == ("safe_stop", 0.0)


@mostly_generation_2
def test_a_safe_stop_with_weak_brakes_brakes_fully(generation: int) -> None:
    """If the brake has half its force, a safe stop presses it fully, and the speed is no fault."""
    rig, gate = fast_rig(generation)
    rig.kit.weaken_brake(0.5)
    gate.machine.trigger("stop requested")
    run(rig, gate, 2 * NS_PER_S)
    assert rig.kit.state.brake == pytest.approx(1.0, abs=1e-3)
    run(rig, gate, 3 * NS_PER_S)
    assert (rig.speed_mps, rig.kit.state.gear) == (0.0, Gear.PARK)
    assert not any(name.startswith("speed_") for name in rig.adapter.counts)


@mostly_generation_2
def test_a_safe_stop_with_good_brakes_leaves_grip_for_steering(generation: int) -> None:
    """A safe stop that decelerates as wanted does not press the brake further, and raises no fault."""
    rig, gate = fast_rig(generation)
    gate.machine.trigger("stop requested")
    brakes = []
    while rig.speed_mps > 0.0:
        run(rig, gate, 10 * NS_PER_MS)
        brakes.append(rig.kit.state.brake)
    assert max(brakes) == pytest.approx(2 / 3, abs=0.01)
    assert not any(name.startswith("speed_") for name in rig.adapter.counts)


def test_a_repeated_report_is_no_report() -> None:
    """Reports of generation 2 whose counter does not change are treated as missing."""
    rig = driving_rig(2)
    first: list[CanFrame] = []

    def repeat(frame: CanFrame) -> bool:
        if frame.identifier == SPEED_REPORT[2]:
            first.append(frame)
            rig.adapter.receive(first[0], rig.now_ns)
            return True
        return False

    rig.lose_report = repeat
    rig.run_until(lambda rig: rig.state == "lost", 400)
    assert rig.adapter.counts["repeated_counter"] > 5
    assert "VehicleVelocity" in rig.adapter.state().inhibit_reason
