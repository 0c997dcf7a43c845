"""The safety gate, the adapter and a software car together: control of the car after a stop."""

from __future__ import annotations

from tests.safety.rig import new_limiter
from tests.vehicle.dbw.rig import AdapterRig, both_generations, stationary_rig

from lavt.domain import SessionRequest
from lavt.safety.gate import SafetyGate
from lavt.safety.limits import LIMITS
from lavt.vehicle.software_car.state import Gear


def new_gate() -> SafetyGate:
    epochs = iter(range(1000))
    return SafetyGate(LIMITS, new_limiter(), new_epoch=lambda: next(epochs), new_token=lambda: b"token")


def decide(rig: AdapterRig, gate: SafetyGate) -> None:
    """Apply the gate's decision, as the actuator node does."""
    state = rig.adapter.state()
    rig.actuation = gate.watchdog.actuation(state, rig.now_ns)
    rig.adapter.engage(gate.watchdog.should_engage(state), rig.now_ns)


@both_generations
def test_a_driver_who_drives_off_after_an_emergency_stop_is_left_alone(generation: int) -> None:
    """The kit is not engaged again if a driver drives off by hand after an emergency stop, from standstill and PARK."""
    rig, gate = stationary_rig(generation), new_gate()
    rig.engage()
    assert gate.session.answer(SessionRequest("emergency_stop", "alice", 1, 7), rig.adapter.state(), rig.now_ns).granted
    for _ in range(2000):
        decide(rig, gate)
        rig.run_ms(1)
    assert (gate.state, rig.state) == ("emergency_stop", "idle")
    rig.sent.clear()
    rig.kit.driver_shifts(Gear.DRIVE, rig.now_ns)
    rig.kit.driver_throttles(0.2, rig.now_ns)
    for _ in range(2000):
        decide(rig, gate)
        rig.run_ms(1)
    assert not rig.sent
    assert rig.speed_mps > 0.1
