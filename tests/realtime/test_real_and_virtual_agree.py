"""Compare the demo's drives at L0 and L5 in real time with those in virtual time."""

from __future__ import annotations

from typing import Any

import pytest
from tests.realtime.conftest import Demo
from tests.support.stalls import BUSY_SHARE, LONG_STALL_MS, Stalls

CONDITIONS = ("L0", "L5")
COMPARED = (("tau_v_ms", "L0"), ("tau_v_ms", "L5"), ("tau_c_ms", "L0"), ("tau_c_ms", "L5"), ("loop_ms", "L0"))
"""The loop latency at L5 is not compared. There the car leaves its lane, and encoding and perception take longer than
the times in `configs/costs.yaml`, which were measured in the lane (perception takes 3.1 ms instead of 2.1 ms)."""


def pair(demo: Demo, condition: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the results in real and in virtual time."""
    results = {run["time"]: run for run in demo.summary["runs"] if run["condition"] == condition}
    return results["real"], results["virtual"]


@pytest.mark.parametrize("condition", CONDITIONS)
def test_the_same_drive_has_the_same_seed(demo: Demo, condition: str) -> None:
    """A drive has the same seed in real and in virtual time."""
    real, virtual = pair(demo, condition)
    assert real["seed"] == virtual["seed"]


@pytest.mark.parametrize(("latency", "condition"), COMPARED)
def test_latencies_agree_in_real_and_virtual_time(demo: Demo, stalls: Stalls, condition: str, latency: str) -> None:
    """The medians of video, control and loop latency in real and in virtual time are within 5 ms."""
    real, virtual = pair(demo, condition)
    with stalls.excusing_failures(demo.since_ns, demo.until_ns, share=BUSY_SHARE):
        assert abs(real[latency]["p50"] - virtual[latency]["p50"]) < 5


def test_lane_keeping_agrees_in_real_and_virtual_time(demo: Demo, stalls: Stalls) -> None:
    """Without delay a drive ends the same way, and its P95 cross-track error is within 30 % of that in real time."""
    real, virtual = pair(demo, "L0")
    with stalls.excusing_failures(demo.since_ns, demo.until_ns, stall_ms=LONG_STALL_MS):
        assert real["ending"] == virtual["ending"]
        assert abs(real["p95_m"] - virtual["p95_m"]) < 0.3 * real["p95_m"]
