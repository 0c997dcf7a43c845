from __future__ import annotations

from typing import Any

from lavt.experiment.report.sentences import (
    contrast_sentence,
    length_sentences,
    limits_sentences,
    results_sentences,
    runs_overview,
)

INJECTED = {"L0": (0, 0), "L1": (75, 0), "L2": (150, 0), "L3": (225, 0), "L4": (150, 75), "L5": (225, 100)}


def entry(name: str, rate: float, loop_ms: float | None, p95_m: float | None = 0.1) -> dict[str, Any]:
    video, control = INJECTED[name]
    return {
        "runs": 30,
        "completed": round(30 * rate),
        "completion_rate": rate,
        "completion_interval": [max(rate - 0.1, 0.0), min(rate + 0.1, 1.0)],
        "p95_m": p95_m,
        "loop_ms": {"p50": loop_ms},
        "injected_ms": {"video": video, "control": control},
    }


def conditions(*rates: float) -> dict[str, dict[str, Any]]:
    return {name: entry(name, rate, 72.0 + sum(INJECTED[name])) for name, rate in zip(INJECTED, rates, strict=False)}


def test_the_results_name_the_largest_fall_of_completion() -> None:
    """The results name the two conditions with the largest fall, and the latency at which half of the runs fail."""
    text = results_sentences("Virtual time", conditions(1.0, 1.0, 0.8, 0.3, 0.3, 0.0))
    assert "L2 80 % (222 ms), L3 30 % (297 ms)" in text
    assert "80 % at L2 to 30 % at L3, between 222 and 297 ms" in text
    assert "At 297 ms, and at each longer latency, fewer than half" in text


def test_equal_falls_are_all_named() -> None:
    """If two falls are the largest, both are named."""
    text = results_sentences("Virtual time", conditions(1.0, 0.5, 0.5, 0.0))
    assert "from 100 % at L0 to 50 % at L1, between 72 and 147 ms" in text
    assert ", and from 50 % at L2 to 0 % at L3, between 222 and 297 ms" in text


def test_the_error_is_that_of_the_headline_figure() -> None:
    """If the error of all runs is known, it is named; else that of the completed runs."""
    known = conditions(1.0, 0.5)
    assert "0.10 m at L0, 0.10 m at L1, of the completed runs (mean)" in results_sentences("It", known)
    for name, mean_m in (("L0", 0.05), ("L1", 5.5)):
        known[name]["by_road"] = {"p95_all_runs_m": {"mean": mean_m}}
    assert "0.05 m at L0, 5.50 m at L1, of all runs, each up to its own end (mean over roads)" in (
        results_sentences("It", known)
    )


def test_no_fall_is_reported_if_there_is_none() -> None:
    """Constant completion has a sentence; with one condition no fall is named; without conditions there is no text."""
    assert "does not fall" in results_sentences("It", conditions(1.0, 1.0, 1.0))
    assert "fall" not in results_sentences("It", conditions(1.0))
    assert results_sentences("It", {}) == ""
    assert results_sentences("It", {"L0": entry("L0", 1.0, None)}) == ""


def test_many_routes_and_conditions_are_counted() -> None:
    """A few names are listed, many names are only counted, and the number of invalid runs is given."""
    runs = [{"time": "virtual", "route": f"r{index}", "condition": "L0", "valid": index > 0} for index in range(20)]
    text = runs_overview(runs)
    assert all(part in text for part in ("20 runs in virtual time", "on 20 routes", "L0", "1 run is invalid"))
    assert "All runs are valid" in runs_overview(runs[1:])


def test_each_kind_of_run_has_its_own_routes() -> None:
    """The overview gives the number of runs and the routes of each kind of time."""
    runs = [{"time": "virtual", "route": f"r{index}", "condition": "L0", "valid": True} for index in range(4)]
    text = runs_overview([*runs, {"time": "real", "route": "a", "condition": "L5", "valid": True}])
    assert text.startswith(
        "4 runs in virtual time by video on 4 routes and 1 run in real time by video on the route a,"
    )


def test_conditions_with_equal_loop_latency_are_sorted_by_name() -> None:
    """Conditions whose loop latencies differ by at most 3 ms are treated as equally slow.

    This rule also applies to the sentence "At ... ms, fewer than half".
    """
    rates = {"L2": (222.5, 0.9), "L3": (297.6, 0.53), "L4": (297.4, 0.47), "L5": (397.3, 0.1)}
    conditions = {
        name: {"loop_ms": {"p50": loop_ms}, "completion_rate": rate, "p95_m": None}
        for name, (loop_ms, rate) in rates.items()
    }
    text = results_sentences("Virtual time", conditions)
    assert "L3 53 % (298 ms), L4 47 % (297 ms), L5 10 % (397 ms)" in text
    assert "90 % at L2 to 47 % at L4, between 222 and 297 ms" in text
    assert "At 397 ms, the longest latency, fewer than half" in text
    conditions["L3"]["completion_rate"] = 0.49
    assert "At 297 ms, and at each longer latency, fewer than half" in results_sentences("Virtual time", conditions)


def test_a_fall_is_between_two_latencies() -> None:
    """A difference between conditions with equal loop latency is not reported as a fall."""
    rates = {"L3": (297.6, 0.9), "L4": (297.4, 0.1)}
    conditions = {
        name: {"loop_ms": {"p50": loop_ms}, "completion_rate": rate, "p95_m": None}
        for name, (loop_ms, rate) in rates.items()
    }
    assert "fall" not in results_sentences("Virtual time", conditions)


def test_single_runs_are_an_example() -> None:
    """Conditions with one run each have no percentage and no fall."""
    single = {
        name: {**entry(name, rate, loop_ms), "runs": 1}
        for name, rate, loop_ms in (("L0", 1.0, 11.0), ("L5", 0.0, 341.0))
    }
    text = results_sentences("Real time", single)
    assert (
        text == "Real time, one run for each condition, as an example: L0 completed (11 ms), L5 not completed (341 ms)."
    )


def test_completion_is_judged_in_the_own_lane() -> None:
    """If it is known, the completion in the own lane counts, not that in any lane."""
    known = {name: {**value, "own_lane_completion_rate": 0.0} for name, value in conditions(1.0, 1.0).items()}
    assert (
        "in their own lane by condition (30 runs each), with the median loop latency: L0 0 % (72 ms)"
        in results_sentences("It", known)
    )
    known["L0"]["own_lane_completion_rate"] = None
    assert "Runs completed by condition" in results_sentences("It", known)


def contrast(a: str, b: str, p: float | None, *, for_a: int = 0, for_b: int = 0, roads: int = 6) -> dict[str, Any]:
    return {"a": a, "b": b, "roads": roads, "roads_for_a": for_a, "roads_for_b": for_b, "p_by_road_holm": p}


def test_a_test_by_road_that_cannot_be_significant_says_so() -> None:
    """With six contrasts on six roads, the smallest p after Holm's correction is 6 times 2 times 0.5 to the 6th."""
    text = contrast_sentence([contrast("L0", f"L{index}", 1.0) for index in range(6)])
    assert "none could be: 6 roads are too few, because even if all agreed, p would be 0.19" in text
    text = contrast_sentence([contrast("L0", "L1", 1.0, roads=10)])
    assert "no planned contrast of completion in any lane is significant (10 roads), which does not show" in text
    assert contrast_sentence([contrast("L0", "L1", None)]) == contrast_sentence([]) == ""


def test_significant_contrasts_are_named_with_their_direction() -> None:
    """A significant contrast names the condition with more completed runs first; the others are counted."""
    text = contrast_sentence(
        [contrast("L2", "L3", 0.002, for_a=9), contrast("L3", "L5", 0.01, for_b=8), contrast("L0", "L1", 1.0)]
    )
    assert "more runs are completed at L2 than at L3 (p = 0.002), L5 than at L3 (p = 0.01)" in text
    assert "the other 1 contrast is not significant" in text


LENGTHS_M = {"r1": 582.0, "r2": 187.0, "r3": 328.0, "r4": 677.0, "r5": 140.0, "r6": 229.0}


def completed_on(*routes: str) -> dict[str, Any]:
    counts = {name: int(name in routes) for name in LENGTHS_M}
    rows = {name: {"runs": 1, "completed": 1, "completed_in_own_lane": count} for name, count in counts.items()}
    return {"completion_rate": 1.0, "own_lane_completion_rate": len(routes) / 6, "routes": rows}


def test_longer_roads_that_fail_first_are_named() -> None:
    """If only the shorter routes are completed in the own lane, the lengths and the chance of this order are given."""
    split = {"L0": completed_on(*LENGTHS_M), "L3": completed_on("r2", "r5"), "L4": completed_on("r2", "r5")}
    text = length_sentences(split, LENGTHS_M)
    assert text.count("Only shorter roads are completed") == 1
    assert "at L3 and L4, every run is completed in its own lane on the 2 shorter routes (140 to 187 m)" in text
    assert "not on the 4 longer ones (229 to 677 m)" in text
    assert "1 in 15." in text


def test_an_order_by_length_is_not_assumed() -> None:
    """Nothing is said if a longer route is completed, if chance explains the order, or if routes share a road."""
    assert length_sentences({"L3": completed_on("r2", "r3")}, LENGTHS_M) == ""
    assert length_sentences({"L3": completed_on("r1", "r3", "r4", "r6")}, LENGTHS_M) == ""
    assert length_sentences({"L3": completed_on("r2", "r3", "r5", "r6", "r1")}, LENGTHS_M) == ""
    assert length_sentences({"L0": completed_on(*LENGTHS_M), "L5": completed_on()}, LENGTHS_M) == ""
    shared = completed_on("r2", "r5")
    shared["routes"]["r2_key"] = shared["routes"].pop("r5")
    lengths_m = {**LENGTHS_M, "r2_key": 140.0}
    assert length_sentences({"L3": shared}, lengths_m) == ""


def test_what_was_not_shown_follows_from_the_runs() -> None:
    """The limits of fitted gains, missing pictures and a loopback are named only where they apply to the runs."""
    demo = {"preset": "paper_calibrated", "fidelity": "geometry", "inherent": "loopback"}
    text = limits_sentences([demo, {**demo, "fidelity": "video"}])
    assert text.startswith("Not shown: where driving fails for another controller or car")
    assert "what errors of lane detection do, in the runs without pictures" in text
    assert "the latency of a real network" in text
    by_video = limits_sentences([{**demo, "preset": "designed", "fidelity": "video"}])
    assert "controller" not in by_video
    assert "pictures" not in by_video
    assert limits_sentences([{"preset": "designed", "fidelity": "video", "inherent": "network"}]) == ""
