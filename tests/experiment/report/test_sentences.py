from __future__ import annotations

from typing import Any

from lavt.experiment.report import sentences
from lavt.experiment.report.sentences import differences, equal_totals, headline, what_was_driven
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


def test_the_headline_says_where_completion_falls() -> None:
    """It names the two conditions with the largest fall, by their loop latency, and from where on half are lost."""
    said = headline("Virtual time", conditions(1.0, 1.0, 0.8, 0.3, 0.3, 0.0))
    assert "L2 80 % (222 ms), L3 30 % (297 ms)" in said
    assert "The largest fall is from 80 % at L2 to 30 % at L3: between 222 and 297 ms in all." in said
    assert "from 297 ms on" in said


def test_no_fall_is_told_where_there_is_none() -> None:
    """Where completion stays, the headline says so; of one condition it says nothing of a fall; of none, nothing."""
    assert "Completion does not fall with latency." in headline("It", conditions(1.0, 1.0, 1.0))
    assert "fall" not in headline("It", conditions(1.0))
    assert headline("It", {}) == ""
    assert headline("It", {"L0": entry("L0", 1.0, None)}) == ""


def test_many_routes_and_conditions_are_counted() -> None:
    """Few names are listed, many are counted, and runs that are not valid are told."""
    runs = [{"time": "virtual", "route": f"r{index}", "condition": "L0", "valid": index > 0} for index in range(20)]
    said = what_was_driven(runs)
    assert all(part in said for part in ("20 runs", "20 routes", "L0", "1 not valid"))
    assert "All of them count" in what_was_driven(runs[1:])


def test_equal_total_delay_is_the_same_loop() -> None:
    """Of conditions of equal total delay and equal loop the report says why they cannot be told apart."""
    (said,) = equal_totals([contrast(1, 0, 1.0)], conditions(1, 1, 1, 0.3, 0.3, 0), PAPER["contrasts"])
    for part in ("L3 (225 + 0 ms)", "L4 (150 + 75 ms)", "total, 225 ms", "same loop", "29 of 30 pairs", "p 0.78"):
        assert part in said


def test_what_the_data_contradict_is_not_said() -> None:
    """Where equal totals differ significantly, or their loops do, the sentence on the same loop is not there."""
    of = conditions(1, 1, 1, 0.9, 0.3, 0)
    (told_apart,) = equal_totals([contrast(18, 0, 0.001)], of, [])
    assert "they can be told apart" in told_apart
    assert "same loop" not in told_apart
    (other_loops,) = equal_totals([contrast(1, 0, 1.0)], {**of, "L4": entry("L4", 0.3, 350.0)}, [])
    assert "same loop" not in other_loops
    unequal = [{**contrast(0, 0, 1.0), "a": "L2"}]
    assert equal_totals(unequal, of, []) == []
    assert equal_totals([{**contrast(0, 0, 1.0), "p_holm": None}], of, []) == []


def test_differences_are_told_where_they_are_true() -> None:
    """Each reason stands only where the numbers are so, and none where a condition of the paper was not driven."""
    sharp = differences(conditions(1.0, 1.0, 1.0, 0.3, 0.3, 0.0), PAPER["conditions"])
    for parts in (
        ("sharply", "(100, 100, 100, 30, 30, 0 %)", "(100, 93,"),
        ("P95 at L0", "0.10 m here", "2.30 m in the paper"),
        ("0.10 m here", "13.15 m in the paper", "rails"),
        ("L1", "completed in full here", "28 times of 30"),
    ):
        assert any(all(part in each for part in parts) for each in sharp), parts
    like = {
        name: entry(name, theirs["completion_rate"], 100.0, theirs["p95_m"])
        for name, theirs in PAPER["conditions"].items()
    }
    told = " ".join(differences(like, PAPER["conditions"]))
    assert "sharply" not in told
    assert "rails" not in told
    assert "completed in full here" not in told
    assert "gains" in told
    assert differences(conditions(1.0, 1.0), PAPER["conditions"]) == []
    steady = " ".join(differences(conditions(1.0, 1.0, 1.0, 1.0, 1.0, 1.0), PAPER["conditions"]))
    assert "sharply" not in steady
    assert "rails" not in steady
    few = {name: {**each, "runs": 5} for name, each in conditions(1.0, 1.0, 1.0, 0.3, 0.3, 0.0).items()}
    assert differences(few, PAPER["conditions"]) == []


def test_conditions_of_one_loop_stand_in_the_order_of_their_names() -> None:
    """Two conditions half a millisecond apart are one place: what is said to hold from there on holds for both."""
    rates = {"L2": (222.5, 0.9), "L3": (297.6, 0.53), "L4": (297.4, 0.47), "L5": (397.3, 0.1)}
    conditions = {
        name: {"loop_ms": {"p50": loop_ms}, "completion_rate": rate, "p95_m": None}
        for name, (loop_ms, rate) in rates.items()
    }
    said = headline("Virtual time", conditions)
    assert "L3 53 % (298 ms), L4 47 % (297 ms), L5 10 % (397 ms)" in said
    assert "90 % at L2 to 47 % at L4: between 222 and 297 ms" in said
    assert "from 397 ms on" in said
    conditions["L3"]["completion_rate"] = 0.49
    assert "from 297 ms on" in headline("Virtual time", conditions)


def test_a_fall_is_between_two_places() -> None:
    """Conditions of one loop that fare unlike are no fall with latency."""
    rates = {"L3": (297.6, 0.9), "L4": (297.4, 0.1)}
    conditions = {
        name: {"loop_ms": {"p50": loop_ms}, "completion_rate": rate, "p95_m": None}
        for name, (loop_ms, rate) in rates.items()
    }
    assert "fall" not in headline("Virtual time", conditions)


def test_what_chance_does_not_explain_is_named() -> None:
    """A condition whose interval does not overlap with the paper's is named, with both shares; else all overlap."""
    theirs = {"L2": {"completion_interval": [0.31, 0.69], "completion_rate": 0.5}}
    ours: Any = {"L2": {"completion_interval": [0.73, 0.98], "completion_rate": 0.9}}
    assert "more at L2 (90 % against 50 %)" in sentences._apart(ours, theirs)
    ours["L2"]["completion_interval"] = [0.6, 0.9]
    assert "overlap" in sentences._apart(ours, theirs)
    assert "L2" not in sentences._apart(ours, theirs)
