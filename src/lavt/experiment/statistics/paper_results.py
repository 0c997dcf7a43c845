"""The paper's results, for comparison, and the intervals and tests that can be computed from its counts.

A. Khalil, J. Kwon, "Nonlinear Performance Degradation of Vision-Based Teleoperation under Network Latency", 2026. The
paper has six routes and five repetitions, so 30 runs per condition. It gives completion in percent, which is converted
to a number of runs here.
"""

from __future__ import annotations

from typing import Any

from lavt.experiment.statistics.contrasts import PLANNED, fisher, with_holm
from lavt.experiment.statistics.intervals import exact_interval

REFERENCE = (
    "A. Khalil, J. Kwon, “Nonlinear Performance Degradation of Vision-Based Teleoperation under Network Latency”, 2026."
)

RUNS = 30

COLUMNS = (
    "video",
    "control",
    "tau_v_ms",
    "tau_c_ms",
    "completed",
    "collisions_per_run",
    "lane_invasions_per_run",
    "p95_m",
)
TABLE = {
    "L0": (0, 0, 62, 9, 30, 0.20, 0.40, 2.30),
    "L1": (75, 0, 136, 9, 28, 0.23, 3.97, 2.73),
    "L2": (150, 0, 211, 9, 15, 0.67, 15.10, 3.91),
    "L3": (225, 0, 287, 9, 11, 0.83, 22.13, 9.25),
    "L4": (150, 75, 211, 83, 9, 0.77, 18.80, 4.64),
    "L5": (225, 100, 287, 108, 3, 0.97, 16.83, 13.15),
}
"""The values of `COLUMNS` by condition: the injected delays of video and control (ms), the measured medians (ms; the
paper's tau_c is "about 8 to 10" for L0 to L3), and the results."""


def paper() -> dict[str, Any]:
    """Return the paper's conditions with the keys of `summary.json` and exact intervals, and its planned contrasts.

    The contrasts use Fisher's test: the paper publishes only counts, so its runs cannot be paired.
    """
    conditions = {name: _condition(dict(zip(COLUMNS, row, strict=True))) for name, row in TABLE.items()}
    contrasts = [
        {"a": a, "b": b, "p": fisher(conditions[a]["completed"], RUNS, conditions[b]["completed"], RUNS)}
        for a, b in PLANNED
    ]
    return {"conditions": conditions, "contrasts": with_holm(contrasts)}


def _condition(row: dict[str, Any]) -> dict[str, Any]:
    injected_ms = {"video": row.pop("video"), "control": row.pop("control")}
    completed = row.pop("completed")
    return {
        "runs": RUNS,
        "completed": completed,
        "completion_rate": completed / RUNS,
        "completion_interval": exact_interval(completed, RUNS),
        "injected_ms": injected_ms,
        **row,
    }
