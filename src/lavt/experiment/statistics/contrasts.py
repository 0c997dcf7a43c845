"""Planned contrasts between conditions: exact tests of paired runs and of roads, Fisher's exact test of counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from scipy.stats import binomtest, fisher_exact

from lavt.experiment.statistics.by_road import road_of
from lavt.experiment.statistics.intervals import holm

PLANNED = (("L0", "L1"), ("L1", "L2"), ("L2", "L3"), ("L2", "L4"), ("L3", "L4"), ("L3", "L5"))
"""The pairs of conditions to compare, chosen before any run was driven. In each pair the second condition has the next
larger sum of video and control delay, except in L3 with L4, whose sums are equal."""

PAIRED_BY = ("route", "repetition", "seed", "participant", "block")
"""The keys that are equal in the two runs of a pair; only the condition differs. `participant` and `block` are
keys of the config's section `study`."""


Completions = Mapping[tuple[Any, ...], bool]
"""Whether each run was completed, by its `PAIRED_BY` keys."""


def paired_contrasts(runs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Compare completion between conditions by pairs of runs, with Holm's correction for all returned contrasts.

    A contrast is returned if both its conditions were driven. Invalid runs are not paired. If several runs of one
    condition have equal `PAIRED_BY` keys, they are not paired either, because their partner would be ambiguous. `p` is
    None without pairs. Each contrast also has the sign test by road, which is the one to quote.
    """
    driven = {str(run["condition"]) for run in runs}
    completed = {name: _completed(runs, name) for name in driven}
    contrasts = []
    for a, b in PLANNED:
        if a in driven and b in driven:
            pairs = [(completed[a][key], completed[b][key]) for key in completed[a] if key in completed[b]]
            only_a, only_b = pairs.count((True, False)), pairs.count((False, True))
            p = mcnemar(only_a, only_b) if pairs else None
            contrast = {"a": a, "b": b, "pairs": len(pairs), "only_a": only_a, "only_b": only_b, "p": p}
            contrasts.append({**contrast, **_by_road(completed[a], completed[b])})
    by_road = holm([contrast["p_by_road"] for contrast in contrasts])
    return [{**contrast, "p_by_road_holm": p} for contrast, p in zip(with_holm(contrasts), by_road, strict=True)]


def _by_road(a: Completions, b: Completions) -> dict[str, Any]:
    """Return the exact sign test with the road as the unit.

    A road counts for the condition under which more of its paired runs were completed. `p_by_road` is None without
    pairs.
    """
    differences: dict[str, int] = {}
    for key in a:
        if key in b:
            road = road_of(str(key[PAIRED_BY.index("route")]))
            differences[road] = differences.get(road, 0) + a[key] - b[key]
    for_a, for_b = (sum(sign * difference > 0 for difference in differences.values()) for sign in (1, -1))
    return {
        "roads": len(differences),
        "roads_for_a": for_a,
        "roads_for_b": for_b,
        "p_by_road": mcnemar(for_a, for_b) if differences else None,
    }


def with_holm(contrasts: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the contrasts, which were planned together, and add to each the corrected p value `p_holm`."""
    corrected = holm([contrast["p"] for contrast in contrasts])
    return [{**contrast, "p_holm": p} for contrast, p in zip(contrasts, corrected, strict=True)]


def mcnemar(only_a: int, only_b: int) -> float:
    """Return McNemar's exact two-sided p value.

    `only_a` and `only_b` are the numbers of pairs of which only the first or only the second run was completed. Under
    the null hypothesis both kinds of pairs are equally likely.
    """
    differing = only_a + only_b
    return float(binomtest(only_a, differing, 0.5).pvalue) if differing else 1.0


def fisher(a_completed: int, a_runs: int, b_completed: int, b_runs: int) -> float:
    """Return Fisher's exact two-sided p value of two unpaired counts."""
    table = [[a_completed, a_runs - a_completed], [b_completed, b_runs - b_completed]]
    return float(fisher_exact(table)[1])


def _completed(runs: Sequence[Mapping[str, Any]], condition: str) -> Completions:
    """Return for each valid run of a condition, by its `PAIRED_BY` keys, whether it was completed."""
    valid = [run for run in runs if run["valid"] and run["condition"] == condition]
    keys = [tuple(run.get(name) for name in PAIRED_BY) for run in valid]
    counts = Counter(keys)
    return {key: run["ending"] == "completed" for key, run in zip(keys, valid, strict=True) if counts[key] == 1}
