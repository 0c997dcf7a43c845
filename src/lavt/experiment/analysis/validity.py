"""The validity of a run: the reasons why it is invalid.

These reasons concern the infrastructure only, never the driving.
"""

from __future__ import annotations

from collections.abc import Mapping

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.clock_validity import (
    CLOCK_BOUND_LIMIT_MS,
    SAMPLE_GAP_LIMIT_S,
    STEP_LIMIT_MS,
    longest_unsampled_s,
    offset_reasons,
    sampling_reasons,
    step_reasons,
    steps_ms,
)
from lavt.experiment.analysis.clocks import SAME_KERNEL
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason, MeasuredCheck, not_measured
from lavt.experiment.analysis.latency import frames_within
from lavt.experiment.analysis.metrics import RunMeasurement, driving_interval, last_count
from lavt.recording.record import Record

CLOSURE_LIMIT_MS = 1.0
"""A larger closure shows that a clock or the times of a command are wrong."""
LATE_LIMIT = 0.01
"""The largest allowed share of the drive by which the physics is late in total; delays up to 50 ms are ignored."""
MISSED_FRAMES_LIMIT = 0.01
"""The largest allowed share of frames that the camera misses."""
LATE_STATES_LIMIT = 0.01
"""The largest allowed share of states of an asynchronous CARLA world whose times are late (`carla/world_time.py`)."""
LOOP_JITTER_LIMIT_MS = 10.0
"""The largest allowed loop jitter. On an idle machine with two cores, the 95th percentile of the whole loop latency,
network included, was 3.4 ms above its median (docs/measuring_latency.md). The limit is three times that value: a run
beyond it measured the load of the machine rather than the injected delay."""
INJECTION_LIMIT_MS = 1.0
"""The largest allowed difference between the injected and the requested delay."""


def invalid_reasons(server: Record, client: Record, measured: RunMeasurement) -> list[InvalidReason]:
    """Return the reasons why a run is invalid; the list is empty for a valid run."""
    return [
        *_record_reasons("server", server),
        *_record_reasons("client", client),
        *_clock_reasons(server, client, measured),
        *_simulator_reasons(server),
        *_jitter_reasons(measured),
    ]


def _record_reasons(side: str, record: Record) -> list[InvalidReason]:
    reasons = (
        []
        if record.complete
        else [InvalidReason(InvalidCode.RECORD_INCOMPLETE, f"the record of the {side} is not complete")]
    )
    lost = last_count(record, "record_overflow") or 0
    if lost > 0:
        reasons.append(
            InvalidReason(
                InvalidCode.RECORD_OVERFLOW, f"the record of the {side} lost {lost} messages because its queue was full"
            )
        )
    return reasons


def _clock_reasons(server: Record, client: Record, measured: RunMeasurement) -> list[InvalidReason]:
    """Return the reasons from the clocks.

    If a clock was set, offset and closure are wrong as a consequence, and give no further reasons.
    """
    began_ns, ended_ns, _ = driving_interval(server)
    polls = sampling_reasons(server, client, began_ns, ended_ns)
    steps = step_reasons(server, client, measured.clocks, began_ns, ended_ns)
    if steps:
        return [*steps, *polls]
    return [*offset_reasons(server, client, measured.clocks), *polls, *_closure_reasons(measured)]


def _closure_reasons(measured: RunMeasurement) -> list[InvalidReason]:
    closure_ms = measured.closure_p95_ms
    if closure_ms is None or closure_ms <= CLOSURE_LIMIT_MS:
        return []
    return [
        InvalidReason(
            InvalidCode.CLOSURE,
            f"the sum of the loop's parts differs from the loop latency by {closure_ms:.2f} ms (p95, limit "
            f"{CLOSURE_LIMIT_MS} ms)",
        )
    ]


def _simulator_reasons(server: Record) -> list[InvalidReason]:
    """Return the reasons from the server's physics and camera during the drive."""
    began_ns, ended_ns, ending = driving_interval(server)
    reasons = [] if ending is not None else [InvalidReason(InvalidCode.NO_ENDING, "the record has no ending")]
    late_ms = _late_ms(server, began_ns, ended_ns)
    if late_ms * NS_PER_MS > LATE_LIMIT * (ended_ns - began_ns):
        text = f"the physics was {late_ms} ms late in total (limit {LATE_LIMIT:.0%} of the drive)"
        reasons.append(InvalidReason(InvalidCode.PHYSICS_LATE, text))
    missed_count, due_count = _missed_frames(server, began_ns, ended_ns)
    if missed_count > MISSED_FRAMES_LIMIT * due_count:
        text = f"the camera missed {missed_count} of {due_count} frames (limit {MISSED_FRAMES_LIMIT:.0%})"
        reasons.append(InvalidReason(InvalidCode.FRAMES_MISSED, text))
    states_late, state_count = last_count(server, "carla_states_late") or 0, last_count(server, "carla_states") or 0
    if states_late > LATE_STATES_LIMIT * state_count:
        text = (
            f"{states_late} of {state_count} states of CARLA got times that are over 10 ms late, by the clock of its "
            f"machine (limit {LATE_STATES_LIMIT:.0%})"
        )
        reasons.append(InvalidReason(InvalidCode.STATES_LATE, text))
    return reasons


def _late_ms(server: Record, began_ns: int, ended_ns: int) -> int:
    """Return by how much the physics was late during the drive, in total."""
    events = server.table("event")
    events = events.where((events.ints("mono_ns") >= began_ns) & (events.ints("mono_ns") <= ended_ns))
    return sum(
        int(detail.removesuffix(" ms"))
        for kind, detail in zip(events.texts("kind"), events.texts("detail"), strict=True)
        if kind == "late"
    )


def _missed_frames(server: Record, began_ns: int, ended_ns: int) -> tuple[int, int]:
    """Return how many frames the camera missed during the drive, and how many were due."""
    frame_numbers = frames_within(server.table("frame"), began_ns, ended_ns).ints("number")
    due_count = int(frame_numbers[-1] - frame_numbers[0]) + 1 if len(frame_numbers) else 0
    return due_count - len(frame_numbers), due_count


def measured_checks(server: Record, client: Record, measured: RunMeasurement) -> list[MeasuredCheck]:
    """Return the values of the checks that have a number, with their limits; none without a drive.

    As in `invalid_reasons`, offset and closure are not checked if a clock was set, and hosts with one kernel have no
    offset to check.
    """
    began_ns, ended_ns, _ = driving_interval(server)
    if began_ns >= ended_ns:
        return []
    clocks, jitter_ms = measured.clocks, measured.entry["loop_jitter_ms"]
    step_ms = max(map(abs, steps_ms(server, client, began_ns, ended_ns).values()))
    missed_count, due_count = _missed_frames(server, began_ns, ended_ns)
    late_share = _late_ms(server, began_ns, ended_ns) * NS_PER_MS / (ended_ns - began_ns)
    unsampled_s = longest_unsampled_s(server, client, began_ns, ended_ns)
    checks = [
        MeasuredCheck(InvalidCode.CLOCK_STEP, step_ms, STEP_LIMIT_MS),
        MeasuredCheck(InvalidCode.CLOCK_NOT_SAMPLED, unsampled_s, SAMPLE_GAP_LIMIT_S),
        MeasuredCheck(InvalidCode.PHYSICS_LATE, late_share, LATE_LIMIT),
        MeasuredCheck(InvalidCode.FRAMES_MISSED, missed_count / max(due_count, 1), MISSED_FRAMES_LIMIT),
    ]
    if jitter_ms is not None:
        checks.append(MeasuredCheck(InvalidCode.LOOP_JITTER, jitter_ms, LOOP_JITTER_LIMIT_MS))
    if step_ms > STEP_LIMIT_MS:
        return checks
    if measured.closure_p95_ms is not None:
        checks.append(MeasuredCheck(InvalidCode.CLOSURE, measured.closure_p95_ms, CLOSURE_LIMIT_MS))
    disagreement_ms = clocks.disagreement_ms()
    if clocks.source != SAME_KERNEL and clocks.bound_ms is not None:
        checks.append(MeasuredCheck(InvalidCode.CLOCK_BOUND, clocks.bound_ms, CLOCK_BOUND_LIMIT_MS))
    if clocks.source != SAME_KERNEL and disagreement_ms is not None:
        source_ms, probe_ms, allowed_ms = disagreement_ms
        checks.append(MeasuredCheck(InvalidCode.CLOCK_DISAGREEMENT, abs(source_ms - probe_ms), allowed_ms))
    return checks


def _jitter_reasons(measured: RunMeasurement) -> list[InvalidReason]:
    """Return the reason if the time that frames need outside the network varies too much: the machine was busy."""
    jitter_ms = measured.entry["loop_jitter_ms"]
    if jitter_ms is None or jitter_ms <= LOOP_JITTER_LIMIT_MS:
        return []
    text = (
        f"the processing time of frames varied: its 95th percentile was {jitter_ms:.1f} ms above its median (limit "
        f"{LOOP_JITTER_LIMIT_MS:g} ms)"
    )
    return [InvalidReason(InvalidCode.LOOP_JITTER, text)]


def lateness_reasons(late_ms: Mapping[str, float | None]) -> list[InvalidReason]:
    """Return a reason for each direction in which the relay sent packets too late or too early, or did not measure.

    `late_ms` has the median lateness of each direction, relative to the planned send times.
    """
    reasons = []
    for direction, median_ms in late_ms.items():
        if median_ms is None:
            reasons.append(not_measured(direction))
        elif abs(median_ms) > INJECTION_LIMIT_MS:
            text = f"the relay sent {direction} packets {median_ms:.1f} ms later than planned, in the median"
            reasons.append(InvalidReason(InvalidCode.INJECTION_DIFFERS, text))
    return reasons


def injection_reasons(
    requested_ms: Mapping[str, float], measured_ms: Mapping[str, float | None]
) -> list[InvalidReason]:
    """Return a reason for each direction whose median delay in the relay or netem differs from the request."""
    reasons = []
    for direction, delay_ms in requested_ms.items():
        median_ms = measured_ms.get(direction)
        if median_ms is None:
            reasons.append(not_measured(direction))
        elif abs(median_ms - delay_ms) > INJECTION_LIMIT_MS:
            text = f"{direction} was delayed by {median_ms:.1f} ms, but {delay_ms:g} ms were requested"
            reasons.append(InvalidReason(InvalidCode.INJECTION_DIFFERS, text))
    return reasons
