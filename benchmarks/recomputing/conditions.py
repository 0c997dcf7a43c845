"""The summary of conditions and the contrasts, recomputed from results of runs by the formulas of `docs/metrics.md`.

In a run, the keys `route`, `condition`, `repetition`, `seed`, `participant`, `block` and `valid` are those of LAVT.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from operator import itemgetter
from typing import Any

import numpy as np
from scipy import stats

Row = dict[str, Any]
Values = Callable[[Sequence[Row]], list[float]]
"""The values of a measure in those of the given runs that have one."""

PLANNED = (("L0", "L1"), ("L1", "L2"), ("L2", "L3"), ("L2", "L4"), ("L3", "L4"), ("L3", "L5"))
MEANS = (
    "mae_m",
    "rms_m",
    "max_m",
    "heading_rms_rad",
    "lateral_jerk_rms_mps3",
    "steering_rate_rms_radps",
    "steering_reversals_per_s",
    "oscillation_hz",
)
COUNTS = ("collisions", "lane_invasions")
LATENCIES = ("tau_v_ms", "tau_c_ms", "loop_ms", "age_at_actuation_ms")
PAGE_LATENCIES = ("page_decoded_ms", "page_shown_ms")


def groups(runs: Iterable[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    """Return the runs by the value of `key`, sorted by it."""
    found = defaultdict(list)
    for run in runs:
        found[key(run)].append(run)
    return {value: found[value] for value in sorted(found)}


def by_route(runs: Iterable[Row]) -> Iterable[list[Row]]:
    """Return the runs of each route."""
    return groups(runs, lambda run: run["route"]).values()


def road(run: Row) -> str:
    """Return the name of the road of a run."""
    return str(run["route"]).removesuffix(".yaml").removesuffix(".yml").removesuffix("_key")


def mean(values: Sequence[float]) -> float | None:
    """Return the mean; None without values."""
    return float(np.mean(values)) if len(values) else None


# Intervals.


def exact(successes: int, trials: int) -> list[float] | None:
    """Return Clopper and Pearson's interval."""
    if not trials:
        return None
    interval = stats.binomtest(successes, trials).proportion_ci(method="exact")
    return [interval.low, interval.high]


def exact_mean_count(count: int, trials: int) -> list[float]:
    """Return Garwood's interval of the mean of `trials` Poisson numbers whose sum is `count`."""
    low = stats.gamma.ppf(0.025, count) if count else 0.0
    return [low / trials, stats.gamma.ppf(0.975, count + 1) / trials]


def bootstrap(samples: Sequence[Sequence[float]], statistic: Callable[..., Any], level: float = 0.95) -> list[float]:
    """Return the percentile bootstrap interval with the documented resamples."""
    key = int.from_bytes(hashlib.sha256(b"0/bootstrap interval").digest()[:16], "little")
    interval = stats.bootstrap(
        [np.array(sample) for sample in samples],
        statistic,
        n_resamples=10_000,
        confidence_level=level,
        method="percentile",
        random_state=np.random.Generator(np.random.Philox(key=key)),
    ).confidence_interval
    return [interval.low, interval.high]


def stratified(runs: Sequence[Row], values: Values) -> list[float] | None:
    """Return Student's interval of the mean of all values, from their spread within each route."""
    strata = [found for found in (values(of_route) for of_route in by_route(runs)) if found]
    total = sum(len(found) for found in strata)
    squares = freedom = 0.0
    for found in strata:
        if len(found) >= 2:
            error = len(found) / total * stats.sem(found)
            squares += error**2
            freedom += error**4 / (len(found) - 1)
    centre = mean([value for found in strata for value in found])
    if centre is None or max(len(found) for found in strata) < 2:
        return None
    if squares == 0:
        return [centre, centre]
    low, high = stats.t.interval(0.95, squares**2 / freedom, centre, math.sqrt(squares))
    return [low, high]


def over_roads(runs: Sequence[Row], values: Values, *, is_rate: bool) -> Row:
    """Return an entry of `by_road`."""
    of_roads = [values(of_road) for of_road in groups(runs, road).values()]
    means = [float(np.mean(found)) for found in of_roads if found]
    n, interval = len(means), None
    if n >= 6 and is_rate:
        total = round(sum(means), 9)
        lows, highs = exact(math.floor(total), n), exact(math.ceil(total), n)
        interval = [lows[0], highs[1]] if lows and highs else None
    elif n >= 6 and len(set(means)) > 1:
        student = stats.t.ppf(0.975, n - 1)
        interval = bootstrap([means], np.mean, 1 - 2 * stats.norm.cdf(-np.sqrt(n / (n - 1)) * student))
    low, high = interval or (None, None)
    return {"roads": n, "mean": mean(means), "low": low, "high": high}


# Measures.


def completed(runs: Sequence[Row]) -> list[float]:
    """Return 1 for each completed run and 0 for the others."""
    return [float(run["ending"] == "completed") for run in runs]


def in_own_lane(runs: Sequence[Row]) -> list[float]:
    """Return 1 for each run completed in its own lane and 0 for the others."""
    return [float(run["completed_in_own_lane"]) for run in runs if run["completed_in_own_lane"] is not None]


def of_completed(name: str) -> Values:
    """Return the function for a measure of completed runs."""
    return lambda runs: [run[name] for run in runs if run["ending"] == "completed" and run[name] is not None]


def route_balanced(runs: Sequence[Row], name: str) -> list[float]:
    """Return the mean of each route that has a completed run."""
    of_routes = [of_completed(name)(of_route) for of_route in by_route(runs)]
    return [float(np.mean(values)) for values in of_routes if values]


def common(all_runs: Sequence[Row]) -> Values:
    """Return the function for P95 up to the common distance of all valid runs."""

    def start(run: Row) -> tuple[Any, ...]:
        return run["route"], run["repetition"], run["seed"]

    tens = {key: min(len(run["p95_by_10m"]) for run in runs) for key, runs in groups(all_runs, start).items()}
    return lambda runs: [run["p95_by_10m"][tens[start(run)] - 1] for run in runs if tens[start(run)]]


def worst_rank(runs: Sequence[Row]) -> Row:
    """Return the quartiles of P95, with incomplete runs ranked last."""
    ranked = sorted(run["p95_m"] if run["ending"] == "completed" else np.inf for run in runs)
    quartiles = {}
    for percent in (25, 50, 75):
        value = ranked[int(np.ceil(percent / 100 * len(ranked))) - 1]
        quartiles[f"p{percent}"] = value if np.isfinite(value) else None
    return quartiles


def summarize(runs: Sequence[Row], common_p95: Values) -> Row:
    """Return the entry of a condition from its valid runs."""
    n, ended, kept = len(runs), completed(runs), in_own_lane(runs)
    hits = sum(run["collisions"] for run in runs)
    hit_once = all((run["ending"] == "collision") == run["collisions"] for run in runs)
    kilometres = sum(run["distance_m"] for run in runs) / 1000
    p95, followed = of_completed("p95_m"), of_completed("followed_p95_m")
    measures: dict[str, Values] = {
        "completion_rate": completed,
        "own_lane_completion_rate": in_own_lane,
        "collisions_per_run": lambda found: [run["collisions"] for run in found],
        "p95_m": p95,
        "p95_all_runs_m": lambda found: [run["p95_m"] for run in found],
        "followed_p95_m": followed,
        "p95_common_m": common_p95,
    }
    return {
        "runs": n,
        "completed": int(sum(ended)),
        "completion_rate": mean(ended),
        "completion_interval": exact(int(sum(ended)), n),
        "completed_in_own_lane": int(sum(kept)),
        "own_lane_completion_rate": mean(kept),
        "own_lane_completion_interval": exact(int(sum(kept)), len(kept)),
        "invasion_free_completion_rate": mean(
            [done * (run["lane_invasions"] == 0) for done, run in zip(ended, runs, strict=True)]
        ),
        "endings": dict(Counter(run["ending"] for run in runs)),
        **{f"{name}_per_run": mean([run[name] for run in runs]) for name in COUNTS},
        "collisions_per_run_interval": (exact if hit_once else exact_mean_count)(hits, n),
        **{f"{name}_per_km": sum(run[name] for run in runs) / kilometres for name in COUNTS},
        "by_road": {
            name: over_roads(
                runs, values, is_rate=name.endswith("_rate") or (name == "collisions_per_run" and hit_once)
            )
            for name, values in measures.items()
        },
        "p95_m": mean(p95(runs)),
        "p95_interval": stratified(runs, p95),
        "p95_route_balanced_m": mean(route_balanced(runs, "p95_m")),
        "p95_routes": len(route_balanced(runs, "p95_m")),
        "followed_p95_m": mean(followed(runs)),
        "followed_p95_route_balanced_m": mean(route_balanced(runs, "followed_p95_m")),
        "p95_common_m": mean(common_p95(runs)),
        "p95_common_interval": stratified(runs, common_p95),
        "p95_worst_rank_m": worst_rank(runs),
        **{name: mean([run[name] for run in runs if run[name] is not None]) for name in MEANS},
        **{
            name: mean([run["lane_kept"][name] for run in runs if run["lane_kept"]])
            for name in ("own_lane_share", "followed_unknown_share")
        },
        **{
            f"{name}_per_run": mean([run["lane_kept"][name] for run in runs if run["lane_kept"]])
            for name in ("followed_changes", "occupied_changes")
        },
        **{name: medians([run[name] for run in runs]) for name in LATENCIES},
        **{name: page_latency([run[name] for run in runs]) for name in PAGE_LATENCIES},
        "picture_age_ms": {
            key: float(np.median([run["picture_age_ms"][key] for run in runs])) for key in ("mean", "p95")
        },
    }


def medians(entries: Sequence[Row]) -> Row:
    """Return the medians of the runs' percentiles and the sum of their numbers."""
    known = [entry for entry in entries if entry["n"]]
    summary: Row = {
        key: float(np.median([entry[key] for entry in known])) if known else None for key in ("p5", "p50", "p95")
    }
    return {**summary, "n": sum(entry["n"] for entry in known)}


def page_latency(entries: Sequence[Row]) -> Row:
    """Return the medians as for other latencies, and the largest maximum."""
    return {**medians(entries), "max": max((entry["max"] for entry in entries if entry["n"]), default=None)}


# Contrasts.


def contrasts(runs: Sequence[Row]) -> list[Row]:
    """Return the planned contrasts of completion."""

    def key(run: Row) -> tuple[Any, ...]:
        return tuple(run[name] for name in ("route", "repetition", "seed", "participant", "block"))

    by_condition = {
        name: {starts: of_start[0] for starts, of_start in keyed(found, key).items() if len(of_start) == 1}
        for name, found in groups(runs, lambda run: run["condition"]).items()
    }
    rows: list[Row] = []
    for a, b in PLANNED:
        if a in by_condition and b in by_condition:
            pairs = [
                (run, by_condition[b][start]) for start, run in by_condition[a].items() if start in by_condition[b]
            ]
            ended = [tuple(run["ending"] == "completed" for run in pair) for pair in pairs]
            leads: dict[str, int] = defaultdict(int)
            for (run, _), (first, second) in zip(pairs, ended, strict=True):
                leads[road(run)] += first - second
            counts = {"only_a": ended.count((True, False)), "only_b": ended.count((False, True))}
            for_a, for_b = sum(lead > 0 for lead in leads.values()), sum(lead < 0 for lead in leads.values())
            by_road = {"roads": len(leads), "roads_for_a": for_a, "roads_for_b": for_b}
            p_values = {"p": sign_test(*counts.values()), "p_by_road": sign_test(for_a, for_b)}
            rows.append({"a": a, "b": b, "pairs": len(pairs), **counts, **by_road, **p_values})
    for name in ("p", "p_by_road"):
        ordered = sorted(rows, key=itemgetter(name))
        corrected = [min((len(ordered) - index) * row[name], 1.0) for index, row in enumerate(ordered)]
        for row, p in zip(ordered, itertools.accumulate(corrected, max), strict=True):
            row[f"{name}_holm"] = p
    return rows


def keyed(runs: Iterable[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    """Return the runs by the value of `key`, in their order."""
    found: dict[Any, list[Row]] = defaultdict(list)
    for run in runs:
        found[key(run)].append(run)
    return found


def sign_test(first: int, second: int) -> float:
    """Return the exact two-sided p value of two counts that are equally likely under the null hypothesis."""
    return float(stats.binomtest(first, first + second, 0.5).pvalue) if first + second else 1.0
