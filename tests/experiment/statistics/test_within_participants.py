from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.stats import friedmanchisquare, wilcoxon

from lavt.experiment.statistics import within_participants
from lavt.experiment.statistics.within_participants import compare_conditions, friedman, signed_rank

RANDOM = np.random.default_rng(5)


@pytest.mark.parametrize(("participants", "conditions", "ties"), [(5, 3, False), (3, 4, False), (5, 3, True)])
def test_friedman_is_exact(participants: int, conditions: int, *, ties: bool) -> None:
    """Statistic and p value are those of an enumeration of all permutations within the participants."""
    table = RANDOM.normal(size=(participants, conditions)) + np.arange(conditions)
    table = np.round(table) if ties else table
    result = friedman(table)
    assert result["statistic"] == pytest.approx(friedmanchisquare(*table.T).statistic)
    assert result["kendall_w"] == pytest.approx(result["statistic"] / participants / (conditions - 1))
    orders = [[row[list(order)] for order in itertools.permutations(range(conditions))] for row in table]
    # The first participant's order is kept, because only the other orders relative to it matter.
    tables = [np.array([table[0], *rows]) for rows in itertools.product(*orders[1:])]
    extreme = [friedmanchisquare(*permuted.T).statistic >= result["statistic"] - 1e-9 for permuted in tables]
    assert result["p"] == pytest.approx(np.mean(extreme))
    assert result["permutations"] is None


def test_friedman_of_equal_orders_reaches_the_smallest_p() -> None:
    """If all participants rank the conditions alike, W is 1 and p is the smallest possible one."""
    result = friedman(np.tile([1.0, 2.0, 3.0], (4, 1)))
    assert (result["kendall_w"], result["p"]) == (pytest.approx(1.0), pytest.approx(6.0**-3))
    assert result["smallest_p"] == pytest.approx(6.0**-3)


def test_friedman_without_differences() -> None:
    """If nobody's values differ, W is 0 and p is 1."""
    result = friedman(np.ones((4, 3)))
    assert (result["kendall_w"], result["p"]) == (0.0, 1.0)


def test_random_permutations_replace_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random permutations give about the exact p value, and the result says how many they were."""
    table = RANDOM.normal(size=(6, 3)) + np.arange(3) / 2
    exact = friedman(table)["p"]
    monkeypatch.setattr(within_participants, "MOST_STEPS", 1)
    sampled = friedman(table)
    assert sampled["p"] == pytest.approx(exact, abs=0.006)
    assert sampled["permutations"] == 100_000
    assert sampled["smallest_p"] == pytest.approx(6.0**-5)
    assert friedman(table) == sampled


def test_rounding_does_not_break_ties() -> None:
    """Differences of means of thirds that are equal but for rounding have equal ranks, as have equal means."""
    means = np.array([[1 / 3, 2 / 3], [2 / 3, 1.0], [1.0, 2 / 3], [0.0, 2 / 3], [1 / 3, 1.0], [0.3, 0.1 + 0.2]])
    whole = np.array([[1.0, 2.0], [2.0, 3.0], [3.0, 2.0], [0.0, 2.0], [1.0, 3.0], [1.0, 1.0]])
    assert signed_rank(means[:, 1] - means[:, 0])["p"] == signed_rank(whole[:, 1] - whole[:, 0])["p"]
    assert friedman(means) == friedman(whole)


def test_the_signed_rank_test_is_exact() -> None:
    """Without ties the p value is that of SciPy's exact test, and the effect size that of its rank sums."""
    differences = RANDOM.normal(size=9) + 0.5
    result = signed_rank(differences)
    assert result["p"] == pytest.approx(wilcoxon(differences, method="exact").pvalue)
    ranks = np.argsort(np.argsort(np.abs(differences))) + 1
    assert result["effect"] == pytest.approx(float(np.sum(ranks * np.sign(differences)) / 45))
    assert result["median_difference"] == pytest.approx(float(np.median(differences)))


def test_the_signed_rank_test_with_ties_is_exact() -> None:
    """With ties the p value is that of an enumeration of all signs; differences of 0 are left out."""
    differences = np.array([0.0, 1.0, 1.0, -1.0, 2.0, 3.0])
    ranks = np.array([2.0, 2.0, 2.0, 4.0, 5.0])
    sums = [float(np.sum(ranks * signs)) for signs in itertools.product((0, 1), repeat=5)]
    expected = 2 * sum(value >= 13.0 for value in sums) / 32
    result = signed_rank(differences)
    assert (result["p"], result["participants"], result["differing"]) == (expected, 6, 5)


@pytest.mark.parametrize("participants", [1, 5, 6])
def test_the_smallest_p_of_the_signed_rank_test(participants: int) -> None:
    """If all differ in the same direction, p is the smallest possible one and the effect is 1; without any, p is 1."""
    result = signed_rank(np.arange(1.0, participants + 1))
    assert result["p"] == result["smallest_p"] == 2 * 0.5**participants
    assert result["effect"] == 1.0
    unchanged = signed_rank(np.zeros(participants))
    assert (unchanged["p"], unchanged["effect"], unchanged["differing"]) == (1.0, 0.0, 0)


def test_all_pairs_are_corrected_together() -> None:
    """Each pair has p values before and after Holm's correction over all pairs, and the smallest corrected one."""
    values = {str(number): [number, number + 1.0, number - 1.0] for number in range(6)}
    result = compare_conditions(("L0", "L2", "L5"), values)
    pairs = {(pair["a"], pair["b"]): pair for pair in result["pairs"]}
    assert list(pairs) == [("L0", "L2"), ("L0", "L5"), ("L2", "L5")]
    assert pairs["L0", "L5"]["effect"] == -1.0
    assert all(math.isclose(pair["p_holm"], 3 * 2 / 64) for pair in pairs.values())
    assert all(math.isclose(pair["smallest_p_holm"], 3 * 2 / 64) for pair in pairs.values())
    assert result["medians"]["L2"] == {"p25": 2.25, "p50": 3.5, "p75": 4.75}


def test_without_participants_there_is_no_test() -> None:
    """Without participants there are no medians and no tests."""
    result = compare_conditions(("L0", "L2"), {})
    assert (result["participants"], result["friedman"], result["pairs"], result["medians"]) == (0, None, [], {})
