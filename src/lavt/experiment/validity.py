"""Whether a run may count. Only the infrastructure is looked at, never how the driving went."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.latency import frames_within
from lavt.experiment.metrics import Measured, count, driving_interval
from lavt.experiment.record import Record
from lavt.experiment.table import MISSING, IntArray, Table

STEP_LIMIT_MS = 5.0
"""A wall clock that moves this much against the monotonic clock between two samples was set."""
POLL_LIMIT_S = 2.5
"""Clocks are sampled every second: one sample may be late or missing, and no more."""
CLOCK_BOUND_LIMIT_MS = 2.0
"""Beyond this the split of the loop into tau_v and tau_c says too little."""
CLOSURE_LIMIT_MS = 1.0
LATE_LIMIT = 0.01
"""Share of the drive for which the physics may lag behind, hitches of over 50 ms counted."""
SKIPPED_LIMIT = 0.01
"""Share of camera ticks that may be missed."""
INJECTION_LIMIT_MS = 1.0
"""How far the injected delay may be from what was asked."""


def invalid_because(server: Record, client: Record, measured: Measured) -> list[str]:
    """Say why a run must not count, one sentence a reason; an empty list is a valid run."""
    return [
        *_record_reasons("server", server),
        *_record_reasons("client", client),
        *_clock_reasons(measured),
        *_step_reasons("server", server.table("clock")),
        *_step_reasons("client", client.table("clock")),
        *_poll_reasons(server, client),
        *_closure_reasons(measured),
        *_tick_reasons(server),
    ]


def _record_reasons(side: str, record: Record) -> list[str]:
    reasons = [] if record.complete else [f"the record of the {side} is not complete"]
    lost = count(record, "record_overflow") or 0
    if lost > 0:
        reasons.append(f"the record of the {side} lost {lost} messages because its queue was full")
    return reasons


def _clock_reasons(measured: Measured) -> list[str]:
    bound_ms = measured.clock_bound_ms
    if bound_ms is None:
        return ["the offset between the clocks has no bound"]
    if bound_ms > CLOCK_BOUND_LIMIT_MS:
        return [f"the offset between the clocks is only known to {bound_ms:.2f} ms (limit {CLOCK_BOUND_LIMIT_MS} ms)"]
    return []


def _step_reasons(side: str, samples: Table) -> list[str]:
    mono_ns, wall_ns = samples.ints("mono_ns"), samples.ints("wall_ns")
    known = (mono_ns != MISSING) & (wall_ns != MISSING)
    jumps_ms = np.diff(wall_ns[known] - mono_ns[known]) / NS_PER_MS
    if len(jumps_ms) == 0 or np.max(np.abs(jumps_ms)) <= STEP_LIMIT_MS:
        return []
    largest_ms = jumps_ms[np.argmax(np.abs(jumps_ms))]
    return [f"the wall clock of the {side} stepped by {largest_ms:+.1f} ms"]


def _poll_reasons(server: Record, client: Record) -> list[str]:
    """Look for samples of the clocks that are missing: without them the offset is only guessed.

    On the server they must follow each other from the drive's beginning to its end. The client's monotonic clock does
    not know when that was: its samples must follow each other, and reach over as much time as the drive took.
    """
    began_ns, ended_ns, _ = driving_interval(server)
    if began_ns > ended_ns:
        return []
    server_ns, client_ns = _sampled_ns(server), _sampled_ns(client)
    in_drive = (server_ns[1:] > began_ns) & (server_ns[:-1] < ended_ns)
    longest_ns = {
        "server": max(
            *(
                min(np.abs(server_ns - edge_ns).tolist(), default=ended_ns - began_ns)
                for edge_ns in (began_ns, ended_ns)
            ),
            int(np.max(np.diff(server_ns)[in_drive], initial=0)),
        ),
        "client": int(np.max(np.diff(client_ns), initial=0)),
    }
    reasons = [
        f"the clock of the {side} was not sampled for {gap_ns / NS_PER_S:.1f} s (limit {POLL_LIMIT_S} s)"
        for side, gap_ns in longest_ns.items()
        if gap_ns > POLL_LIMIT_S * NS_PER_S
    ]
    covered_s, drive_s = (int(np.ptp(client_ns)) if len(client_ns) else 0) / NS_PER_S, (ended_ns - began_ns) / NS_PER_S
    if drive_s - covered_s > 2 * POLL_LIMIT_S:  # one at the beginning, one at the end
        reasons.append(f"the clock samples of the client reach over {covered_s:.1f} s of a drive of {drive_s:.1f} s")
    return reasons


def _sampled_ns(record: Record) -> IntArray:
    """When a side's clocks were sampled, on its monotonic clock."""
    mono_ns = record.table("clock").ints("mono_ns")
    return np.sort(mono_ns[mono_ns != MISSING])


def _closure_reasons(measured: Measured) -> list[str]:
    closure_ms = measured.closure_p95_ms
    if closure_ms is None or closure_ms <= CLOSURE_LIMIT_MS:
        return []
    return [f"the parts of the loop miss the whole by {closure_ms:.2f} ms (p95, limit {CLOSURE_LIMIT_MS} ms)"]


def _tick_reasons(server: Record) -> list[str]:
    """Look at what was late or missed while it was driven; before and after it does not matter."""
    began_ns, ended_ns, ending = driving_interval(server)
    reasons = [] if ending is not None else ["the record has no ending"]
    events = server.table("event")
    events = events.where((events.ints("mono_ns") >= began_ns) & (events.ints("mono_ns") <= ended_ns))
    late_ms = [
        int(detail.removesuffix(" ms"))
        for kind, detail in zip(events.texts("kind"), events.texts("detail"), strict=True)
        if kind == "late"
    ]
    if sum(late_ms) * NS_PER_MS > LATE_LIMIT * (ended_ns - began_ns):
        reasons.append(f"the physics was {sum(late_ms)} ms late in all (limit {LATE_LIMIT:.0%} of the drive)")
    numbers = frames_within(server.table("frame"), began_ns, ended_ns).ints("number")
    ticks = int(numbers[-1] - numbers[0]) + 1 if len(numbers) else 0
    skipped = ticks - len(numbers)
    if skipped > SKIPPED_LIMIT * ticks:
        reasons.append(f"the camera missed {skipped} of {ticks} ticks (limit {SKIPPED_LIMIT:.0%})")
    return reasons


def injection_reasons(asked_ms: Mapping[str, float], measured_ms: Mapping[str, float | None]) -> list[str]:
    """Compare the delay asked for with the median that the relay or netem measured, per direction, in milliseconds."""
    reasons = []
    for direction, delay_ms in asked_ms.items():
        found_ms = measured_ms.get(direction)
        if found_ms is None:
            reasons.append(f"nobody measured the injected delay of {direction}")
        elif abs(found_ms - delay_ms) > INJECTION_LIMIT_MS:
            reasons.append(f"{direction} was delayed by {found_ms:.1f} ms where {delay_ms:g} ms was asked")
    return reasons
