"""Whether the delay that two machines injected was what was asked, from what they measured of their own queues.

Each sample was judged when it was taken (`transport/netem_probe.judge`): here it counts when, and of which condition.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lavt.domain import NS_PER_S
from lavt.experiment.analysis.metrics import driving_interval
from lavt.recording.record import Record
from lavt.recording.table import Table

SENT_BY = {"video": "server", "control": "client"}
"""Whose queue delays it."""


SILENCE_LIMIT_S = 20.0
"""Both measure every 5 s, which takes a second and the delay: longer without a sample, and nobody knows."""
LEAST_SHARE = 0.9
"""Of a constant delay the whole must be there; laws with jitter can have a median below it."""


def recorded_reasons(server: Record, client: Record, condition: str, requested_ms: Mapping[str, float]) -> list[str]:
    """Say what speaks against the injection of a run; `requested_ms` is that of its condition, by flow.

    On the server only samples from the last before the drive to its end count; of the client all do, because its clock
    does not know when the drive was, and it drives under one condition only. Without a condition (empty) none may have
    been in force, as another client's could.
    """
    began_ns, ended_ns, _ = driving_interval(server)
    if not condition:
        strange = set(_in_force(server.table("injection"), began_ns, ended_ns).texts("condition")) - {""}
        return [f"condition {each} was in force on the server, which this run did not ask for" for each in strange]
    samples = {
        "server": _in_force(server.table("injection"), began_ns, ended_ns),
        "client": client.table("injection"),
    }
    reasons = []
    for side, table in samples.items():
        others = [each for each in table.texts("condition") if each != condition]
        doubts = [each for each in table.texts("reason") if each]
        if len(table) == 0:
            reasons.append(f"the {side} did not say that condition {condition} was in force")
        elif (silent_s := _silent_s(table, ended_ns if side == "server" else None)) > SILENCE_LIMIT_S:
            reasons.append(f"the {side} did not measure condition {condition} for {silent_s:.0f} s")
        elif others or doubts:
            reason = f": {doubts[0]}" if doubts else ""
            reasons.append(f"condition {condition} was not in force as asked on the {side} all the time{reason}")
    unmeasured = [
        flow for flow, side in SENT_BY.items() if requested_ms[flow] and not _is_measured(samples[side], flow)
    ]
    return reasons + [f"nobody measured the injected delay of {flow}" for flow in unmeasured]


def _in_force(table: Table, began_ns: int, ended_ns: int) -> Table:
    """Samples that tell of an interval: those within, and the last one before it."""
    mono_ns = table.ints("mono_ns")
    before_ns = mono_ns[mono_ns <= began_ns]
    first_ns = before_ns.max() if len(before_ns) else ended_ns + 1  # none before it: nobody knows how it began
    return table.where((mono_ns >= first_ns) & (mono_ns <= ended_ns))


def _silent_s(table: Table, ended_ns: int | None) -> float:
    """Give the longest time without a sample, up to the drive's end where it is known on the same clock."""
    times_ns = np.sort(table.ints("mono_ns"))
    if ended_ns is not None:
        times_ns = np.append(times_ns, max(ended_ns, times_ns[-1]))
    return float(np.max(np.diff(times_ns), initial=0)) / NS_PER_S


def absent_reasons(entry: Mapping[str, Any], requested_ms: Mapping[str, float]) -> list[str]:
    """Say where latencies are too short for what was injected: it was on another path than the video or the control.

    `entry` has `tau_v_ms` and `tau_c_ms` with their bounds, as in `result.json`.
    """
    reasons = []
    for flow, key in (("video", "tau_v_ms"), ("control", "tau_c_ms")):
        median_ms, bound_ms = entry[key]["p50"], entry[key]["bound"] or 0.0
        if median_ms is not None and median_ms + bound_ms < LEAST_SHARE * requested_ms[flow]:
            reasons.append(
                f"the {flow} took {median_ms:.1f} ms in the median where {requested_ms[flow]:g} ms were injected: the "
                "delay is not on its path, look at interface and ports"
            )
    return reasons


def _is_measured(table: Table, flow: str) -> bool:
    chosen = np.array([each == flow for each in table.texts("flow")], np.bool_)
    return bool(np.isfinite(table.where(chosen).floats("measured_ms")).any())
