"""`summary.json`: many runs as conditions. `docs/metrics.md` has the meaning of every number."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lavt.experiment.statistics import bootstrap_interval, wilson_interval

SCHEMA = 1

Run = Mapping[str, Any]
"""An entry of `runs`, as `results.run_result` makes it."""

GROUPING = ("fidelity", "inherent", "changes", "controller", "preset", "driver")
"""Besides a sweep's own axes, what runs of one group have in common."""


def summarize(
    runs: Sequence[Run], speed: Mapping[str, Any] | None, *, base: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Make the whole of `summary.json` of a sweep's runs.

    `base` names keys of a run (or of its `axes`) and the value each has in the sweep's base config; `conditions` holds
    the virtual runs that have them all. Without it every virtual run belongs to the base config.
    """
    virtual = [run for run in runs if run["time"] == "virtual"]
    wanted = dict(base or {})
    return {
        "schema": SCHEMA,
        "speed": dict(speed) if speed else {"simulated_s": None, "wall_s": None, "jobs": None},
        "runs": [dict(run) for run in runs],
        "conditions": by_condition(run for run in virtual if _settings(run, wanted) == wanted),
        "real": by_condition(run for run in runs if run["time"] == "real"),
        "groups": _groups(virtual),
    }


def _settings(run: Run, names: Iterable[str]) -> dict[str, Any]:
    axes = run.get("axes") or {}
    return {name: axes[name] if name in axes else run.get(name) for name in names}


def _groups(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Every combination of the grouping keys and the further axes that was driven, in the order of the sweep."""
    axes = list(dict.fromkeys(name for run in runs for name in run.get("axes") or {}))
    names = [*GROUPING, *(name for name in axes if name not in GROUPING)]
    members: dict[str, list[Run]] = {}
    for run in runs:
        members.setdefault(json.dumps(_settings(run, names), sort_keys=True, default=str), []).append(run)
    return [{**_settings(group[0], names), "conditions": by_condition(group)} for group in members.values()]


def by_condition(runs: Iterable[Run]) -> dict[str, dict[str, Any]]:
    """Aggregate runs condition by condition, in order of the conditions' names."""
    members: dict[str, list[Run]] = {}
    for run in runs:
        members.setdefault(str(run["condition"]), []).append(run)
    return {name: condition_summary(members[name]) for name in sorted(members)}


def condition_summary(all_runs: Sequence[Run]) -> dict[str, Any]:
    """Aggregate the runs of one condition. Runs that are not valid are left out of everything."""
    runs = [run for run in all_runs if run["valid"]]
    completed = [run for run in runs if run["ending"] == "completed"]
    p95_m = [run["p95_m"] for run in completed if run["p95_m"] is not None]
    return {
        "runs": len(runs),
        "completed": len(completed),
        "completion_rate": len(completed) / len(runs) if runs else None,
        "completion_interval": wilson_interval(len(completed), len(runs)),
        "collisions_per_run": _mean([run["collisions"] for run in runs]),
        "lane_invasions_per_run": _mean([run["lane_invasions"] for run in runs]),
        "p95_m": _mean(p95_m),
        "p95_interval": bootstrap_interval(p95_m),
        "injected_ms": _injected_ms(all_runs),
        "tau_v_ms": _latency([run["tau_v_ms"] for run in runs], bounded=True),
        "tau_c_ms": _latency([run["tau_c_ms"] for run in runs], bounded=True),
        "loop_ms": _latency([run["loop_ms"] for run in runs], bounded=False),
    }


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _injected_ms(runs: Sequence[Run]) -> dict[str, Any]:
    """Say what was asked of the network; the runs of a condition were all asked the same."""
    asked: Mapping[str, Any] = next((run["injected_ms"] for run in runs if run.get("injected_ms")), {})
    return {"video": asked.get("video"), "control": asked.get("control")}


def _latency(entries: Sequence[Mapping[str, Any]], *, bounded: bool) -> dict[str, Any]:
    """Median over runs of each run's percentiles; the largest bound, null as soon as one run has none."""
    known = [entry for entry in entries if entry["n"]]
    summary: dict[str, Any] = {
        name: float(np.median([entry[name] for entry in known])) if known else None for name in ("p5", "p50", "p95")
    }
    if bounded:
        bounds = [entry["bound"] for entry in known]
        summary["bound"] = max(bounds) if bounds and None not in bounds else None
    summary["n"] = sum(entry["n"] for entry in known)
    return summary
