"""`summary.json`: many runs as conditions. `docs/metrics.md` has the meaning of every number."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lavt.experiment.statistics.conditions import Run, by_condition
from lavt.experiment.statistics.contrasts import paired_contrasts
from lavt.experiment.statistics.paper_results import paper

SCHEMA = 1

GROUPING = ("fidelity", "inherent", "changes", "controller", "preset", "driver")
"""Besides a sweep's own axes, what runs of one group have in common."""

SWEEP = "sweep"
"""The same, where runs of several sweeps are reported together: the name of each run's sweep."""


def summarize(
    runs: Sequence[Run],
    speed: Mapping[str, Any] | None,
    *,
    base: Mapping[str, Any] | None = None,
    failed: Sequence[Mapping[str, str]] = (),
) -> dict[str, Any]:
    """Make the whole of `summary.json` of a sweep's runs.

    `base` names keys of a run (or of its `axes`) and the value each has in the sweep's base config; `conditions` holds
    the virtual runs that have them all. Without it every virtual run belongs to the base config. `failed` says which
    runs have no result (`run`), and why (`reason`).
    """
    virtual = [run for run in runs if run["time"] == "virtual"]
    wanted = dict(base or {})
    of_base = [run for run in virtual if _settings(run, wanted) == wanted]
    return {
        "schema": SCHEMA,
        "speed": dict(speed) if speed else {"simulated_s": None, "wall_s": None, "jobs": None},
        "runs": [dict(run) for run in runs],
        "failed": [dict(each) for each in failed],
        "conditions": by_condition(of_base),
        "contrasts": paired_contrasts(of_base),
        "real": by_condition(run for run in runs if run["time"] == "real"),
        "groups": _groups(virtual),
        "paper": paper(),
    }


def _settings(run: Run, names: Iterable[str]) -> dict[str, Any]:
    axes = run.get("axes") or {}
    return {name: axes[name] if name in axes else run.get(name) for name in names}


def _groups(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Every combination of the grouping keys and the further axes that was driven, in the order of the sweep."""
    axes = list(dict.fromkeys(name for run in runs for name in run.get("axes") or {}))
    sweeps = [SWEEP] if any(SWEEP in run for run in runs) else []
    names = [*GROUPING, *sweeps, *(name for name in axes if name not in GROUPING)]
    members: dict[str, list[Run]] = {}
    for run in runs:
        members.setdefault(json.dumps(_settings(run, names), sort_keys=True, default=str), []).append(run)
    return [
        {**_settings(group[0], names), "conditions": by_condition(group), "contrasts": paired_contrasts(group)}
        for group in members.values()
    ]
