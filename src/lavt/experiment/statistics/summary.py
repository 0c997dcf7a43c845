"""`summary.json`: many runs, summarized by condition. `docs/metrics.md` defines every number."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lavt.experiment.statistics.conditions import Run, summarize_conditions
from lavt.experiment.statistics.contrasts import paired_contrasts
from lavt.experiment.statistics.controllers import compare_controllers
from lavt.experiment.statistics.paper_results import paper

SCHEMA = 2

GROUP_KEYS = ("fidelity", "inherent", "changes", "controller", "preset", "driver")
"""The keys whose values are equal for all runs of a group, besides the axes of the sweep.

The runs of a group differ only in route, condition, repetition and seed, and in the keys of a study."""

SWEEP = "sweep"
"""A further key of a group if several sweeps are reported together: the name of the sweep."""


def summarize(
    runs: Sequence[Run],
    speed: Mapping[str, Any] | None,
    *,
    base: Mapping[str, Any] | None = None,
    failed: Sequence[Mapping[str, str]] = (),
) -> dict[str, Any]:
    """Return the content of `summary.json` for the runs of a sweep.

    `base` has keys of a run (or of its `axes`) with their values in the sweep's base config, which is the sweep's
    config without its axes. The entry `conditions` summarizes the runs in virtual time that have all these values or,
    without `base`, all runs in virtual time. `failed` lists the runs without a result (`run`, `reason`).
    """
    virtual = [run for run in runs if run["time"] == "virtual"]
    base_settings = dict(base or {})
    base_runs = [run for run in virtual if _settings(run, base_settings) == base_settings]
    return {
        "schema": SCHEMA,
        "speed": dict(speed) if speed else {"simulated_s": None, "wall_s": None, "jobs": None},
        "runs": [dict(run) for run in runs],
        "failed": [dict(run) for run in failed],
        "conditions": summarize_conditions(base_runs),
        "contrasts": paired_contrasts(base_runs),
        "real": summarize_conditions(run for run in runs if run["time"] == "real"),
        "groups": _summarize_groups(virtual),
        "controllers": compare_controllers(runs),
        "paper": paper(),
    }


def _settings(run: Run, names: Iterable[str]) -> dict[str, Any]:
    axes = run.get("axes") or {}
    return {name: axes[name] if name in axes else run.get(name) for name in names}


def _summarize_groups(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Summarize the runs of each group, in the order of the runs; the axes of the sweep are group keys, too."""
    axes = list(dict.fromkeys(name for run in runs for name in run.get("axes") or {}))
    sweeps = [SWEEP] if any(SWEEP in run for run in runs) else []
    names = [*GROUP_KEYS, *sweeps, *(name for name in axes if name not in GROUP_KEYS)]
    groups: dict[str, list[Run]] = {}  # by the JSON of their settings
    for run in runs:
        groups.setdefault(json.dumps(_settings(run, names), sort_keys=True, default=str), []).append(run)
    return [
        {**_settings(group[0], names), "conditions": summarize_conditions(group), "contrasts": paired_contrasts(group)}
        for group in groups.values()
    ]
