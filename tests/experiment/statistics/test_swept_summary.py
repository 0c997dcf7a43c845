"""Tests of the summary of a small driven sweep: the keys on which the report and users rely, and consistent values."""

from __future__ import annotations

from typing import Any

import pytest
from tests.support.summary_keys import CONDITION_KEYS, RUN_KEYS

from lavt.config import SweepConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.analysis.results import read_json, write_json
from lavt.experiment.runs.plan import plan_sweep
from lavt.experiment.statistics.summary import summarize
from lavt.experiment.sweep.sweep import run_all

CHANGES = ("fidelity=geometry", "conditions=[L0, L1]", "routes=[a_key, b_key]", "repetitions=1")

ROUTE_KEYS = {
    "runs",
    "completed",
    "completion_rate",
    "completion_interval",
    "completed_in_own_lane",
    "p95_m",
    "followed_p95_m",
    "p95_common_m",
}


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return the summary of four driven runs without pixels."""
    planned = plan_sweep(load_config(SweepConfig, shipped("configs/paper.yaml"), CHANGES))
    driven, speed = run_all(planned, tmp_path_factory.mktemp("sweep"), jobs=1, on_progress=lambda _: None)
    path = tmp_path_factory.mktemp("summary") / "summary.json"
    write_json(path, summarize(list(driven.results), speed))
    return read_json(path)


def test_every_key_is_present(summary: Any) -> None:
    """Runs, conditions, routes, groups, contrasts and the paper have the keys on which the report and users rely."""
    assert all(run.keys() >= RUN_KEYS and run["valid"] for run in summary["runs"])
    for conditions in (summary["conditions"], *(group["conditions"] for group in summary["groups"])):
        assert list(conditions) == ["L0", "L1"]
        for condition in conditions.values():
            assert condition.keys() == CONDITION_KEYS
            assert list(condition["routes"]) == list(condition["survival"]) == ["a_key", "b_key"]
            assert all(route.keys() == ROUTE_KEYS for route in condition["routes"].values())
    assert [contrast.keys() for contrast in summary["contrasts"]] == [
        {
            *("a", "b", "pairs", "only_a", "only_b", "p", "p_holm"),
            *("roads", "roads_for_a", "roads_for_b", "p_by_road", "p_by_road_holm"),
        }
    ]
    assert summary["contrasts"][0]["pairs"] == 2
    assert summary["paper"]["conditions"]["L1"]["completed"] == 28


def test_without_delay_the_own_lane_is_kept(summary: Any) -> None:
    """At L0 and L1, the runs are completed in their own lane, with equal errors against both lanes."""
    for run in summary["runs"]:
        assert run["completed_in_own_lane"]
        assert run["lane_kept"]["own_lane_share"] == 1.0
        assert run["lane_kept"]["lane_width_m"] == pytest.approx(3.5)
        assert run["followed_p95_m"] == pytest.approx(run["p95_m"])
    assert summary["conditions"]["L1"]["own_lane_completion_rate"] == 1.0
    assert summary["conditions"]["L1"]["invasion_free_completion_rate"] == 1.0


def test_stage_latencies_add_up_to_the_loop_latency(summary: Any) -> None:
    """In virtual time, median stage latencies from stamp to actuator add up to the loop latency within 3 ms."""
    for run in summary["runs"]:
        sum_ms = sum(stage["p50"] for stage in run["stages_ms"])
        assert sum_ms == pytest.approx(run["loop_ms"]["p50"], abs=3.0)
        assert run["age_at_actuation_ms"]["p50"] >= run["loop_ms"]["p50"]


def test_a_completed_run_has_all_partial_errors(summary: Any) -> None:
    """A completed run has a P95 for every full 10 m driven, and its distance is the route's length within 5 m."""
    for run in summary["runs"]:
        assert run["ending"] == "completed"
        assert len(run["p95_by_10m"]) == int(run["distance_m"] // 10)
        assert run["distance_m"] == pytest.approx(run["route_length_m"], abs=5.0)
