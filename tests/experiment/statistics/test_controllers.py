from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lavt.experiment.statistics.controllers import best_of, compare_controllers, compare_pairs

ROUTES = ("a", "a_key", "b", "b_key", "c", "c_key")


def run(kind: str, route: str = "a", *, condition: str = "H2", kept: bool = True, **changes: Any) -> dict[str, Any]:
    further_axes = changes.pop("axes", {})
    return {
        "time": "virtual",
        "fidelity": "geometry",
        "condition": condition,
        "route": route,
        "repetition": 0,
        "seed": 7,
        "valid": True,
        "completed_in_own_lane": kept,
        "p95_m": 0.1,
        "lateral_jerk_rms_mps3": 0.2,
        "steering_rate_rms_radps": 0.01,
        "distance_m": 100.0,
        "duration_s": 20.0,
        "axes": {"controller.kind": kind, **further_axes},
        **changes,
    }


def runs_of(kind: str, p95_m: float, **changes: Any) -> list[dict[str, Any]]:
    """Return a run on each route, each with another error."""
    return [run(kind, route, p95_m=p95_m + 0.01 * number, **changes) for number, route in enumerate(ROUTES)]


def test_controllers_are_compared_at_each_place() -> None:
    """Each condition and value of a further axis has an entry for each controller, with medians of valid runs."""
    runs = [
        *(run(kind, condition=condition) for condition in ("L3", "H2") for kind in ("smith", "predictive")),
        run("smith", condition="H2", p95_m=0.4, lateral_jerk_rms_mps3=0.6, kept=False, repetition=1),
        run("smith", condition="H2", p95_m=9.0, valid=False, repetition=2),
        *(run(kind, axes={"camera.rate_hz": 10.0}) for kind in ("smith", "predictive")),
    ]
    entries = compare_controllers(runs)
    places = [(entry["condition"], entry["axes"], entry["controller"]) for entry in entries]
    kinds = ("predictive", "smith")
    assert places == [
        *(("L3", {}, kind) for kind in kinds),
        *(("H2", {}, kind) for kind in kinds),
        *(("H2", {"camera.rate_hz": 10.0}, kind) for kind in kinds),
    ]
    smith = entries[3]
    assert (smith["runs"], smith["completed_in_own_lane"], smith["test"]) == (2, 1, None)
    assert smith["p95_m"] == pytest.approx(0.25)
    assert smith["lateral_jerk_rms_mps3"] == pytest.approx(0.4)
    assert smith["mean_speed_mps"] == 5.0


def test_there_is_no_comparison_without_several_controllers() -> None:
    """Sweeps that did not vary the controller have no entry, and the controller of a place alone has none."""
    assert compare_controllers([run("smith", axes={}), {**run("smith"), "axes": {"camera.rate_hz": 10.0}}]) == []
    assert compare_controllers([{**run("smith"), "axes": None}]) == []


def test_the_best_baseline_completes_most_and_errs_least() -> None:
    """Completion in the own lane counts first, then the median error."""
    by_kind = {
        "exact": [run("exact", p95_m=0.01, kept=False), run("exact", "b", p95_m=0.01)],
        "wide": [run("wide", p95_m=0.3), run("wide", "b", p95_m=0.3)],
        "narrow": [run("narrow", p95_m=0.2), run("narrow", "b", p95_m=0.2)],
    }
    assert best_of(by_kind) == "narrow"


def test_errors_are_tested_by_route() -> None:
    """On six routes with smaller errors, the exact test has p = 2 / 2^6, however often each route was driven."""
    subject = [*runs_of("predictive", 0.1), *runs_of("predictive", 0.1, repetition=1)]
    baseline = [*runs_of("smith", 0.15), *runs_of("smith", 0.17, repetition=1)]
    test = compare_pairs(subject, baseline)
    assert (test["pairs"], test["error_pairs"], test["routes"], test["roads"]) == (12, 12, 6, 3)
    assert test["p_error"] == test["smallest_p_error"] == 2 / 2**6
    assert test["p95_difference_m"] == pytest.approx(-0.06)
    assert (test["only_subject"], test["only_baseline"], test["p_completion"]) == (0, 0, 1.0)


def test_completion_is_tested_by_pairs() -> None:
    """Pairs that only one controller completed are tested, and have no part in the test of the error."""
    failed = [run("smith", route, kept=False) for route in ROUTES[:5]]
    test = compare_pairs(runs_of("predictive", 0.1), [*failed, run("smith", "c_key", p95_m=0.5)])
    assert (test["only_subject"], test["only_baseline"], test["p_completion"]) == (5, 0, 2 / 2**5)
    assert (test["error_pairs"], test["routes"], test["p_error"]) == (1, 1, 1.0)
    unpaired = compare_pairs(runs_of("predictive", 0.1), runs_of("smith", 0.1, seed=8))
    assert (unpaired["pairs"], unpaired["p_completion"], unpaired["p_error"]) == (0, None, None)


def test_the_tests_of_all_places_are_corrected_together() -> None:
    """With two places, Holm's correction doubles the smallest p value."""
    runs = [
        run_of_place
        for condition in ("L3", "H2")
        for run_of_place in (
            *runs_of("predictive", 0.1, condition=condition),
            *runs_of("smith", 0.2, condition=condition),
        )
    ]
    tests = [entry["test"] for entry in compare_controllers(runs) if entry["controller"] == "predictive"]
    assert [test["p_error_holm"] for test in tests] == [4 / 2**6] * 2
    assert [test["p_completion_holm"] for test in tests] == [1.0] * 2


def test_the_comparison_is_defined_in_the_documentation() -> None:
    """`docs/metrics.md` has each key of an entry and of its test."""
    page = (Path(__file__).parents[3] / "docs" / "metrics.md").read_text()
    entry = compare_controllers([*runs_of("predictive", 0.1), *runs_of("smith", 0.2)])[0]
    keys = {*entry, *entry["test"]} - {"time", "fidelity", "condition", "axes", "controller", "runs"}
    assert {key for key in keys if f"`{key}`" not in page} == set()
