from __future__ import annotations

from typing import Any

from lavt.experiment.statistics.paired_error import common_p95_m, common_place, worst_rank_m


def run(by_10m: list[float] | None = None, **changes: Any) -> dict[str, Any]:
    return {"route": "a", "repetition": 0, "seed": 1, "valid": True, "p95_by_10m": by_10m, **changes}


def ended(ending: str, p95_m: float | None) -> dict[str, Any]:
    return {"ending": ending, "p95_m": p95_m}


def test_runs_are_compared_as_far_as_all_of_them_came() -> None:
    """Of runs of 30, 20 and, not valid, 10 m on one route and repetition, the P95 up to 20 m is taken."""
    far, near, invalid = run([0.1, 0.2, 9.0]), run([0.5, 0.6]), run([0.0], valid=False)
    places = common_place([far, near, invalid])
    assert common_p95_m([far], places) == [0.2]
    assert common_p95_m([near], places) == [0.6]


def test_each_repetition_has_a_common_place_of_its_own() -> None:
    """A run that ended early shortens the comparison of its own repetition, not of the others."""
    runs = [run([0.1, 0.2]), run([0.3]), run([0.4, 0.5], repetition=1, seed=2)]
    assert common_p95_m(runs, common_place(runs)) == [0.1, 0.3, 0.5]


def test_without_ten_metres_there_is_nothing_to_compare() -> None:
    """A run that ended within 10 m takes its repetition out of it; one of an older version stays out alone."""
    runs = [run([0.1]), run([]), run([0.4], repetition=1), run(None, repetition=1)]
    assert common_p95_m(runs, common_place(runs)) == [0.4]
    assert common_p95_m([], common_place([])) == []


def test_runs_not_completed_rank_last() -> None:
    """Of five runs with three completed, the quartiles are the second, the third, and none."""
    runs = [ended("completed", error_m) for error_m in (3.0, 1.0, 2.0)]
    runs += [ended("collision", 0.1), ended("timeout", 0.1)]
    assert worst_rank_m(runs) == {"p25": 2.0, "p50": 3.0, "p75": None}


def test_worst_ranks_of_little() -> None:
    """One completed run is every quartile; no runs, or none of known error, have none."""
    nothing = {"p25": None, "p50": None, "p75": None}
    assert worst_rank_m([ended("completed", 1.5)]) == {"p25": 1.5, "p50": 1.5, "p75": 1.5}
    assert worst_rank_m([ended("collision", 1.5)]) == nothing
    assert worst_rank_m([ended("completed", None)]) == nothing
    assert worst_rank_m([]) == nothing
