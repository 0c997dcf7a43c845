"""The contract that every `Vehicle` satisfies."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.carla.contract_vehicle import contract_vehicle
from tests.nodes.stand_ins import MONO_NS, FakeVehicle

from lavt.assembly.by_wire import build_inside
from lavt.config import DbwConfig, ServerConfig, VehicleConfig
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, Now
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.vehicle import Vehicle

ROAD = load_road("a_key")
MAX_PERIOD_NS = 20 * NS_PER_MS
BRAKE = Actuation(0.0, 0.0, 1.0)


def by_wire(profile: str) -> Vehicle:
    dbw = DbwConfig(profile=profile, interface="inside", steering_sign=1)
    return build_inside(ServerConfig(vehicle=VehicleConfig(kind="dbw", dbw=dbw)), ROAD, Now(MONO_NS, 0))


CARLA = "carla, in a stand-in server"
DRIVABLE: dict[str, Callable[[], Vehicle]] = {
    "simulator": lambda: Simulator(road=ROAD, seed=1, start_mono_ns=MONO_NS),
    CARLA: lambda: contract_vehicle(MONO_NS),
    "dataspeed_gen1": lambda: by_wire("dataspeed_gen1"),
    "dataspeed_gen2": lambda: by_wire("dataspeed_gen2"),
}
VEHICLES: dict[str, Callable[[], Vehicle]] = {**DRIVABLE, "fake of the node tests": FakeVehicle}
SLOW = {CARLA}
"""Vehicles whose tests start a server."""


def each_of(vehicles: Iterable[str]) -> pytest.MarkDecorator:
    """Parametrize a test by vehicles; the tests of slow ones are in the full lane."""
    marks = {name: [pytest.mark.full] if name in SLOW else [] for name in sorted(vehicles)}
    return pytest.mark.parametrize("name", [pytest.param(name, marks=of_name) for name, of_name in marks.items()])


each_vehicle, each_drivable = each_of(VEHICLES), each_of(DRIVABLE)


def run(vehicle: Vehicle, start_ns: int, actuation: Actuation, *, should_engage: bool, seconds: float) -> int:
    """Call the vehicle as the actuator node does, at each wake time, and return the end time."""
    now_ns, end_ns = start_ns, start_ns + round(seconds * NS_PER_S)
    while now_ns < end_ns:
        vehicle.advance(now_ns)
        vehicle.engage(should_engage, now_ns)
        vehicle.apply(actuation, now_ns)
        now_ns = min(max(vehicle.next_wake_ns(), now_ns + 1), now_ns + MAX_PERIOD_NS, end_ns)
    vehicle.advance(end_ns)
    return end_ns


@each_vehicle
def test_state_times_and_wake_times(name: str) -> None:
    """A state's time never decreases and never exceeds the time of `advance`; the next wake is after the state."""
    vehicle = VEHICLES[name]()
    vehicle.advance(MONO_NS + 20 * NS_PER_MS)
    before_ns, latest_ms = vehicle.state().mono_ns, 20
    for offset_ms in (20, 21, 21, 40, 500, 400, 501):
        vehicle.advance(MONO_NS + offset_ms * NS_PER_MS)
        latest_ms = max(latest_ms, offset_ms)
        assert before_ns <= vehicle.state().mono_ns <= MONO_NS + latest_ms * NS_PER_MS
        before_ns = vehicle.state().mono_ns
        assert vehicle.next_wake_ns() > before_ns
    while vehicle.next_wake_ns() <= MONO_NS + 601 * NS_PER_MS:
        vehicle.advance(vehicle.next_wake_ns())
    assert vehicle.state().mono_ns > before_ns


@each_vehicle
def test_a_vehicle_is_stationary_until_commanded(name: str) -> None:
    """Without a command the vehicle is stationary and has no events."""
    vehicle = VEHICLES[name]()
    assert vehicle.advance(MONO_NS + 3 * NS_PER_S) == []
    assert vehicle.state().speed_mps == 0


@each_vehicle
def test_capabilities(name: str) -> None:
    """Sizes and limits are positive and finite, and there is ground truth if and only if the capabilities say so."""
    vehicle = VEHICLES[name]()
    capabilities = vehicle.capabilities
    for value in (
        capabilities.wheelbase_m,
        capabilities.max_steering_rad,
        capabilities.max_acceleration_mps2,
        capabilities.max_braking_mps2,
    ):
        assert 0 < value < math.inf
    assert (vehicle.ground_truth() is not None) == capabilities.ground_truth


@each_vehicle
@settings(max_examples=15)
@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(0, 1), st.floats(0, 1), st.integers(1, 800)), max_size=6))
def test_any_actuation_leaves_a_finite_state(name: str, requested: list[tuple[float, float, float, int]]) -> None:
    """Any actuations within their ranges leave a finite state and a steering angle within the limits."""
    vehicle, now_ns = VEHICLES[name](), MONO_NS
    for steering_rad, throttle, brake, duration_ms in requested:
        vehicle.apply(Actuation(steering_rad, throttle, brake), now_ns)
        now_ns += duration_ms * NS_PER_MS
        events = vehicle.advance(now_ns)
        assert [event.mono_ns for event in events] == sorted(event.mono_ns for event in events)
        state = vehicle.state()
        assert math.isfinite(state.speed_mps)
        assert abs(state.steering_rad) <= vehicle.capabilities.max_steering_rad + 1e-9


@each_drivable
def test_an_engaged_vehicle_follows_commands(name: str) -> None:
    """A stationary, braked vehicle engages within 3 s, and then accelerates and turns as commanded."""
    vehicle = DRIVABLE[name]()
    now_ns = run(vehicle, MONO_NS, BRAKE, should_engage=False, seconds=0.5)
    assert vehicle.state().inhibit_reason == ""
    now_ns = run(vehicle, now_ns, BRAKE, should_engage=True, seconds=3)
    state = vehicle.state()
    assert (state.is_engaged, state.inhibit_reason, state.is_overridden, state.gear) == (True, "", False, "drive")
    run(vehicle, now_ns, Actuation(0.05, 0.5, 0.0), should_engage=True, seconds=2)
    state = vehicle.state()
    assert 1.0 < state.speed_mps < 2.0, "1 m/s2 for 2 s, minus the lags"
    assert state.steering_rad == pytest.approx(0.05, abs=0.002)
    truth = vehicle.ground_truth()
    assert truth is not None
    assert truth.steering_rad == pytest.approx(0.05, abs=0.002)


@each_drivable
def test_a_disengaged_vehicle_stays_stationary(name: str) -> None:
    """A driving vehicle that is disengaged and braked stops, and then remains stationary."""
    vehicle = DRIVABLE[name]()
    now_ns = run(vehicle, MONO_NS, BRAKE, should_engage=False, seconds=0.5)
    now_ns = run(vehicle, now_ns, BRAKE, should_engage=True, seconds=3)
    now_ns = run(vehicle, now_ns, Actuation(0.0, 1.0, 0.0), should_engage=True, seconds=2)
    assert vehicle.state().speed_mps > 2
    now_ns = run(vehicle, now_ns, BRAKE, should_engage=False, seconds=3)
    assert vehicle.state().speed_mps == 0
    run(vehicle, now_ns, BRAKE, should_engage=False, seconds=1)
    truth = vehicle.ground_truth()
    assert truth is not None
    assert truth.speed_mps == 0
