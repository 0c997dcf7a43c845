"""The whole by-wire vehicle with a hostile bus, a hostile car and stalls: invariants of the adapter."""

from __future__ import annotations

import gc
from collections import Counter
from typing import Literal, get_args

import pytest
from tests.vehicle.dbw.fuzzer import run_ticks

from lavt.vehicle.dbw import speed_monitor
from lavt.vehicle.dbw.states import State

QUICK_SEEDS, FULL_SEEDS = 2, 15
"""The number of runs of each generation in the quick lane and in the full lane."""
TICKS = 1500
"""The number of ticks of a run. A thousand ticks take about half a second."""
MAX_NEW_OBJECTS = 300


@pytest.mark.parametrize("generation", [1, 2])
@pytest.mark.parametrize("seeds", [QUICK_SEEDS, pytest.param(FULL_SEEDS, marks=pytest.mark.full)])
def test_the_vehicle_keeps_its_invariants(generation: Literal[1, 2], seeds: int) -> None:
    """Whatever happens, nothing raises, no state is reached twice at one instant, and every command is within limits.

    `fuzzer.py` checks this in each tick. All states are reached.
    """
    states: Counter[str] = Counter()
    for seed in range(seeds):
        states += run_ticks(generation, seed, TICKS).states
    assert set(states) == set(get_args(State))


def test_a_request_for_park_while_the_car_moves_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """If any brake were taken to stop the car, the fuzzer would find that PARK is requested while the car moves."""
    monkeypatch.setattr(speed_monitor, "SURE_BRAKE_SHARE", 100.0)
    monkeypatch.setattr(speed_monitor, "ICE_BRAKING_MPS2", 100.0)
    with pytest.raises(AssertionError, match="PARK was requested at"):
        _ = [run_ticks(1, seed, 700) for seed in range(7, 50)]


@pytest.mark.parametrize("generation", [1, 2])
def test_nothing_grows(generation: Literal[1, 2]) -> None:
    """The number of objects does not grow with the number of ticks."""
    counts = []
    for ticks in (300, 1200):
        fuzzer = run_ticks(generation, 1, ticks)
        gc.collect()
        counts.append(len(gc.get_objects()))
        del fuzzer
    after_few_ticks, after_many_ticks = counts
    assert after_many_ticks - after_few_ticks < MAX_NEW_OBJECTS
