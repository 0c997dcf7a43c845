"""What every `Vehicle` keeps."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.nodes.stand_ins import MONO_NS, StandingVehicle

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.vehicle.sim.road import load_road
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.vehicle import Vehicle

ROAD = load_road("a_key")
VEHICLES: dict[str, Callable[[], Vehicle]] = {
    "simulator": lambda: Simulator(road=ROAD, seed=1, start_mono_ns=MONO_NS),
    "stand-in of the node tests": StandingVehicle,
}
each_vehicle = pytest.mark.parametrize("name", sorted(VEHICLES))


@each_vehicle
def test_its_time_goes_on_and_never_ahead(name: str) -> None:
    """A state's time never goes back, is not later than what was advanced to, and the next wake lies ahead of it."""
    vehicle = VEHICLES[name]()
    vehicle.advance(MONO_NS + 20 * NS_PER_MS)
    before_ns = vehicle.state().mono_ns
    for offset_ms in (20, 21, 21, 40, 500, 400, 501):
        vehicle.advance(MONO_NS + offset_ms * NS_PER_MS)
        assert before_ns <= vehicle.state().mono_ns
        assert vehicle.state().mono_ns <= MONO_NS + max(500, offset_ms) * NS_PER_MS
        before_ns = vehicle.state().mono_ns
        assert vehicle.next_wake_ns() > before_ns
    vehicle.advance(vehicle.next_wake_ns())
    assert vehicle.state().mono_ns > before_ns


@each_vehicle
def test_it_stands_until_commanded(name: str) -> None:
    """Without a command it stands, and nothing happens."""
    vehicle = VEHICLES[name]()
    assert vehicle.advance(MONO_NS + 3 * NS_PER_S) == []
    assert vehicle.state().speed_mps == 0


@each_vehicle
def test_its_capabilities_are_those_of_a_car(name: str) -> None:
    """Sizes and limits are positive and finite, and there is ground truth where it says so."""
    vehicle = VEHICLES[name]()
    can = vehicle.capabilities
    for value in (can.wheelbase_m, can.max_steering_rad, can.max_acceleration_mps2, can.max_braking_mps2):
        assert 0 < value < math.inf
    assert (vehicle.ground_truth() is not None) == can.ground_truth


@each_vehicle
@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(0, 1), st.floats(0, 1), st.integers(1, 800)), max_size=6))
def test_whatever_it_is_asked_its_state_is_finite(name: str, asked: list[tuple[float, float, float, int]]) -> None:
    """Any series of actuations within their ranges leaves a finite state, and the wheel within its limits."""
    vehicle, now_ns = VEHICLES[name](), MONO_NS
    for steering_rad, throttle, brake, ms in asked:
        vehicle.apply(Actuation(steering_rad, throttle, brake), now_ns)
        now_ns += ms * NS_PER_MS
        events = vehicle.advance(now_ns)
        assert [event.mono_ns for event in events] == sorted(event.mono_ns for event in events)
        state = vehicle.state()
        assert math.isfinite(state.speed_mps)
        assert abs(state.steering_rad) <= vehicle.capabilities.max_steering_rad + 1e-9
