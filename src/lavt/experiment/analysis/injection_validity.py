"""Reasons against the delay injection of a run on two machines, from the measurements of their own netem queues.

A sample is one measurement of a queue (a row of the channel `injection`). When it was taken, it was compared with the
request (`judge` in `transport/netem/queue_probe.py`). This module checks the times and the conditions of the samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lavt.domain import NS_PER_S
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason, not_measured
from lavt.experiment.analysis.metrics import driving_interval
from lavt.recording.record import Record
from lavt.recording.table import Table

SENT_BY = {"video": "server", "control": "client"}
"""For each flow, the side whose queue delays it."""

GAP_LIMIT_S = 20.0
"""The longest time between two samples. Both sides measure every 5 s, and this takes a second plus the delay."""
SMALLEST_LATENCY_SHARE = 0.9
"""The median latency must be at least this share of the injected delay."""


def recorded_reasons(
    server: Record, client: Record, condition: str, requested_ms: Mapping[str, float]
) -> list[InvalidReason]:
    """Return the reasons against the injection of a run; `requested_ms` is the delay of its condition, by flow.

    On the server, the samples from the last one before the drive to the end of the drive are checked. On the client all
    samples are checked, because the times of the drive on its clock are unknown, and it drives under one condition
    only. If `condition` is empty, no condition may have been in force on the server, such as that of another client.
    """
    began_ns, ended_ns, _ = driving_interval(server)
    if not condition:
        names = set(_in_force(server.table("injection"), began_ns, ended_ns).texts("condition")) - {""}
        text = "condition {} was in force on the server, but this run did not request it"
        return [InvalidReason(InvalidCode.INJECTION_NOT_REQUESTED, text.format(name)) for name in names]
    samples = {
        "server": _in_force(server.table("injection"), began_ns, ended_ns),
        "client": client.table("injection"),
    }
    reasons = []
    for side, table in samples.items():
        other_conditions = [name for name in table.texts("condition") if name != condition]
        deviations = [reason for reason in table.texts("reason") if reason]
        if len(table) == 0:
            text = f"the {side} did not report that condition {condition} was in force"
            reasons.append(InvalidReason(InvalidCode.INJECTION_NOT_IN_FORCE, text))
        elif (gap_s := _longest_gap_s(table, ended_ns if side == "server" else None)) > GAP_LIMIT_S:
            text = f"the {side} did not measure condition {condition} for {gap_s:.0f} s"
            reasons.append(InvalidReason(InvalidCode.INJECTION_NOT_MEASURED, text))
        elif other_conditions or deviations:
            first_deviation = f": {deviations[0]}" if deviations else ""
            text = f"condition {condition} was not in force as requested on the {side} all the time{first_deviation}"
            reasons.append(InvalidReason(InvalidCode.INJECTION_NOT_IN_FORCE, text))
    unmeasured = [
        flow for flow, side in SENT_BY.items() if requested_ms[flow] and not _is_measured(samples[side], flow)
    ]
    return reasons + [not_measured(flow) for flow in unmeasured]


def _in_force(table: Table, began_ns: int, ended_ns: int) -> Table:
    """Return the samples of an interval and the last one before it; none without a sample before it."""
    mono_ns = table.ints("mono_ns")
    before_ns = mono_ns[mono_ns <= began_ns]
    first_ns = before_ns.max() if len(before_ns) else ended_ns + 1
    return table.where((mono_ns >= first_ns) & (mono_ns <= ended_ns))


def _longest_gap_s(table: Table, ended_ns: int | None) -> float:
    """Return the longest time without a sample.

    `ended_ns` is the end of the drive on the clock of the samples; None where it is unknown. The time from the last
    sample to this end is included.
    """
    times_ns = np.sort(table.ints("mono_ns"))
    if ended_ns is not None:
        times_ns = np.append(times_ns, max(ended_ns, times_ns[-1]))
    return float(np.max(np.diff(times_ns), initial=0)) / NS_PER_S


def absent_reasons(entry: Mapping[str, Any], requested_ms: Mapping[str, float]) -> list[InvalidReason]:
    """Return a reason for each flow whose latency is less than the requested delay.

    The delay was then injected on another path.

    `entry` has `tau_v_ms` and `tau_c_ms` with their bounds, as in `result.json`.
    """
    reasons = []
    for flow, key in (("video", "tau_v_ms"), ("control", "tau_c_ms")):
        median_ms, bound_ms = entry[key]["p50"], entry[key]["bound"] or 0.0
        if median_ms is not None and median_ms + bound_ms < SMALLEST_LATENCY_SHARE * requested_ms[flow]:
            text = (
                f"the {flow} latency is {median_ms:.1f} ms in the median, although {requested_ms[flow]:g} ms were "
                "injected: the delay is not on its path, check interface and ports"
            )
            reasons.append(InvalidReason(InvalidCode.INJECTION_NOT_ON_PATH, text))
    return reasons


def _is_measured(table: Table, flow: str) -> bool:
    chosen = np.array([name == flow for name in table.texts("flow")], np.bool_)
    return bool(np.isfinite(table.where(chosen).floats("measured_ms")).any())
