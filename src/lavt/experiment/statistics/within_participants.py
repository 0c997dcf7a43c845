"""Tests between conditions that every participant drove, with the participant as the unit.

Both tests use ranks only and are permutation tests: under the null hypothesis, the values of a participant can be
exchanged between the conditions. So they need no distribution of the values, and hold for few participants:

* Friedman's test over all conditions (M. Friedman, The Use of Ranks to Avoid the Assumption of Normality, Journal of
  the American Statistical Association 32, 1937), corrected for ties, with Kendall's W as the effect size;
* Wilcoxon's signed-rank test for a pair of conditions (F. Wilcoxon, Individual Comparisons by Ranking Methods,
  Biometrics Bulletin 1, 1945) without the participants whose difference is 0, with the matched-pairs rank-biserial
  correlation as the effect size (D. S. Kerby, The Simple Difference Formula, Comprehensive Psychology 3, 2014).
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import rankdata

from lavt.domain import FloatArray
from lavt.experiment.statistics.intervals import holm
from lavt.recording.table import IntArray
from lavt.streams import stream

PERMUTATIONS = 100_000
"""The number of random permutations if there are too many for all of them."""
MOST_STEPS = 100_000
"""The exact distribution is computed if one participant needs no more steps than this."""
TIE_DECIMALS = 9
"""Values are ranked after rounding to so many decimals: means such as 1 - 2/3 and 2/3 - 1/3 differ by rounding only."""

Values = Mapping[str, Sequence[float]]
"""For each participant a value for each condition, in the order of the conditions."""


def compare_conditions(conditions: Sequence[str], values: Values) -> dict[str, Any]:
    """Return the medians of the conditions, Friedman's test, and Wilcoxon's test of each pair with Holm's correction.

    Without participants, the tests are None and there are no pairs.
    """
    table = np.array(list(values.values()), np.float64).reshape(len(values), len(conditions))
    return {
        "participants": len(values),
        "medians": {
            name: dict(
                zip(("p25", "p50", "p75"), map(float, np.percentile(table[:, column], (25, 50, 75))), strict=True)
            )
            for column, name in enumerate(conditions)
            if len(values)
        },
        "friedman": friedman(table) if len(values) else None,
        "pairs": _pairs(conditions, table) if len(values) else [],
    }


def _pairs(conditions: Sequence[str], table: FloatArray) -> list[dict[str, Any]]:
    numbers = list(itertools.combinations(range(len(conditions)), 2))
    tests = [signed_rank(table[:, b] - table[:, a]) for a, b in numbers]
    corrected = holm([test["p"] for test in tests])
    return [
        {
            "a": conditions[a],
            "b": conditions[b],
            **test,
            "p_holm": p,
            "smallest_p_holm": min(1.0, len(numbers) * test["smallest_p"]),
        }
        for (a, b), test, p in zip(numbers, tests, corrected, strict=True)
    ]


def friedman(table: FloatArray) -> dict[str, Any]:
    """Return Friedman's test of a table with a row for each participant and a column for each condition.

    `p` is exact, or from random permutations if `permutations` is not None. `smallest_p` is the p value if all
    participants rank the conditions alike, without ties.
    """
    participants, conditions = table.shape
    ranks = _doubled_ranks(table)
    spread = float(np.sum((ranks - (conditions + 1)) ** 2))
    observed = _sum_of_squares(ranks.sum(axis=0), participants * (conditions + 1))
    statistic = (conditions - 1) * observed / spread if spread else 0.0
    smallest_p = float(math.factorial(conditions)) ** (1 - participants)
    permutations = None
    p = _exact_friedman(ranks, observed)
    if p is None:
        permutations = PERMUTATIONS
        p = _sampled_friedman(ranks, observed)
        smallest_p = max(smallest_p, 1 / (PERMUTATIONS + 1))
    return {
        "statistic": statistic,
        "kendall_w": statistic / (participants * (conditions - 1)),
        "p": p,
        "smallest_p": smallest_p,
        "permutations": permutations,
    }


def _doubled_ranks(values: FloatArray) -> IntArray:
    """Return twice the ranks along the last axis, so that those of ties are whole numbers."""
    ranks: FloatArray = rankdata(np.round(values, TIE_DECIMALS), axis=-1)
    return np.round(2 * ranks).astype(np.int64)


def _sum_of_squares(rank_sums: Any, mean: int) -> int:
    return int(sum((int(rank_sum) - mean) ** 2 for rank_sum in rank_sums))


def _exact_friedman(ranks: Any, observed: int) -> float | None:
    """Return the exact p value, from the distribution of the rank sums; None if it takes too long.

    Each participant's ranks can be in any order. The statistic does not depend on the order of the conditions, so
    vectors of rank sums that differ only in their order are counted together.
    """
    participants, conditions = ranks.shape
    counts: dict[tuple[int, ...], int] = {(0,) * conditions: 1}
    for row in ranks.tolist():
        if len(counts) * math.factorial(conditions) > MOST_STEPS:
            return None
        orders = Counter(itertools.permutations(row))
        after: Counter[tuple[int, ...]] = Counter()
        for sums, count in counts.items():
            for order, times in orders.items():
                after[tuple(sorted(map(sum, zip(sums, order, strict=True))))] += count * times
        counts = after
    mean = participants * (conditions + 1)
    extreme = sum(count for sums, count in counts.items() if _sum_of_squares(sums, mean) >= observed)
    return extreme / sum(counts.values())


def _sampled_friedman(ranks: Any, observed: int) -> float:
    """Return the p value from random permutations, in which the observed one is counted, too."""
    participants, conditions = ranks.shape
    generator = stream(0, "Friedman permutations")
    extreme = 1
    for number in range(0, PERMUTATIONS, 10_000):
        batch = np.broadcast_to(ranks, (min(10_000, PERMUTATIONS - number), participants, conditions))
        sums = generator.permuted(batch, axis=2).sum(axis=1)
        extreme += int(np.sum(np.sum((sums - participants * (conditions + 1)) ** 2, axis=1) >= observed))
    return extreme / (PERMUTATIONS + 1)


def signed_rank(differences: FloatArray) -> dict[str, Any]:
    """Return Wilcoxon's exact two-sided signed-rank test of the differences, one for each participant.

    `differing` is the number of differences that are not 0. `effect` is the rank-biserial correlation, from -1 (all
    differences are negative) to 1. `smallest_p` is the p value if all participants differ in the same direction.
    """
    rounded = np.round(differences, TIE_DECIMALS)
    differing = rounded[rounded != 0]
    ranks = _doubled_ranks(np.abs(differing))
    total, positive = int(ranks.sum()), int(ranks[differing > 0].sum())
    ways = [1]  # ways[s]: in how many of all choices of signs the positive ranks have the sum s
    for rank in ranks.tolist():
        ways = [a + b for a, b in zip([*ways, *[0] * rank], [*[0] * rank, *ways], strict=True)]
    tail = sum(ways[: min(positive, total - positive) + 1])
    return {
        "participants": len(differences),
        "differing": len(differing),
        "median_difference": float(np.median(differences)),
        "effect": (2 * positive - total) / total if total else 0.0,
        "p": min(1.0, 2 * tail / 2 ** len(differing)),
        "smallest_p": min(1.0, 2 * 0.5 ** len(differences)),
    }
