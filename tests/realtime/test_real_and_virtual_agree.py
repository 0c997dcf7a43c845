"""Compare the demo's drives at L0 and L5 in real time with the same drives in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.realtime.conftest import Demo
from tests.support.stalls import BUSY_SHARE, LONG_STALL_MS, Stalls

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once

CONDITIONS = ("L0", "L5")
INJECTED_FLOWS = {"tau_v_ms": ("video",), "tau_c_ms": ("control",), "loop_ms": ("video", "control")}
"""For each latency, the flows whose injected delay it contains."""
COMPUTATION = ("encode", "decode", "perceive")
"""The stages whose durations depend most on the machine's speed. In virtual time the durations are those of
`configs/costs.yaml`, which were measured on one machine, with the car in its lane."""


Pair = Callable[[str], tuple[dict[str, Any], dict[str, Any]]]


@pytest.fixture(scope="module")
def virtual(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Return the results of the demo's drives in virtual time, by condition."""
    out = tmp_path_factory.mktemp("virtual")
    plans = {
        name: plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), [f"network.condition={name}"]))
        for name in CONDITIONS
    }
    return {name: run_once(planned, out / name) for name, planned in plans.items()}


@pytest.fixture
def pair(demo: Demo, virtual: dict[str, dict[str, Any]]) -> Pair:
    """Return a function that gives the results under a condition: in real time, in virtual time."""
    real = {run["condition"]: run for run in demo.summary["runs"] if run["time"] == "real"}
    return lambda condition: (real[condition], virtual[condition])


@pytest.mark.parametrize("condition", CONDITIONS)
def test_the_same_drive_has_the_same_seed(pair: Pair, condition: str) -> None:
    """A drive has the same seed in real and in virtual time."""
    real, virtual = pair(condition)
    assert real["seed"] == virtual["seed"]


def computation_ms(result: dict[str, Any]) -> float:
    """Return the sum of the medians of the stages that depend on the machine's speed."""
    return sum(float(stage["p50"]) for stage in result["stages_ms"] if stage["stage"] in COMPUTATION)


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("latency", INJECTED_FLOWS)
def test_latencies_agree_in_real_and_virtual_time(
    demo: Demo, pair: Pair, stalls: Stalls, condition: str, latency: str
) -> None:
    """The medians of video, control and loop latency in real and in virtual time are within 5 ms.

    The part of the virtual latency that is not injected is first scaled to the machine's speed in the real drive.
    """
    real, virtual = pair(condition)
    injected_ms = sum(virtual["injected_ms"][flow] for flow in INJECTED_FLOWS[latency])
    slowness = computation_ms(real) / computation_ms(virtual)
    expected_ms = injected_ms + slowness * (virtual[latency]["p50"] - injected_ms)
    with stalls.excusing_failures(demo.since_ns, demo.until_ns, share=BUSY_SHARE):
        assert abs(real[latency]["p50"] - expected_ms) < 5, f"the machine took {slowness:.2f} times as long"


def test_lane_keeping_agrees_in_real_and_virtual_time(demo: Demo, pair: Pair, stalls: Stalls) -> None:
    """Without delay, both drives have the same ending, and P95 cross-track errors that differ by less than 30 %."""
    real, virtual = pair("L0")
    with stalls.excusing_failures(demo.since_ns, demo.until_ns, stall_ms=LONG_STALL_MS):
        assert real["ending"] == virtual["ending"]
        assert abs(real["p95_m"] - virtual["p95_m"]) < 0.3 * real["p95_m"]
