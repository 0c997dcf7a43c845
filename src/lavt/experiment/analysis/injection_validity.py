"""The checks of the delay injection of a run on two machines, from measurements that the machines made of their queues.

A sample is one measurement of a netem queue (a row of the channel `injection`). The machine compared the sample with
the request immediately (`judge` in `transport/netem/queue_probe.py`). This module checks when samples were taken, and
under which condition.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lavt.domain import NS_PER_S
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason, MeasuredCheck, not_measured
from lavt.experiment.analysis.metrics import driving_interval
from lavt.recording.record import Record
from lavt.recording.table import Table

SENDING_SIDE = {"video": "server", "control": "client"}
"""For each flow, the side whose queue delays it."""

GAP_LIMIT_S = 20.0
"""The longest time between two samples. Both sides measure every 5 s, and a measurement takes a second plus the
delay."""
SMALLEST_LATENCY_SHARE = 0.9
"""The median latency must be at least this share of the injected delay."""


def recorded_reasons(
    server: Record, client: Record, condition: str, requested_ms: Mapping[str, float]
) -> list[InvalidReason]:
    """Return the reasons why the injection makes a run invalid; `requested_ms` is the delay of its condition, by flow.

    The server's samples are checked from the last sample before the drive to the end of the drive. All samples of the
    client are checked, because the times of the drive on the client's clock are unknown, and a client has only one
    condition. An empty `condition` means that the run requested none; a condition that was nevertheless in force on the
    server, such as another client's, is then a reason.
    """
    began_ns, ended_ns, _ = driving_interval(server)
    if not condition:
        names = set(_samples_covering(server.table("injection"), began_ns, ended_ns).texts("condition")) - {""}
        text = "condition {} was in force on the server, but this run did not request it"
        return [InvalidReason(InvalidCode.INJECTION_NOT_REQUESTED, text.format(name)) for name in names]
    samples = {
        "server": _samples_covering(server.table("injection"), began_ns, ended_ns),
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
        flow for flow, side in SENDING_SIDE.items() if requested_ms[flow] and not _is_measured(samples[side], flow)
    ]
    return reasons + [not_measured(flow) for flow in unmeasured]


def _samples_covering(table: Table, began_ns: int, ended_ns: int) -> Table:
    """Return the samples of an interval and the last sample before it; none if there is no sample before it.

    The sample before the interval shows which condition was in force at its beginning.
    """
    mono_ns = table.ints("mono_ns")
    before_ns = mono_ns[mono_ns <= began_ns]
    first_ns = before_ns.max() if len(before_ns) else ended_ns + 1
    return table.where((mono_ns >= first_ns) & (mono_ns <= ended_ns))


def _longest_gap_s(table: Table, ended_ns: int | None) -> float:
    """Return the longest time without a sample.

    `ended_ns` is the end of the drive on the clock of the samples; None: unknown. The time between the last sample and
    this end is included.
    """
    times_ns = np.sort(table.ints("mono_ns"))
    if ended_ns is not None:
        times_ns = np.append(times_ns, max(ended_ns, times_ns[-1]))
    return float(np.max(np.diff(times_ns), initial=0)) / NS_PER_S


def missing_delay_reasons(entry: Mapping[str, Any], requested_ms: Mapping[str, float]) -> list[InvalidReason]:
    """Return a reason for each flow whose latency is clearly smaller than the requested delay.

    The delay was then injected elsewhere than on the network path of the flow. `entry` has `tau_v_ms` and `tau_c_ms`
    with their bounds, as in `result.json`.
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


def path_checks(entry: Mapping[str, Any], requested_ms: Mapping[str, float]) -> list[MeasuredCheck]:
    """Return the check of `missing_delay_reasons`: the largest share of a flow's delay that its latency lacks."""
    missing = [
        1 - (entry[key]["p50"] + (entry[key]["bound"] or 0.0)) / requested_ms[flow]
        for flow, key in (("video", "tau_v_ms"), ("control", "tau_c_ms"))
        if requested_ms.get(flow) and entry[key]["p50"] is not None
    ]
    limit = round(1 - SMALLEST_LATENCY_SHARE, 9)
    return [MeasuredCheck(InvalidCode.INJECTION_NOT_ON_PATH, max(*missing, 0.0), limit)] if missing else []


def _is_measured(table: Table, flow: str) -> bool:
    chosen = np.array([name == flow for name in table.texts("flow")], np.bool_)
    return bool(np.isfinite(table.where(chosen).floats("measured_ms")).any())
