"""Totals over the drives of a fleet, with the drive as the unit of every interval."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lavt.experiment.compliance.criteria import CRITERIA, as_bounds
from lavt.experiment.statistics.intervals import cluster_interval, exact_interval

Entry = Mapping[str, Any]
"""The entry of one drive."""


def condition_name(entry: Entry) -> str:
    """Return the name of a drive's network condition, and whether the run's config changed some of its values."""
    return f"{entry['condition']}, changed" if entry.get("changes") else str(entry["condition"])


GROUPS: Mapping[str, Callable[[Entry], str]] = {
    "time": lambda entry: f"{entry['time']} time",
    "condition": lambda entry: f"condition {condition_name(entry)}",
}
"""How drives are grouped, if they differ: by the kind of time, and by the network condition."""


def fleet_totals(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return the totals of all drives, and those of each group of drives in which not all drives are."""
    totals = [{"group": "all drives", **_totals(entries)}] if entries else []
    for name_of in GROUPS.values():
        members: dict[str, list[Entry]] = {}
        for entry in entries:
            members.setdefault(name_of(entry), []).append(entry)
        if len(members) > 1:
            totals += [{"group": name, **_totals(members[name])} for name in sorted(members)]
    return totals


def _totals(entries: Sequence[Entry]) -> dict[str, Any]:
    commanded_s = sum(entry["commanded_s"] for entry in entries)
    return {
        "drives": len(entries),
        "commanded_s": commanded_s,
        **{
            f"{name}_share": _pooled_share(entries, f"{name}_share", commanded_s) for name in ("above", "two_way_above")
        },
        "longest_above_s": _largest(entries, "longest_above_s"),
        "outages": sum(entry["outages"] for entry in entries),
        "outage_s": sum(entry["outage_s"] for entry in entries),
        "longest_outage_s": max(entry["longest_outage_s"] for entry in entries),
        "manoeuvres": sum(entry["manoeuvres"] for entry in entries),
        "longest_manoeuvre_s": _largest(entries, "longest_manoeuvre_s"),
        "too_fast_share": _pooled_share(entries, "too_fast_share", commanded_s),
        "mean_above_share_per_drive": _mean_share([entry["above_share"] for entry in entries]),
        "verdict": _verdict_counts([entry["verdict"] for entry in entries]),
        "verdicts": {
            key: {
                "largest": _largest(entries, key),
                **_verdict_counts([entry["verdicts"][key] for entry in entries]),
            }
            for key in CRITERIA
        },
    }


def _pooled_share(entries: Sequence[Entry], key: str, commanded_s: float) -> tuple[float, float]:
    """Return the bounds of a share of the commanded time of all drives together."""
    low, high = (sum(entry[key][side] * entry["commanded_s"] for entry in entries) / commanded_s for side in (0, 1))
    return min(low, 1.0), min(high, 1.0)


def _largest(entries: Sequence[Entry], key: str) -> tuple[float, float]:
    bounds = [as_bounds(entry[key]) for entry in entries]
    low, high = (max(bound[side] for bound in bounds) for side in (0, 1))
    return low, high


def _mean_share(shares: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Return the bounds of the mean share per drive, and its 95 % interval for drives like these.

    The interval covers both bounds of each drive. It is None for too few drives, and if all are equal.
    """
    intervals = [cluster_interval([share[side] for share in shares]) for side in (0, 1)]
    means = tuple(float(np.mean([share[side] for share in shares])) for side in (0, 1))
    low, high = intervals
    return {"mean": means, "interval": None if low is None or high is None else (low[0], high[1]), "unit": "drive"}


def _verdict_counts(verdicts: Sequence[str]) -> dict[str, Any]:
    """Return how many drives have each verdict, and the 95 % interval of the share of drives that are above.

    A drive that is not decided may be above or not: the interval begins as if none of these were, and ends as if all
    were. It is Clopper and Pearson's, for drives like these; None for a single drive.
    """
    count = len(verdicts)
    above, undecided = verdicts.count("above"), verdicts.count("not decided")
    trials = count if count > 1 else 0  # one drive is an example
    low, high = exact_interval(above, trials), exact_interval(above + undecided, trials)
    return {
        "drives": count,
        "within": verdicts.count("within"),
        "above": above,
        "not_decided": undecided,
        "above_interval": None if low is None or high is None else (low[0], high[1]),
        "unit": "drive",
    }
