from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lavt.experiment.plan import PlannedRun
from lavt.experiment.run import run_once

REPETITIONS = range(3)
Results = dict[str, list[dict[str, Any]]]


def drive_virtually(planned: PlannedRun, out: Path) -> dict[str, Any]:
    return run_once(planned, out)


@pytest.fixture(scope="module")
def agreeing(
    tmp_path_factory: pytest.TempPathFactory, planned: Callable[..., PlannedRun], real_drive: Callable[..., Any]
) -> Results:
    """Three drives under L1, each in real and in virtual time with the same seed."""
    out = tmp_path_factory.mktemp("virtual")
    real = [real_drive(planned("network.condition=L1", repetition=number)).result for number in REPETITIONS]
    runs = [planned("network.condition=L1", "time=virtual", repetition=number) for number in REPETITIONS]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        virtual = list(pool.map(drive_virtually, runs, [out / str(number) for number in REPETITIONS]))
    return {"real": real, "virtual": virtual}


def test_the_same_seed_ends_the_same_way_in_real_and_in_virtual_time(agreeing: Results) -> None:
    """Three drives under L1 have the same seeds and the same endings in real and in virtual time."""
    for name in ("seed", "ending"):
        assert [each[name] for each in agreeing["real"]] == [each[name] for each in agreeing["virtual"]]


@pytest.mark.parametrize("latency", ["tau_v_ms", "tau_c_ms", "loop_ms"])
def test_latencies_in_virtual_time_are_those_of_real_time(agreeing: Results, latency: str) -> None:
    """The medians of video, control and loop latency in real and in virtual time are within 5 ms."""
    real_ms, virtual_ms = (np.median([each[latency]["p50"] for each in agreeing[time]]) for time in agreeing)

    assert abs(real_ms - virtual_ms) < 5


def test_the_car_keeps_its_lane_as_well_in_virtual_time(agreeing: Results) -> None:
    """The mean P95 cross-track of the drives in virtual time is within 30 % of that in real time."""
    real_m, virtual_m = (np.mean([each["p95_m"] for each in agreeing[time]]) for time in agreeing)

    assert abs(real_m - virtual_m) < 0.3 * real_m
