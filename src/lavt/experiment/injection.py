"""Whether the delay that two machines injected was what was asked, from what they measured of their own queues.

Each sample was judged when it was taken (`transport/netem_probe.judge`): here it counts when, and of which condition.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lavt.experiment.metrics import driving_interval
from lavt.experiment.record import Record
from lavt.experiment.table import Table

SENT_BY = {"video": "server", "control": "client"}
"""Whose queue delays it."""


def recorded_reasons(server: Record, client: Record, condition: str, asked_ms: Mapping[str, float]) -> list[str]:
    """Say what speaks against the injection of a run; `asked_ms` is that of its condition, by flow.

    On the server only samples from the last before the drive to its end count; of the client all do, because its clock
    does not know when the drive was, and it drives under one condition only.
    """
    began_ns, ended_ns, _ = driving_interval(server)
    samples = {
        "server": _in_force(server.table("injection"), began_ns, ended_ns),
        "client": client.table("injection"),
    }
    reasons = []
    for side, table in samples.items():
        others = [each for each in table.texts("condition") if each != condition]
        doubts = [each for each in table.texts("because") if each]
        if len(table) == 0:
            reasons.append(f"the {side} did not say that condition {condition} was in force")
        elif others or doubts:
            because = f": {doubts[0]}" if doubts else ""
            reasons.append(f"condition {condition} was not in force as asked on the {side} all the time{because}")
    unmeasured = [flow for flow, side in SENT_BY.items() if asked_ms[flow] and not _is_measured(samples[side], flow)]
    return reasons + [f"nobody measured the injected delay of {flow}" for flow in unmeasured]


def _in_force(table: Table, began_ns: int, ended_ns: int) -> Table:
    """Samples that tell of an interval: those within, and the last one before it."""
    mono_ns = table.ints("mono_ns")
    before_ns = mono_ns[mono_ns <= began_ns]
    first_ns = before_ns.max() if len(before_ns) else ended_ns + 1  # none before it: nobody knows how it began
    return table.where((mono_ns >= first_ns) & (mono_ns <= ended_ns))


def _is_measured(table: Table, flow: str) -> bool:
    chosen = np.array([each == flow for each in table.texts("flow")], np.bool_)
    return bool(np.isfinite(table.where(chosen).floats("measured_ms")).any())
