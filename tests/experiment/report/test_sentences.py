from __future__ import annotations

from typing import Any

from lavt.experiment.report import sentences
from lavt.experiment.report.sentences import (
    difference_sentences,
    equal_total_sentences,
    results_sentences,
    runs_overview,
)
from lavt.experiment.statistics.paper_results import paper

INJECTED = {"L0": (0, 0), "L1": (75, 0), "L2": (150, 0), "L3": (225, 0), "L4": (150, 75), "L5": (225, 100)}
PAPER = paper()


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


def contrast(only_a: int, only_b: int, p: float) -> dict[str, Any]:
    return {"a": "L3", "b": "L4", "pairs": 30, "only_a": only_a, "only_b": only_b, "p": p, "p_holm": p}


def test_the_results_name_the_largest_fall_of_completion() -> None:
    """The results name the two conditions with the largest fall, and the latency at which half of the runs fail."""
    text = results_sentences("Virtual time", conditions(1.0, 1.0, 0.8, 0.3, 0.3, 0.0))
    assert "L2 80 % (222 ms), L3 30 % (297 ms)" in text
    assert "80 % at L2 to 30 % at L3, between 222 and 297 ms" in text
    assert "At 297 ms and above, fewer than half" in text


def test_no_fall_is_reported_if_there_is_none() -> None:
    """Constant completion is reported as such; one condition has no fall; no condition gives no text."""
    assert "Completion does not fall" in results_sentences("It", conditions(1.0, 1.0, 1.0))
    assert "fall" not in results_sentences("It", conditions(1.0))
    assert results_sentences("It", {}) == ""
    assert results_sentences("It", {"L0": entry("L0", 1.0, None)}) == ""


def test_many_routes_and_conditions_are_counted() -> None:
    """A few names are listed, many are counted, and the number of invalid runs is given."""
    runs = [{"time": "virtual", "route": f"r{index}", "condition": "L0", "valid": index > 0} for index in range(20)]
    text = runs_overview(runs)
    assert all(part in text for part in ("20 runs in virtual time", "20 routes", "L0", "1 run is invalid"))
    assert "All runs are valid" in runs_overview(runs[1:])


def test_equal_total_delay_means_equal_loop_latency() -> None:
    """The report explains why conditions with equal total delay and loop latency do not differ."""
    (text,) = equal_total_sentences([contrast(1, 0, 1.0)], conditions(1, 1, 1, 0.3, 0.3, 0), PAPER["contrasts"])
    for part in (
        "L3 (225 + 0 ms)",
        "L4 (150 + 75 ms)",
        "total delay, 225 ms",
        "same loop latency",
        "29 of 30 pairs",
        "p 0.78",
    ):
        assert part in text


def test_sentences_do_not_contradict_the_data() -> None:
    """If conditions with equal total delay differ in completion or loop latency, no equal loop is claimed."""
    entries = conditions(1, 1, 1, 0.9, 0.3, 0)
    (unequal_completion,) = equal_total_sentences([contrast(18, 0, 0.001)], entries, [])
    assert "completion differs significantly" in unequal_completion
    assert "same loop" not in unequal_completion
    (unequal_loops,) = equal_total_sentences([contrast(1, 0, 1.0)], {**entries, "L4": entry("L4", 0.3, 350.0)}, [])
    assert "same loop" not in unequal_loops
    unequal_totals = [{**contrast(0, 0, 1.0), "a": "L2"}]
    assert equal_total_sentences(unequal_totals, entries, []) == []
    assert equal_total_sentences([{**contrast(0, 0, 1.0), "p_holm": None}], entries, []) == []


def test_differences_from_the_paper_match_the_data() -> None:
    """Each difference is reported only if the data show it, and none if a condition of the paper is missing."""
    with_sharp_fall = difference_sentences(conditions(1.0, 1.0, 1.0, 0.3, 0.3, 0.0), PAPER["conditions"])
    for parts in (
        ("sharply", "(100, 100, 100, 30, 30, 0 %)", "(100, 93,"),
        ("P95 at L0", "0.10 m here", "2.30 m in the paper"),
        ("0.10 m here", "13.15 m in the paper", "rails"),
        ("All runs are completed at L1 here", "28 of 30"),
    ):
        assert any(all(part in sentence for part in parts) for sentence in with_sharp_fall), parts
    like_the_paper = {
        name: entry(name, paper_condition["completion_rate"], 100.0, paper_condition["p95_m"])
        for name, paper_condition in PAPER["conditions"].items()
    }
    text = " ".join(difference_sentences(like_the_paper, PAPER["conditions"]))
    assert "sharply" not in text
    assert "rails" not in text
    assert "All runs are completed" not in text
    assert "gains" in text
    assert difference_sentences(conditions(1.0, 1.0), PAPER["conditions"]) == []
    steady = " ".join(difference_sentences(conditions(1.0, 1.0, 1.0, 1.0, 1.0, 1.0), PAPER["conditions"]))
    assert "sharply" not in steady
    assert "rails" not in steady
    few_runs = {name: {**condition, "runs": 5} for name, condition in conditions(1.0, 1.0, 1.0, 0.3, 0.3, 0.0).items()}
    assert difference_sentences(few_runs, PAPER["conditions"]) == []


def test_conditions_with_equal_loop_latency_are_sorted_by_name() -> None:
    """Loop latencies that differ by half a millisecond count as equal, also for the latency at which half fail."""
    rates = {"L2": (222.5, 0.9), "L3": (297.6, 0.53), "L4": (297.4, 0.47), "L5": (397.3, 0.1)}
    conditions = {
        name: {"loop_ms": {"p50": loop_ms}, "completion_rate": rate, "p95_m": None}
        for name, (loop_ms, rate) in rates.items()
    }
    text = results_sentences("Virtual time", conditions)
    assert "L3 53 % (298 ms), L4 47 % (297 ms), L5 10 % (397 ms)" in text
    assert "90 % at L2 to 47 % at L4, between 222 and 297 ms" in text
    assert "At 397 ms and above, fewer than half" in text
    conditions["L3"]["completion_rate"] = 0.49
    assert "At 297 ms and above, fewer than half" in results_sentences("Virtual time", conditions)


def test_a_fall_is_between_two_latencies() -> None:
    """A difference between conditions with equal loop latency is not reported as a fall."""
    rates = {"L3": (297.6, 0.9), "L4": (297.4, 0.1)}
    conditions = {
        name: {"loop_ms": {"p50": loop_ms}, "completion_rate": rate, "p95_m": None}
        for name, (loop_ms, rate) in rates.items()
    }
    assert "fall" not in results_sentences("Virtual time", conditions)


def test_significant_differences_from_the_paper_are_named() -> None:
    """A condition whose interval does not overlap with the paper's is named, with both shares."""
    theirs = {"L2": {"completion_interval": [0.31, 0.69], "completion_rate": 0.5}}
    ours: Any = {"L2": {"completion_interval": [0.73, 0.98], "completion_rate": 0.9}}
    assert "higher at L2 (90 %, paper 50 %)" in sentences._unequal_completion(ours, theirs)
    ours["L2"]["completion_interval"] = [0.6, 0.9]
    assert "overlap" in sentences._unequal_completion(ours, theirs)
    assert "L2" not in sentences._unequal_completion(ours, theirs)
