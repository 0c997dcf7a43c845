"""The contract that every `Vehicle` satisfies."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from tests.carla.contract_vehicle import contract_vehicle
from tests.nodes.stand_ins import MONO_NS, FakeVehicle

from lavt.assembly.by_wire import build_inside
from lavt.config import DbwConfig, ServerConfig, VehicleConfig
from lavt.domain import NS_PER_S, Actuation, Now, VehicleState
from lavt.vehicle import contract
from lavt.vehicle.contract import ContractLimits
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.vehicle import Vehicle

ROAD = load_road("a_key")


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


@each_vehicle
def test_state_times_and_wake_times(name: str) -> None:
    """A state's time never decreases and never exceeds the time of `advance`; the next wake is after the state."""
    assert contract.check_times(VEHICLES[name](), MONO_NS) == []


@each_vehicle
def test_a_vehicle_is_stationary_until_commanded(name: str) -> None:
    """Without a command the vehicle is stationary and has no events."""
    assert contract.check_rest(VEHICLES[name](), MONO_NS) == []


@each_vehicle
def test_capabilities(name: str) -> None:
    """Sizes and limits are positive and finite, and there is ground truth if and only if the capabilities say so."""
    assert contract.check_capabilities(VEHICLES[name](), MONO_NS) == []


@each_vehicle
@settings(max_examples=15)
@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(0, 1), st.floats(0, 1), st.integers(1, 800)), max_size=6))
def test_any_actuation_leaves_a_finite_state(name: str, requested: list[tuple[float, float, float, int]]) -> None:
    """Any actuations within their ranges leave a finite state and a steering angle within the limits."""
    assert contract.check_actuations(VEHICLES[name](), MONO_NS, requested) == []


@each_drivable
def test_an_engaged_vehicle_follows_commands(name: str) -> None:
    """A stationary, braked vehicle engages within 3 s, and then accelerates and turns as commanded."""
    assert contract.check_following(DRIVABLE[name](), MONO_NS, ContractLimits()) == []


@each_drivable
def test_a_disengaged_vehicle_stays_stationary(name: str) -> None:
    """A driving vehicle that is disengaged and braked stops, and then remains stationary."""
    assert contract.check_disengaging(DRIVABLE[name](), MONO_NS, ContractLimits()) == []


def simulator(start_ns: int) -> Simulator:
    return Simulator(road=ROAD, seed=1, start_mono_ns=start_ns)


class Crawling(Simulator):
    """A car that moves without a command."""

    def state(self) -> VehicleState:
        """Return a state with a small speed."""
        return replace(super().state(), speed_mps=0.01)


class TimeTraveller(Simulator):
    """A car whose states are ahead of time, so that its wakes are in the past."""

    def state(self) -> VehicleState:
        """Return a state of the future."""
        state = super().state()
        return replace(state, mono_ns=state.mono_ns + NS_PER_S)


class Unlimited(Simulator):
    """A car that reports a steering angle beyond its limit, and a speed that is no number."""

    def state(self) -> VehicleState:
        """Return an impossible state."""
        return replace(super().state(), steering_rad=0.9, speed_mps=math.nan)


class Deaf(Simulator):
    """A car that executes no command and never engages."""

    def apply(self, actuation: Actuation, now_ns: int) -> None:
        """Do nothing."""

    def state(self) -> VehicleState:
        """Return a state that is not engaged."""
        return replace(super().state(), is_engaged=False)


class Brakeless(Simulator):
    """A car whose brake does nothing."""

    def apply(self, actuation: Actuation, now_ns: int) -> None:
        """Apply all but the brake."""
        super().apply(Actuation(actuation.steering_rad, actuation.throttle, 0.0), now_ns)


FAULTS: dict[type[Simulator], set[str]] = {
    Crawling: {"stationary until commanded", "stops when disengaged"},
    TimeTraveller: {"times of states and wakes"},
    Unlimited: {"any command leaves a finite state"},
    Deaf: {"follows commands", "stops when disengaged"},
    Brakeless: {"stops when disengaged"},
}


@pytest.mark.parametrize("kind", FAULTS)
def test_the_checks_find_faults(kind: type[Simulator]) -> None:
    """A car with a fault fails the checks that are about it, with sentences."""
    results = contract.check_contract(lambda start_ns: kind(road=ROAD, seed=1, start_mono_ns=start_ns), MONO_NS)
    assert FAULTS[kind] <= {result.name for result in results if result.violations}


def test_limits_are_those_of_a_vehicle() -> None:
    """The built-in car passes all checks with the default limits, and fails those of a faster car."""
    assert not [result for result in contract.check_contract(simulator, MONO_NS) if result.violations]
    faster = ContractLimits(speed_mps=(3.0, 5.0), full_throttle_mps=6.0)
    failed = {result.name for result in contract.check_contract(simulator, MONO_NS, faster) if result.violations}
    assert failed == {"follows commands", "stops when disengaged"}
