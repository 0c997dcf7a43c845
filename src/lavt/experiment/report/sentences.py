"""The sentences of a report. Each is generated only if the results support it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise, product
from typing import Any

from lavt.experiment.report.figure_style import Conditions

LISTED = 8
"""A sentence with more names than this gives only their number; the tables list them."""

LEAST_RUNS = 6
"""A condition with fewer runs, one for each of the paper's routes, is not compared with the paper in sentences."""

SAME_LOOP_MS = 3.0
"""Median loop latencies that differ by no more than this are treated as equal."""

SIGNIFICANT_P = 0.05

CLEARLY_FEWER = 2
"""Completion falls more sharply than in the paper if this many fewer conditions are completed in part."""

Contrast = Mapping[str, Any]

ConditionPoint = tuple[str, float, float]
"""Name, median loop latency in ms, and completion of a condition."""


def _by_latency(conditions: Conditions) -> list[list[ConditionPoint]]:
    """Return the conditions with known loop latency and completion, grouped by equal latency, the lowest first."""
    known = [
        (name, float(entry["loop_ms"]["p50"]), float(entry["completion_rate"]))
        for name, entry in conditions.items()
        if entry["loop_ms"]["p50"] is not None and entry["completion_rate"] is not None
    ]
    begins_ms: list[float] = []
    for _, loop_ms, _ in sorted(known, key=lambda each: each[1]):
        if not begins_ms or loop_ms - begins_ms[-1] > SAME_LOOP_MS:
            begins_ms.append(loop_ms)

    def level(each: ConditionPoint) -> int:
        return sum(begin_ms <= each[1] for begin_ms in begins_ms)

    return [list(members) for _, members in groupby(sorted(known, key=lambda each: (level(each), each[0])), level)]


def runs_overview(runs: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence with the number of runs, their routes and conditions, and the number of invalid runs."""
    counts = {kind: sum(run["time"] == kind for run in runs) for kind in ("virtual", "real")}
    by_time = " and ".join(
        f"{count} run{'s' if count > 1 else ''} in {kind} time" for kind, count in counts.items() if count
    )
    routes = sorted({str(run["route"]) for run in runs})
    names = sorted({str(run["condition"]) for run in runs})
    invalid = sum(not run["valid"] for run in runs)
    validity = "All runs are valid."
    if invalid:
        subject = "1 run is" if invalid == 1 else f"{invalid} runs are"
        validity = f"{subject} invalid and excluded from all statistics; the table of all runs gives the reasons."
    where = f"{_listed('route', routes)} under {_listed('condition', names)}"
    return f"{by_time} on {where}. {validity}"


def _listed(word: str, names: Sequence[str]) -> str:
    if len(names) > LISTED:
        return f"{len(names)} {word}s"
    return f"the {word}{'s' if len(names) > 1 else ''} {', '.join(names)}"


def results_sentences(name: str, conditions: Conditions) -> str:
    """Return the results of the runs called `name`: completion, its largest fall and P95; "" without conditions."""
    levels = _by_latency(conditions)
    known = [each for level in levels for each in level]
    if not known:
        return ""
    parts = []
    if len(known) <= LISTED:
        each = ", ".join(f"{condition} {rate * 100:.0f} % ({loop_ms:.0f} ms)" for condition, loop_ms, rate in known)
        parts.append(f"Completed runs, with the median loop latency: {each}.")
    parts += _fall_sentences(levels)
    errors = [(condition, conditions[condition]["p95_m"]) for condition, _, _ in known]
    known_errors = [(condition, error_m) for condition, error_m in errors if error_m is not None]
    if len(known_errors) > 1:
        (first, first_m), (last, last_m) = known_errors[0], known_errors[-1]
        parts.append(
            f"Mean P95 of the cross-track error of completed runs: {first_m:.2f} m at {first}, {last_m:.2f} m at "
            f"{last}."
        )
    return f"{name}. {' '.join(parts)}"


def _fall_sentences(levels: Sequence[Sequence[ConditionPoint]]) -> list[str]:
    falls = [each for lower, higher in pairwise(levels) for each in product(lower, higher)]
    if not falls:
        return []
    before, after = max(falls, key=lambda fall: fall[0][2] - fall[1][2])
    if before[2] <= after[2]:
        return ["Completion does not fall as latency increases."]
    parts = [
        f"The largest fall is from {before[2] * 100:.0f} % at {before[0]} to {after[2] * 100:.0f} % at {after[0]}, "
        f"between {before[1]:.0f} and {after[1]:.0f} ms of loop latency."
    ]
    last = max((index for index, level in enumerate(levels) if any(rate >= 0.5 for _, _, rate in level)), default=-1)
    if last + 1 < len(levels):
        begin_ms = min(loop_ms for _, loop_ms, _ in levels[last + 1])
        parts.append(f"At {begin_ms:.0f} ms and above, fewer than half of the runs are completed.")
    return parts


def equal_total_sentences(
    contrasts: Sequence[Contrast], conditions: Conditions, paper: Sequence[Contrast]
) -> list[str]:
    """Return a sentence on each contrast of conditions that inject the same total delay."""
    theirs = {(contrast["a"], contrast["b"]): contrast for contrast in paper}
    sentences = []
    for contrast in contrasts:
        a, b = contrast["a"], contrast["b"]
        injected = [_injected(conditions[name]) for name in (a, b) if name in conditions]
        if len(injected) < 2 or any(None in each.values() for each in injected) or contrast["p_holm"] is None:
            continue
        if len({sum(each.values()) for each in injected}) == 1:
            sentences.append(_equal_total(contrast, conditions, injected, theirs.get((a, b))))
    return sentences


def _injected(entry: Mapping[str, Any]) -> dict[str, float]:
    return {flow: entry["injected_ms"][flow] for flow in ("video", "control")}


def _equal_total(
    contrast: Contrast, conditions: Conditions, injected: Sequence[Mapping[str, float]], theirs: Contrast | None
) -> str:
    a, b = contrast["a"], contrast["b"]
    names = [
        f"{name} ({each['video']:.0f} + {each['control']:.0f} ms)" for name, each in zip((a, b), injected, strict=True)
    ]
    begin = f"{names[0]} and {names[1]} inject the same total delay, {sum(injected[0].values()):.0f} ms"
    unequal = contrast["only_a"] + contrast["only_b"]
    pairs = f"{contrast['pairs'] - unequal} of {contrast['pairs']} pairs have the same completion"
    loops_ms = [conditions[name]["loop_ms"]["p50"] for name in (a, b)]
    if contrast["p_holm"] <= SIGNIFICANT_P:
        return (
            f"{begin}, but their completion differs significantly (p {contrast['p_holm']:.2g} after Holm; {pairs}). An "
            "effect that depends on one channel only must be the cause."
        )
    if None in loops_ms or abs(loops_ms[0] - loops_ms[1]) > SAME_LOOP_MS:
        return f"{begin}. Their completion does not differ significantly ({pairs}), but their loop latencies do."
    sentences = (
        f"{begin}, and so have the same loop latency ({loops_ms[0]:.1f} and {loops_ms[1]:.1f} ms measured). Their "
        f"completion does not differ significantly ({pairs}). This is expected: with pure delays and paired seeds, "
        "only an effect that depends on one channel can cause a difference, such as speed feedback, a limit on the "
        "frame age, or a controller that compensates a known delay."
    )
    if unequal:
        sentences += " In runs close to failure, small differences decide the ending."
    if theirs and theirs["p"] > SIGNIFICANT_P:
        sentences += f" The paper's counts do not differ significantly either (Fisher, p {theirs['p']:.2f})."
    return sentences


def difference_sentences(conditions: Conditions, paper: Conditions) -> list[str]:
    """Return the differences from the paper with reasons; [] if one of its conditions was not run often enough."""
    if not paper or any(name not in conditions or conditions[name]["runs"] < LEAST_RUNS for name in paper):
        return []
    sentences = [
        _sharper_fall(conditions, paper),
        _unequal_completion(conditions, paper),
        _reference_error(conditions, paper),
        _bounded_error(conditions, paper),
        _first_delay(conditions, paper),
        "“Completed” may have a different meaning: here a collision, leaving the road, a safe stop or the time limit "
        "ends a run. The paper counts collisions in conditions with full completion and does not say what ends a run.",
        "The latency at which completion falls depends on the controller's gains, which the paper does not publish. "
        "`paper_calibrated` was tuned by hand so that completion falls at the paper's latency; with other gains on the "
        "same testbed it falls elsewhere or not at all. The fall therefore proves nothing about latency alone.",
    ]
    return [sentence for sentence in sentences if sentence]


def _partly_completed(conditions: Conditions) -> int:
    return sum(0.05 < (entry["completion_rate"] or 0.0) < 0.95 for entry in conditions.values())


def _sharper_fall(conditions: Conditions, paper: Conditions) -> str:
    shared = {name: conditions[name] for name in paper}
    lowest = min(entry["completion_rate"] for entry in shared.values())
    if lowest > 0.5 or _partly_completed(shared) > _partly_completed(paper) - CLEARLY_FEWER:
        return ""
    ours, theirs = (
        ", ".join(f"{of[name]['completion_rate'] * 100:.0f}" for name in paper) for of in (conditions, paper)
    )
    return (
        f"Completion falls more sharply here ({ours} %) than in the paper ({theirs} %). All routes here have one kind "
        "of road, one speed and one stability margin; the paper does not explain the spread of its runs."
    )


def _unequal_completion(conditions: Conditions, paper: Conditions) -> str:
    """Return a sentence on the conditions whose interval of completion does not overlap with the paper's."""
    unequal = []
    for name, its in paper.items():
        ours, theirs = conditions[name]["completion_interval"], its["completion_interval"]
        if ours and (ours[0] > theirs[1] or ours[1] < theirs[0]):
            word = "higher" if ours[0] > theirs[1] else "lower"
            here, there = (f"{of['completion_rate'] * 100:.0f} %" for of in (conditions[name], its))
            unequal.append(f"{word} at {name} ({here}, paper {there})")
    if not unequal:
        return "The 95 % intervals of completion overlap with the paper's under all conditions."
    return (
        "Completion differs from the paper's by more than chance (the intervals do not overlap): "
        f"{', '.join(unequal)}. No tested pair of gains matches the paper's completion under every condition "
        "(docs/controllers.md)."
    )


def _reference_error(conditions: Conditions, paper: Conditions) -> str:
    name = min(paper, key=lambda each: sum(_injected(paper[each]).values()))
    ours_m, theirs_m = conditions[name]["p95_m"], paper[name]["p95_m"]
    if ours_m is None or theirs_m < 5 * ours_m:
        return ""
    return (
        f"The mean P95 at {name} is {ours_m:.2f} m here and {theirs_m:.2f} m in the paper. A vehicle that far from the "
        f"lane centre is outside its lane, but the paper counts only {paper[name]['lane_invasions_per_run']:.2f} lane "
        "invasions per run. Its reference, one of its own drives, is probably not the lane centre; the reference here "
        "is."
    )


def _bounded_error(conditions: Conditions, paper: Conditions) -> str:
    ours = [conditions[name]["p95_m"] for name in paper if conditions[name]["p95_m"] is not None]
    theirs_m = max(paper[name]["p95_m"] for name in paper)
    if not ours or max(ours) >= theirs_m or all(conditions[name]["completion_rate"] == 1.0 for name in paper):
        return ""
    return (
        f"The largest mean P95 of completed runs is {max(ours):.2f} m here and {theirs_m:.2f} m in the paper. The "
        "roads here have rails and a median barrier; touching one is a collision and ends the run, which bounds the "
        "error of completed runs."
    )


def _first_delay(conditions: Conditions, paper: Conditions) -> str:
    name = next((each for each in paper if sum(_injected(paper[each]).values()) > 0), None)
    if name is None or not (paper[name]["completion_rate"] < 1.0 == conditions[name]["completion_rate"]):
        return ""
    its, ours = paper[name], conditions[name]["completion_interval"]
    overlap = " The 95 % intervals overlap." if ours and ours[0] <= its["completion_interval"][1] else ""
    return (
        f"All runs are completed at {name} here, and {its['completed']} of {its['runs']} in the paper. The paper does "
        f"not say what ended the others; no effect in this model would.{overlap}"
    )


def boundary_sentences(groups: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence on each preset: the onset by theory and the delays found, over all routes if possible."""
    over_all = [group for group in groups if group["route"] is None] or groups
    return [_boundary_sentence(group) for group in over_all]


def _boundary_sentence(group: Mapping[str, Any]) -> str:
    onset, departure, completion = (
        "not in the searched range" if delay_ms is None else f"{delay_ms:.0f} ms"
        for delay_ms in (group[f"{name}_ms"]["p50"] for name in ("onset", "departure", "completion"))
    )
    route = "all routes" if group["route"] is None else f"route {group['route']}"
    theory = "theory gives no onset of oscillation"
    if group["theory_ms"] is not None:
        theory = f"theory predicts growing oscillation from a total delay of {group['theory_ms']:.0f} ms"
    return (
        f"{group['preset']}, {route}: {theory}. Medians over {group['n']} seed{'s' if group['n'] > 1 else ''}: "
        f"oscillation begins to grow: {onset}; the vehicle first leaves its lane: {departure}; "
        f"the route is no longer completed: {completion}."
    )
