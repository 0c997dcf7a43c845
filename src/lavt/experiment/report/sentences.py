"""The sentences of a report. Each is generated only if the results support it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise, product
from typing import Any, NamedTuple

from lavt.experiment.report.figures.figure_style import Conditions
from lavt.experiment.statistics.by_road import road_of

MAX_LISTED_NAMES = 8
"""If there are more names, a sentence gives only their number; the tables list them."""

MAX_LISTED_ROUTES = 3
"""The same for the names of routes in the sentence on what was run."""

PICTURES = {
    "video": "by video",
    "pixels": "from pictures",
    "geometry": "without pictures (the lane is known, not detected)",
}
"""What the driver of a run got, by the run's fidelity."""

SIGNIFICANT_P = 0.05
LARGEST_CHANCE = 0.1
"""An order of roads by length is named if, by chance alone, it is less probable than this."""

EQUAL_LOOP_LATENCY_MS = 3.0
"""Median loop latencies that differ by no more than this are treated as equal."""


class ConditionPoint(NamedTuple):
    """A condition with its median loop latency and its completion, in the own lane if that is known."""

    name: str
    loop_ms: float
    completion_rate: float


def _rate_key(conditions: Conditions) -> str:
    """Return the key of completion in the own lane if it is known for all conditions with runs, else of completion."""
    known = [entry for entry in conditions.values() if entry["completion_rate"] is not None]
    own_lane = "own_lane_completion_rate"
    return own_lane if known and all(entry.get(own_lane) is not None for entry in known) else "completion_rate"


def _latency_levels(conditions: Conditions) -> list[list[ConditionPoint]]:
    """Return the conditions with known loop latency and completion, in levels of equal latency, the lowest first."""
    rate_key = _rate_key(conditions)
    known = [
        ConditionPoint(name, float(entry["loop_ms"]["p50"]), float(entry[rate_key]))
        for name, entry in conditions.items()
        if entry["loop_ms"]["p50"] is not None and entry.get(rate_key) is not None
    ]
    level_starts_ms: list[float] = []
    for loop_ms in sorted(point.loop_ms for point in known):
        if not level_starts_ms or loop_ms - level_starts_ms[-1] > EQUAL_LOOP_LATENCY_MS:
            level_starts_ms.append(loop_ms)

    def level(point: ConditionPoint) -> int:
        return sum(start_ms <= point.loop_ms for start_ms in level_starts_ms)

    return [list(members) for _, members in groupby(sorted(known, key=lambda point: (level(point), point.name)), level)]


def runs_overview(runs: Sequence[Mapping[str, Any]], setting: str = "") -> str:
    """Return sentences with the number of runs, their routes and conditions, and the number of invalid runs.

    `setting` has further sentences on the runs, which follow the conditions.
    """
    routes_by_kind: dict[tuple[str, str], list[str]] = {}
    for run in runs:
        kind = str(run["time"]), run.get("fidelity") or "video"
        routes_by_kind.setdefault(kind, []).append(str(run["route"]))
    by_kind = " and ".join(
        f"{_counted(len(routes), 'run')} in {time} time {PICTURES[fidelity]} on "
        f"{_listed('route', sorted(set(routes)), MAX_LISTED_ROUTES)}"
        for (time, fidelity), routes in sorted(routes_by_kind.items(), reverse=True)
    )
    names = sorted({str(run["condition"]) for run in runs})
    invalid = sum(not run["valid"] for run in runs)
    validity = "All runs are valid."
    if invalid:
        subject = "1 run is" if invalid == 1 else f"{invalid} runs are"
        validity = f"{subject} invalid and excluded from all statistics."
    conditions = _listed("condition", names, MAX_LISTED_NAMES)
    return " ".join(filter(None, (f"{by_kind}, under {conditions}.", setting, validity)))


def limits_sentences(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return sentences on what these runs cannot show; "" if nothing of it is known."""
    limits = []
    if {run.get("preset") for run in runs} == {"paper_calibrated"}:
        limits.append(
            "where driving fails for another controller or car: the delay at which completion falls was an input to "
            "the gains (paper_calibrated)"
        )
    if any(run.get("fidelity") == "geometry" for run in runs):
        limits.append(
            "what errors of lane detection do, in the runs without pictures: their driver always follows the lane of "
            "the route"
        )
    if all(run.get("inherent") == "loopback" for run in runs):
        limits.append("the latency of a real network: without injected delay, it is that of one machine's loopback")
    return " ".join(f"Not shown: {limit}." for limit in limits)


def _listed(word: str, names: Sequence[str], most: int) -> str:
    if len(names) > most:
        return f"{len(names)} {word}s"
    return f"the {word}{'s' if len(names) > 1 else ''} {', '.join(names)}"


def results_sentences(name: str, conditions: Conditions) -> str:
    """Return sentences on the results of the runs called `name`; "" without conditions.

    The sentences give the completion, its largest fall between two levels of latency, and P95 of the cross-track error.
    """
    levels = _latency_levels(conditions)
    known = [point for level in levels for point in level]
    if not known:
        return ""
    if all(conditions[point.name].get("runs") == 1 for point in known):
        return _example_sentence(name, conditions, known)
    parts = []
    lane = " in their own lane" if _rate_key(conditions) != "completion_rate" else ""
    if len(known) <= MAX_LISTED_NAMES:
        rates = ", ".join(f"{condition} {rate * 100:.0f} % ({loop_ms:.0f} ms)" for condition, loop_ms, rate in known)
        counts = {conditions[point.name].get("runs") for point in known}
        number = counts.pop() if len(counts) == 1 else None
        each = f" ({number} runs each)" if number else ""
        parts.append(f"Runs completed{lane} by condition{each}, with the median loop latency: {rates}.")
    parts += _fall_sentences(levels, lane)
    parts += _error_sentence({condition: conditions[condition] for condition, _, _ in known})
    return f"{name}. {' '.join(parts)}"


def contrast_sentence(contrasts: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence on what the planned contrasts, tested by road, show or cannot show; "" without contrasts."""
    tested = [contrast for contrast in contrasts if contrast.get("p_by_road_holm") is not None]
    if not tested:
        return ""
    shown = [contrast for contrast in tested if contrast["p_by_road_holm"] < SIGNIFICANT_P]
    if shown:
        differences = ", ".join(
            f"{better} than at {worse} (p = {contrast['p_by_road_holm']:.2g})"
            for contrast in shown
            for better, worse in [_by_completion(contrast)]
        )
        others = len(tested) - len(shown)
        rest = f"; the other {_counted(others, 'contrast')} {'is' if others == 1 else 'are'} not significant" * (
            others > 0
        )
        return f"Tested by road (planned contrasts, Holm's correction), more runs are completed at {differences}{rest}."
    roads = max(contrast["roads"] for contrast in tested)
    least_p = min(1.0, len(tested) * 2 * 0.5**roads)
    start = "Tested by road, no planned contrast of completion in any lane is significant"
    if least_p >= SIGNIFICANT_P:
        return (
            f"{start}, and none could be: {_counted(roads, 'road')} are too few, because even if all agreed, p would "
            f"be {least_p:.2g} (Holm's correction for {_counted(len(tested), 'contrast')})."
        )
    return f"{start} ({_counted(roads, 'road')}), which does not show that the conditions are equal."


def _counted(count: int, word: str) -> str:
    return f"{count} {word}{'s' * (count != 1)}"


def _by_completion(contrast: Mapping[str, Any]) -> tuple[str, str]:
    """Return both conditions of a contrast, the one with more completed runs on more roads first."""
    a, b = str(contrast["a"]), str(contrast["b"])
    return (a, b) if contrast["roads_for_a"] > contrast["roads_for_b"] else (b, a)


def length_sentences(conditions: Conditions, lengths_m: Mapping[str, float]) -> str:
    """Return sentences on the conditions under which only the shorter routes are completed; "" if there are none.

    `lengths_m` are the lengths of routes by name. A route counts as completed if all its runs are, in their own lane
    if that is known. A condition is named if each completed route is shorter than each other route, and if that is
    improbable by chance alone. If several routes are on one road, they are not independent, and no condition is named.
    """
    own_lane = _rate_key(conditions) != "completion_rate"
    conditions_by_split: dict[tuple[tuple[float, ...], tuple[float, ...]], list[str]] = {}
    for name, entry in conditions.items():
        routes = {route: runs for route, runs in (entry.get("routes") or {}).items() if route in lengths_m}
        completed: list[float] = []
        other: list[float] = []
        for route, runs in routes.items():
            count = runs.get("completed_in_own_lane") if own_lane else runs["completed"]
            (completed if count == runs["runs"] else other).append(lengths_m[route])
        is_split = completed and other and max(completed) < min(other)
        if is_split and len({road_of(route) for route in routes}) == len(routes):
            conditions_by_split.setdefault((tuple(sorted(completed)), tuple(sorted(other))), []).append(name)
    sentences = []
    for (shorter_m, longer_m), names in conditions_by_split.items():
        orders = math.comb(len(shorter_m) + len(longer_m), len(shorter_m))
        if 1 / orders <= LARGEST_CHANCE:
            sentences.append(
                "Only shorter roads are completed (seen in the results, not planned): "
                f"at {' and '.join(names)}, every run is completed"
                f"{' in its own lane' * own_lane} on the {_counted(len(shorter_m), 'shorter route')} "
                f"({_range_m(shorter_m)}), and not on the {_counted(len(longer_m), 'longer one')} "
                f"({_range_m(longer_m)}); if length did not matter, the chance of this order would be 1 in {orders}."
            )
    return " ".join(sentences)


def _range_m(lengths_m: Sequence[float]) -> str:
    first, last = f"{lengths_m[0]:.0f}", f"{lengths_m[-1]:.0f}"
    return f"{first} m" if first == last else f"{first} to {last} m"


def _error_sentence(conditions: Conditions) -> list[str]:
    """Return a sentence on P95 of all runs, as in the headline figure, or else of the completed runs."""
    all_runs = {name: ((entry.get("by_road") or {}).get("p95_all_runs_m") or {}) for name, entry in conditions.items()}
    errors = {name: entry["mean"] for name, entry in all_runs.items() if entry.get("mean") is not None}
    of = "of all runs, each up to its own end (mean over roads)"
    if not errors:
        errors = {name: entry["p95_m"] for name, entry in conditions.items() if entry["p95_m"] is not None}
        of = "of the completed runs (mean)"
    if len(errors) < 2:
        return []
    first, *_, last = errors
    return [f"P95 of the cross-track error: {errors[first]:.2f} m at {first}, {errors[last]:.2f} m at {last}, {of}."]


def _example_sentence(name: str, conditions: Conditions, known: Sequence[ConditionPoint]) -> str:
    """Return a sentence on conditions with one run each, which show no share of runs."""
    lane = " in its own lane" if _rate_key(conditions) != "completion_rate" else ""
    endings = ", ".join(
        f"{condition} {'completed' if rate else 'not completed'}{lane} ({loop_ms:.0f} ms)"
        for condition, loop_ms, rate in known
    )
    return f"{name}, one run for each condition, as an example: {endings}."


def _fall(pair: tuple[ConditionPoint, ConditionPoint]) -> float:
    before, after = pair
    return before.completion_rate - after.completion_rate


def _fall_sentences(levels: Sequence[Sequence[ConditionPoint]], lane: str) -> list[str]:
    """Return sentences on the largest fall of completion, and on the latency above which fewer than half complete.

    `lane` follows "completed" where the own lane is judged.
    """
    falls = [max(product(lower, higher), key=_fall) for lower, higher in pairwise(levels)]
    if not falls:
        return []
    largest = max(map(_fall, falls))
    if largest <= 0:
        return [f"The share of runs completed{lane} does not fall as latency increases."]
    described = [
        f"from {before.completion_rate * 100:.0f} % at {before.name} to {after.completion_rate * 100:.0f} % at "
        f"{after.name}, between {before.loop_ms:.0f} and {after.loop_ms:.0f} ms of loop latency"
        for before, after in falls
        if math.isclose(_fall((before, after)), largest)
    ]
    parts = [f"The largest fall is {', and '.join(described)}."]
    best_rates = [max(point.completion_rate for point in level) for level in levels]
    last = max((index for index, best_rate in enumerate(best_rates) if best_rate >= 0.5), default=-1)
    if last + 1 < len(levels):
        start_ms = min(point.loop_ms for point in levels[last + 1])
        beyond = "the longest latency" if last + 2 == len(levels) else "and at each longer latency"
        parts.append(f"At {start_ms:.0f} ms, {beyond}, fewer than half of the runs are completed{lane}.")
    return parts
