"""Whether a run may count. Only the infrastructure is looked at, never how the driving went."""

from __future__ import annotations

from collections.abc import Mapping

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.clock_validity import offset_reasons, poll_reasons, step_reasons
from lavt.experiment.analysis.latency import frames_within
from lavt.experiment.analysis.metrics import RunMeasurement, count, driving_interval
from lavt.recording.record import Record

CLOSURE_LIMIT_MS = 1.0
LATE_LIMIT = 0.01
"""Share of the drive for which the physics may lag behind, hitches of over 50 ms counted."""
SKIPPED_LIMIT = 0.01
"""Share of camera ticks that may be missed."""
INJECTION_LIMIT_MS = 1.0
"""How far the injected delay may be from what was asked."""


def invalid_reasons(server: Record, client: Record, measured: RunMeasurement) -> list[str]:
    """Say why a run must not count, one sentence a reason; an empty list is a valid run."""
    return [
        *_record_reasons("server", server),
        *_record_reasons("client", client),
        *_clock_reasons(server, client, measured),
        *_tick_reasons(server),
    ]


def _record_reasons(side: str, record: Record) -> list[str]:
    reasons = [] if record.complete else [f"the record of the {side} is not complete"]
    lost = count(record, "record_overflow") or 0
    if lost > 0:
        reasons.append(f"the record of the {side} lost {lost} messages because its queue was full")
    return reasons


def _clock_reasons(server: Record, client: Record, measured: RunMeasurement) -> list[str]:
    """Tell of the clocks; where one was set, everything else about them follows from it."""
    began_ns, ended_ns, _ = driving_interval(server)
    polls = poll_reasons(server, client, began_ns, ended_ns)
    steps = step_reasons(server, client, measured.clocks, began_ns, ended_ns)
    if steps:
        return [*steps, *polls]
    return [*offset_reasons(server, client, measured.clocks), *polls, *_closure_reasons(measured)]


def _closure_reasons(measured: RunMeasurement) -> list[str]:
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


def lateness_reasons(late_ms: Mapping[str, float | None]) -> list[str]:
    """Judge how much later than its law said the relay let go what it held, in the median, per direction."""
    reasons = []
    for direction, median_ms in late_ms.items():
        if median_ms is None:
            reasons.append(f"nobody measured the injected delay of {direction}")
        elif abs(median_ms) > INJECTION_LIMIT_MS:
            reasons.append(f"{direction} left the relay {median_ms:.1f} ms later than was asked, in the median")
    return reasons


def injection_reasons(requested_ms: Mapping[str, float], measured_ms: Mapping[str, float | None]) -> list[str]:
    """Compare the delay asked for with the median that the relay or netem measured, per direction, in milliseconds."""
    reasons = []
    for direction, delay_ms in requested_ms.items():
        found_ms = measured_ms.get(direction)
        if found_ms is None:
            reasons.append(f"nobody measured the injected delay of {direction}")
        elif abs(found_ms - delay_ms) > INJECTION_LIMIT_MS:
            reasons.append(f"{direction} was delayed by {found_ms:.1f} ms where {delay_ms:g} ms was asked")
    return reasons
