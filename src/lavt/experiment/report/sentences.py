"""The sentences of a report, made of its numbers: each is there only where the numbers say so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise, product
from typing import Any

from lavt.experiment.report.figure_style import Conditions

LISTED = 8
"""More conditions than these are not listed in a sentence; the tables have them."""

LEAST_RUNS = 6
"""A condition with fewer runs than there are routes in the paper is not compared with it in words."""

SAME_LOOP_MS = 3.0
"""Medians of loop latency that are nearer than this are one place on its axis."""

DISTINGUISHED_P = 0.05

CLEARLY_FEWER = 2
"""Conditions between all and none completed, of the paper's five."""

Contrast = Mapping[str, Any]

Known = tuple[str, float, float]
"""Name, median loop latency in ms, and completion of a condition."""


def _places(conditions: Conditions) -> list[list[Known]]:
    """Give the conditions that know loop latency and completion, together where they are one place, least first."""
    known = [
        (name, float(entry["loop_ms"]["p50"]), float(entry["completion_rate"]))
        for name, entry in conditions.items()
        if entry["loop_ms"]["p50"] is not None and entry["completion_rate"] is not None
    ]
    begins_ms: list[float] = []
    for _, loop_ms, _ in sorted(known, key=lambda each: each[1]):
        if not begins_ms or loop_ms - begins_ms[-1] > SAME_LOOP_MS:
            begins_ms.append(loop_ms)

    def place(each: Known) -> int:
        return sum(begin_ms <= each[1] for begin_ms in begins_ms)

    return [list(members) for _, members in groupby(sorted(known, key=lambda each: (place(each), each[0])), place)]


def what_was_driven(runs: Sequence[Mapping[str, Any]]) -> str:
    """Say how many runs on how many routes under which conditions there are, and how many of them count."""
    counted = ", ".join(
        f"{many} in {kind} time" for kind in ("virtual", "real") if (many := sum(run["time"] == kind for run in runs))
    )
    routes = sorted({str(run["route"]) for run in runs})
    names = sorted({str(run["condition"]) for run in runs})
    invalid = sum(not run["valid"] for run in runs)
    verdict = f"{invalid} not valid, for reasons given below, and in no statistic" if invalid else "All of them count"
    where = f"{_some('route', routes)} under {_some('condition', names)}"
    return f"{len(runs)} runs: {counted}, on {where}. {verdict}."


def _some(word: str, names: Sequence[str]) -> str:
    if len(names) > LISTED:
        return f"{len(names)} {word}s"
    return f"the {word}{'s' if len(names) > 1 else ''} {', '.join(names)}"


def headline(name: str, conditions: Conditions) -> str:
    """Say of the runs called `name` where completion falls, and by what total latency; nothing without conditions."""
    places = _places(conditions)
    known = [each for place in places for each in place]
    if not known:
        return ""
    parts = []
    if len(known) <= LISTED:
        each = ", ".join(f"{condition} {rate * 100:.0f} % ({loop_ms:.0f} ms)" for condition, loop_ms, rate in known)
        parts.append(f"Completed, by the median loop latency: {each}.")
    parts += _where_it_falls(places)
    errors = [(condition, conditions[condition]["p95_m"]) for condition, _, _ in known]
    told = [(condition, error_m) for condition, error_m in errors if error_m is not None]
    if len(told) > 1:
        (first, least_m), (last, most_m) = told[0], told[-1]
        parts.append(
            f"P95 of the cross-track error, mean of the completed runs: {least_m:.2f} m at {first}, {most_m:.2f} m at "
            f"{last}."
        )
    return f"{name}: {' '.join(parts)}"


def _where_it_falls(places: Sequence[Sequence[Known]]) -> list[str]:
    falls = [each for nearer, farther in pairwise(places) for each in product(nearer, farther)]
    if not falls:
        return []
    before, after = max(falls, key=lambda fall: fall[0][2] - fall[1][2])
    if before[2] <= after[2]:
        return ["Completion does not fall with latency."]
    parts = [
        f"The largest fall is from {before[2] * 100:.0f} % at {before[0]} to {after[2] * 100:.0f} % at {after[0]}: "
        f"between {before[1]:.0f} and {after[1]:.0f} ms in all."
    ]
    last = max((index for index, place in enumerate(places) if any(rate >= 0.5 for _, _, rate in place)), default=-1)
    if last + 1 < len(places):
        begin_ms = min(loop_ms for _, loop_ms, _ in places[last + 1])
        parts.append(f"Under half of the runs are completed from {begin_ms:.0f} ms on.")
    return parts


def equal_totals(contrasts: Sequence[Contrast], conditions: Conditions, paper: Sequence[Contrast]) -> list[str]:
    """Say of each contrast of conditions with equal total injected delay whether and why they are not told apart."""
    theirs = {(contrast["a"], contrast["b"]): contrast for contrast in paper}
    said = []
    for contrast in contrasts:
        a, b = contrast["a"], contrast["b"]
        injected = [_injected(conditions[name]) for name in (a, b) if name in conditions]
        if len(injected) < 2 or any(None in each.values() for each in injected) or contrast["p_holm"] is None:
            continue
        if len({sum(each.values()) for each in injected}) == 1:
            said.append(_equal_total(contrast, conditions, injected, theirs.get((a, b))))
    return said


def _injected(entry: Mapping[str, Any]) -> dict[str, float]:
    return {flow: entry["injected_ms"][flow] for flow in ("video", "control")}


def _equal_total(
    contrast: Contrast, conditions: Conditions, injected: Sequence[Mapping[str, float]], theirs: Contrast | None
) -> str:
    a, b = contrast["a"], contrast["b"]
    ways = [
        f"{name} ({each['video']:.0f} + {each['control']:.0f} ms)" for name, each in zip((a, b), injected, strict=True)
    ]
    begin = f"{ways[0]} and {ways[1]} inject the same total, {sum(injected[0].values()):.0f} ms"
    only = contrast["only_a"] + contrast["only_b"]
    pairs = f"{contrast['pairs'] - only} of {contrast['pairs']} pairs are alike in their completion"
    loops_ms = [conditions[name]["loop_ms"]["p50"] for name in (a, b)]
    if contrast["p_holm"] <= DISTINGUISHED_P:
        return (
            f"{begin}, and yet they can be told apart (p {contrast['p_holm']:.2g} after Holm; {pairs}): something that "
            "sees one channel only matters here."
        )
    if None in loops_ms or abs(loops_ms[0] - loops_ms[1]) > SAME_LOOP_MS:
        return f"{begin}; they cannot be told apart ({pairs}), though their loops differ."
    why = (
        f"{begin}, and so make the same loop: {loops_ms[0]:.1f} and {loops_ms[1]:.1f} ms were measured. They cannot be "
        f"told apart ({pairs}), and this is why: with pure delays and paired seeds only what sees one channel alone "
        "can make a difference: feedback of the speed, a limit on the picture's age, a controller that knows its delay."
    )
    if only:
        why += " Where drives come near to failing, little decides which one does."
    if theirs and theirs["p"] > DISTINGUISHED_P:
        why += f" Nor can the paper's counts be told apart (Fisher, p {theirs['p']:.2f})."
    return why


def differences(conditions: Conditions, paper: Conditions) -> list[str]:
    """Say where these results differ from the paper's, and why; nothing where one of its conditions lacks."""
    if not paper or any(name not in conditions or conditions[name]["runs"] < LEAST_RUNS for name in paper):
        return []
    said = [
        _sharper(conditions, paper),
        _apart(conditions, paper),
        _reference(conditions, paper),
        _rails(conditions, paper),
        _first_step(conditions, paper),
        "What “completed” means: here a collision, leaving the road, a safe stop or the time limit ends a run. The "
        "paper counts collisions in conditions that are completed in full, and does not say what ends a run.",
        "Where completion falls is a property of the controller's gains, which the paper does not publish: "
        "`paper_calibrated` was set by hand to fall where the paper's falls, and other gains on the same testbed fall "
        "elsewhere or not at all. So the fall is no proof of anything about latency alone.",
    ]
    return [sentence for sentence in said if sentence]


def _spread(conditions: Conditions) -> int:
    return sum(0.05 < (entry["completion_rate"] or 0.0) < 0.95 for entry in conditions.values())


def _sharper(conditions: Conditions, paper: Conditions) -> str:
    shared = {name: conditions[name] for name in paper}
    lowest = min(entry["completion_rate"] for entry in shared.values())
    if lowest > 0.5 or _spread(shared) > _spread(paper) - CLEARLY_FEWER:
        return ""
    ours, theirs = (
        ", ".join(f"{of[name]['completion_rate'] * 100:.0f}" for name in paper) for of in (conditions, paper)
    )
    return (
        f"Completion falls more sharply here ({ours} %) than in the paper ({theirs} %): the routes are on one kind of "
        "road, driven at one speed, and share one stability margin. What spreads the paper's runs is not in its text."
    )


def _apart(conditions: Conditions, paper: Conditions) -> str:
    """Say at which conditions completion differs by more than chance explains."""
    apart = []
    for name, its in paper.items():
        ours, theirs = conditions[name]["completion_interval"], its["completion_interval"]
        if ours and (ours[0] > theirs[1] or ours[1] < theirs[0]):
            more = "more" if ours[0] > theirs[1] else "less"
            shares = f"{conditions[name]['completion_rate'] * 100:.0f} % against {its['completion_rate'] * 100:.0f} %"
            apart.append(f"{more} at {name} ({shares})")
    if not apart:
        return "All 95 % intervals of completion overlap with the paper's."
    return (
        f"Completion differs by more than chance explains (intervals that do not overlap): {', '.join(apart)}. No pair "
        "of gains that was tried meets the paper's share under every condition (docs/controllers.md)."
    )


def _reference(conditions: Conditions, paper: Conditions) -> str:
    name = min(paper, key=lambda each: sum(_injected(paper[each]).values()))
    ours_m, theirs_m = conditions[name]["p95_m"], paper[name]["p95_m"]
    if ours_m is None or theirs_m < 5 * ours_m:
        return ""
    return (
        f"The mean P95 at {name} is {ours_m:.2f} m here and {theirs_m:.2f} m in the paper. Whoever is so far from the "
        "middle is out of the lane, but the paper counts "
        f"{paper[name]['lane_invasions_per_run']:.2f} lane invasions a run there: its reference, one of its own "
        "drives, is probably not the middle of the lane that was driven. Ours is that middle."
    )


def _rails(conditions: Conditions, paper: Conditions) -> str:
    ours = [conditions[name]["p95_m"] for name in paper if conditions[name]["p95_m"] is not None]
    theirs_m = max(paper[name]["p95_m"] for name in paper)
    if not ours or max(ours) >= theirs_m or all(conditions[name]["completion_rate"] == 1.0 for name in paper):
        return ""
    return (
        f"The largest mean P95 of a condition's completed runs is {max(ours):.2f} m here and {theirs_m:.2f} m in the "
        "paper: our roads have rails and a median barrier, and whoever reaches one has collided and does not complete. "
        "They bound the error of a completed run."
    )


def _first_step(conditions: Conditions, paper: Conditions) -> str:
    name = next((each for each in paper if sum(_injected(paper[each]).values()) > 0), None)
    if name is None or not (paper[name]["completion_rate"] < 1.0 == conditions[name]["completion_rate"]):
        return ""
    its, ours = paper[name], conditions[name]["completion_interval"]
    overlap = " The 95 % intervals overlap." if ours and ours[0] <= its["completion_interval"][1] else ""
    return (
        f"{name} is completed in full here, and {its['completed']} times of {its['runs']} in the paper, which does "
        f"not say what stopped the others; nothing that is modelled here would.{overlap}"
    )


def boundary_sentences(groups: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say of each preset of a boundary, over all routes where there are several, what theory and the drives say."""
    over_all = [group for group in groups if group["route"] is None] or groups
    return [_boundary_sentence(group) for group in over_all]


def _boundary_sentence(group: Mapping[str, Any]) -> str:
    onset, departure, completion = (_delay(group[f"{name}_ms"]["p50"]) for name in ("onset", "departure", "completion"))
    seeds = f"{group['n']} seed{'s' if group['n'] > 1 else ''}"
    return (
        f"{group['preset']}, {_where(group['route'])}: by theory a swing grows from {_delay(group['theory_ms'])} of "
        f"total delay; over {seeds} it does so in the median from {onset}, the car first leaves its lane at "
        f"{departure}, and the route is no longer completed at {completion}."
    )


def _where(route: str | None) -> str:
    return "all routes" if route is None else f"route {route}"


def _delay(delay_ms: float | None) -> str:
    return "none that was searched" if delay_ms is None else f"{delay_ms:.0f} ms"
