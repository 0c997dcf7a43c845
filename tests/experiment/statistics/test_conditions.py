from __future__ import annotations

from typing import Any

import pytest

from lavt.experiment.statistics.conditions import common_distances, common_p95_m, own_lane_completion, worst_rank_m


def run(by_10m: list[float] | None = None, **changes: Any) -> dict[str, Any]:
    return {"route": "a", "repetition": 0, "seed": 1, "valid": True, "p95_by_10m": by_10m, **changes}


def run_with_ending(ending: str, p95_m: float | None) -> dict[str, Any]:
    return {"ending": ending, "p95_m": p95_m}


def test_runs_are_compared_over_their_common_distance() -> None:
    """For valid runs of 30 and 20 m and an invalid run of 10 m, the P95 up to 20 m is used."""
    long_run, short_run, invalid_run = run([0.1, 0.2, 9.0]), run([0.5, 0.6]), run([0.0], valid=False)
    distances = common_distances([long_run, short_run, invalid_run])
    assert common_p95_m([long_run], distances) == [0.2]
    assert common_p95_m([short_run], distances) == [0.6]


def test_each_repetition_has_its_own_common_distance() -> None:
    """A run that ended early shortens the common distance of the same repetition only."""
    runs = [run([0.1, 0.2]), run([0.3]), run([0.4, 0.5], repetition=1, seed=2)]
    assert common_p95_m(runs, common_distances(runs)) == [0.1, 0.3, 0.5]


def test_repetitions_with_under_ten_metres_are_left_out() -> None:
    """A run of under 10 m excludes its repetition; a result of an older version excludes only itself."""
    runs = [run([0.1]), run([]), run([0.4], repetition=1), run(None, repetition=1)]
    assert common_p95_m(runs, common_distances(runs)) == [0.4]
    assert common_p95_m([], common_distances([])) == []


def test_completion_in_the_own_lane() -> None:
    """One of two known runs kept its lane: the rate is a half; a run of an older version is left out."""
    runs = [run(completed_in_own_lane=True), run(completed_in_own_lane=False), run(completed_in_own_lane=None), run()]
    completion = own_lane_completion(runs)
    assert (completion["completed_in_own_lane"], completion["own_lane_completion_rate"]) == (1, 0.5)
    assert completion["own_lane_completion_interval"] == pytest.approx([0.0126, 0.9874], abs=1e-4)
    assert set(own_lane_completion([run()]).values()) == {None}


def test_runs_not_completed_rank_last() -> None:
    """With three of five runs completed, the quartiles are the second error, the third error, and null."""
    runs = [run_with_ending("completed", error_m) for error_m in (3.0, 1.0, 2.0)]
    runs += [run_with_ending("collision", 0.1), run_with_ending("timeout", 0.1)]
    assert worst_rank_m(runs) == {"p25": 2.0, "p50": 3.0, "p75": None}


def test_worst_ranks_of_few_runs() -> None:
    """One completed run is every quartile; without runs, or without a known error, the quartiles are null."""
    no_quartiles = {"p25": None, "p50": None, "p75": None}
    assert worst_rank_m([run_with_ending("completed", 1.5)]) == {"p25": 1.5, "p50": 1.5, "p75": 1.5}
    assert worst_rank_m([run_with_ending("collision", 1.5)]) == no_quartiles
    assert worst_rank_m([run_with_ending("completed", None)]) == no_quartiles
    assert worst_rank_m([]) == no_quartiles
