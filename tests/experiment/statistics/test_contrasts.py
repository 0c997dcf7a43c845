from __future__ import annotations

from typing import Any

import pytest

from lavt.experiment.statistics.contrasts import fisher, mcnemar, paired_contrasts
from lavt.experiment.statistics.paper_results import paper


def runs(condition: str, endings: str, **changes: Any) -> list[dict[str, Any]]:
    """Return a run for each letter: c completed, x collision."""
    endings_of = {"c": "completed", "x": "collision"}
    return [
        {
            "condition": condition,
            "route": "a",
            "repetition": index,
            "seed": 100 + index,
            "valid": True,
            "ending": endings_of[letter],
            **changes,
        }
        for index, letter in enumerate(endings)
    ]


def test_mcnemars_p_value() -> None:
    """If 5 pairs differ in one direction, p is 2 / 2^5; if 3 differ in one and 1 in the other, 10 / 16; if none, 1."""
    assert mcnemar(5, 0) == pytest.approx(0.0625)
    assert mcnemar(3, 1) == pytest.approx(0.625)
    assert mcnemar(0, 0) == 1.0


def test_fishers_p_value() -> None:
    """For two of two successes against none of two, p is 1 / 3."""
    assert fisher(2, 2, 0, 2) == pytest.approx(1 / 3)


def test_a_contrast_pairs_runs_of_one_route_repetition_and_seed() -> None:
    """Runs of equal route, repetition and seed are paired in any order; pairs that differ are counted by condition."""
    contrasts = paired_contrasts([*runs("L0", "ccccccx"), *reversed(runs("L1", "cxxxxxc"))])
    p_of_5_against_1 = 14 / 64
    assert contrasts == [
        {
            "a": "L0",
            "b": "L1",
            "pairs": 7,
            "only_a": 5,
            "only_b": 1,
            "p": pytest.approx(p_of_5_against_1),
            "p_holm": p_of_5_against_1,
            "roads": 1,
            "roads_for_a": 1,
            "roads_for_b": 0,
            "p_by_road": 1.0,
            "p_by_road_holm": 1.0,
        }
    ]


def test_the_sign_test_counts_each_road_once() -> None:
    """A route and its key part are one road; six roads for one condition give p = 2 / 2^6, three give 0.25."""
    roads = [*"abcdef"]
    good = [run for road in roads for route in (road, f"{road}_key") for run in runs("L0", "ccc", route=route)]
    bad = [run for road in roads for route in (road, f"{road}_key") for run in runs("L1", "xxc", route=route)]
    (contrast,) = paired_contrasts([*good, *bad])
    assert (contrast["pairs"], contrast["roads"], contrast["roads_for_a"], contrast["roads_for_b"]) == (36, 6, 6, 0)
    assert contrast["p"] == pytest.approx(2 / 2**24)
    assert contrast["p_by_road"] == pytest.approx(2 / 2**6)
    (few,) = paired_contrasts([run for run in (*good, *bad) if run["route"][0] in "abc"])
    assert few["p_by_road"] == pytest.approx(0.25)


def test_roads_without_a_difference_do_not_count() -> None:
    """A road with one pair for each condition is a tie; Holm's correction covers the tests by road."""
    tie = [*runs("L0", "cx", route="a"), *runs("L1", "xc", route="a")]
    contrasts = paired_contrasts([*tie, *runs("L0", "cc", route="b"), *runs("L1", "xc", route="b")])
    assert [contrasts[0][key] for key in ("roads", "roads_for_a", "roads_for_b", "p_by_road")] == [2, 1, 0, 1.0]


def test_holms_correction_is_over_all_contrasts() -> None:
    """Of two p values, 0.0625 and 1, the smaller is doubled; a condition that was not driven has no contrast."""
    contrasts = paired_contrasts([*runs("L0", "ccccc"), *runs("L1", "ccccc"), *runs("L2", "xxxxx")])
    assert [(contrast["a"], contrast["b"], contrast["p_holm"]) for contrast in contrasts] == [
        ("L0", "L1", 1.0),
        ("L1", "L2", pytest.approx(0.125)),
    ]


def test_runs_without_a_partner_are_ignored() -> None:
    """Invalid runs, runs with other seeds and duplicate runs form no pairs; without pairs, p is null."""
    invalid = paired_contrasts([*runs("L0", "cc"), *runs("L1", "xx", valid=False)])
    other_seeds = paired_contrasts([*runs("L0", "cc"), *runs("L1", "xx", seed=1)])
    duplicates = paired_contrasts([*runs("L0", "cc"), *runs("L0", "xx"), *runs("L1", "xx")])
    for contrasts in (invalid, other_seeds, duplicates):
        assert [(contrast["pairs"], contrast["p"], contrast["p_holm"]) for contrast in contrasts] == [(0, None, None)]
    assert paired_contrasts([]) == []


def test_contrasts_of_the_papers_counts() -> None:
    """By Fisher's test the paper's L1 and L2 differ; L2, L3 and L4 do not differ from each other."""
    contrasts = {(contrast["a"], contrast["b"]): contrast for contrast in paper()["contrasts"]}
    assert len(contrasts) == 6
    assert contrasts["L1", "L2"]["p"] == pytest.approx(0.00037, abs=5e-6)
    assert contrasts["L1", "L2"]["p_holm"] == pytest.approx(6 * contrasts["L1", "L2"]["p"])
    assert contrasts["L3", "L4"]["p"] == pytest.approx(0.785, abs=5e-4)
    assert contrasts["L2", "L3"]["p"] == pytest.approx(0.435, abs=5e-4)
    assert contrasts["L2", "L4"]["p"] == pytest.approx(0.187, abs=5e-4)


def test_the_papers_percentages_are_counts_of_thirty() -> None:
    """100, 93.3, 50, 36.7, 30 and 10 % are 30, 28, 15, 11, 9 and 3 of 30; the exact interval of L5 is 2 to 27 %."""
    conditions = paper()["conditions"]
    percent = [round(100 * entry["completion_rate"], 1) for entry in conditions.values()]
    assert percent == [100.0, 93.3, 50.0, 36.7, 30.0, 10.0]
    assert conditions["L5"]["completion_interval"] == pytest.approx([0.0211, 0.2653], abs=5e-5)
    assert conditions["L4"]["injected_ms"] == {"video": 150, "control": 75}
    assert (conditions["L4"]["tau_v_ms"], conditions["L4"]["tau_c_ms"], conditions["L4"]["p95_m"]) == (211, 83, 4.64)
