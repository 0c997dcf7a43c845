from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.realtime.conftest import BUSY_SHARE, LONG_STALL_MS
from tests.support.stalls import Shared, Stalls

from lavt.clock import MachineClock
from lavt.experiment.plan import PlannedRun
from lavt.experiment.run import run_once

REPETITIONS = range(3)


@dataclass(frozen=True)
class Agreeing:
    """Results of the same drives in real and in virtual time, and when the real ones were."""

    real: list[dict[str, Any]]
    virtual: list[dict[str, Any]]
    since_ns: int
    until_ns: int


def drive_once(planned: PlannedRun, out: Path) -> dict[str, Any]:
    return run_once(planned, out)


@pytest.fixture(scope="module")
def drives(
    tmp_path_factory: pytest.TempPathFactory, planned: Callable[..., PlannedRun], stalls: Stalls
) -> Shared[Agreeing]:
    """Three drives under L1, each in real and in virtual time with the same seed."""
    clock, out = MachineClock(), tmp_path_factory.mktemp("virtual")
    runs = [planned("network.condition=L1", "time=virtual", repetition=number) for number in REPETITIONS]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        virtual = list(pool.map(drive_once, runs, [out / str(number) for number in REPETITIONS]))

    def drive() -> Agreeing:
        real_out, since_ns = tmp_path_factory.mktemp("real"), clock.now().mono_ns
        runs = [planned("network.condition=L1", repetition=number) for number in REPETITIONS]
        real = [drive_once(run, real_out / str(number)) for number, run in enumerate(runs)]
        return Agreeing(real, virtual, since_ns, clock.now().mono_ns)

    return Shared(stalls, drive)


@pytest.fixture
def agreeing(drives: Shared[Agreeing]) -> Agreeing:
    return drives.get()


def test_the_same_seed_ends_the_same_way_in_real_and_in_virtual_time(agreeing: Agreeing, stalls: Stalls) -> None:
    """Three drives under L1 have the same seeds and the same endings in real and in virtual time."""
    assert [each["seed"] for each in agreeing.real] == [each["seed"] for each in agreeing.virtual]
    with stalls.judging(agreeing.since_ns, agreeing.until_ns, stall_ms=LONG_STALL_MS):
        assert [each["ending"] for each in agreeing.real] == [each["ending"] for each in agreeing.virtual]


@pytest.mark.parametrize("latency", ["tau_v_ms", "tau_c_ms", "loop_ms"])
def test_latencies_in_virtual_time_are_those_of_real_time(agreeing: Agreeing, stalls: Stalls, latency: str) -> None:
    """The medians of video, control and loop latency in real and in virtual time are within 5 ms."""
    real_ms, virtual_ms = (
        np.median([each[latency]["p50"] for each in results]) for results in (agreeing.real, agreeing.virtual)
    )

    with stalls.judging(agreeing.since_ns, agreeing.until_ns, share=BUSY_SHARE):
        assert abs(real_ms - virtual_ms) < 5


def test_the_car_keeps_its_lane_as_well_in_virtual_time(agreeing: Agreeing, stalls: Stalls) -> None:
    """The mean P95 cross-track of the drives in virtual time is within 30 % of that in real time."""
    real_m, virtual_m = (np.mean([each["p95_m"] for each in results]) for results in (agreeing.real, agreeing.virtual))

    with stalls.judging(agreeing.since_ns, agreeing.until_ns, stall_ms=LONG_STALL_MS):
        assert abs(real_m - virtual_m) < 0.3 * real_m
