"""What the safety states of a drive tell: when it was commanded, its outages, and its minimal-risk manoeuvres.

All times are ns since the start of the drive, on the server's monotonic clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lavt.domain import FloatArray
from lavt.experiment.compliance.ramps import Interval
from lavt.experiment.compliance.speeds import SpeedReports
from lavt.recording.table import Table
from lavt.safety.state_machine import TRIGGER_MESSAGES

COMMANDED = ("driving", "degraded")
STOPPED = ("safe_stop", "emergency_stop")
DRIVE_OVER = TRIGGER_MESSAGES["drive over"]


@dataclass(frozen=True, slots=True)
class StateChange:
    """A change of the safety state."""

    time_ns: float
    before: str
    after: str
    reason: str


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """A minimal-risk manoeuvre: a safe stop or an emergency stop of a vehicle that was commanded.

    `standstill_ns` are the times between which the vehicle became stationary; None if it did not, as far as the record
    and the manoeuvre go. `end_ns` is the later of these times or, without them, the time up to which this is known.
    """

    begin_ns: float
    kind: str
    """`safe_stop`, or `emergency_stop` if it was one or became one before standstill."""
    reason: str
    speed_mps: float | None
    """The speed at its beginning."""
    standstill_ns: Interval | None
    end_ns: float
    distance_m: tuple[float, float] | None
    """The bounds of the distance driven until `end_ns`."""
    is_taken_over: bool
    """Whether the driver in the car took over before standstill."""


def state_changes(events: Table, drive_ns: tuple[int, int]) -> list[StateChange]:
    """Return the changes of the safety state in a drive, in the order of the record.

    The change to `driving` with which the drive begins is left out, and so is the stop because the drive is over.
    """
    began_ns, ended_ns = drive_ns
    changes = []
    for kind, time_ns, detail in zip(
        events.texts("kind"), events.ints("mono_ns").tolist(), events.texts("detail"), strict=True
    ):
        states, _, reason = detail.partition(": ")
        before, arrow, after = states.partition(" -> ")
        is_change = kind == "safety" and arrow and began_ns <= time_ns <= ended_ns
        is_beginning = before == "arming" and time_ns == began_ns
        if is_change and not is_beginning and reason != DRIVE_OVER:
            changes.append(StateChange(float(time_ns - began_ns), before, after, reason))
    return changes


def time_in(states: Sequence[str], changes: Sequence[StateChange], ended_ns: float) -> list[Interval]:
    """Return the intervals of a drive in one of `states`; it begins in `driving`. Adjacent intervals are joined."""
    intervals: list[Interval] = []
    since_ns, state = 0.0, "driving"
    for time_ns, after in [*((change.time_ns, change.after) for change in changes), (ended_ns, "")]:
        if state in states and time_ns > since_ns:
            begin_ns = intervals.pop()[0] if intervals and intervals[-1][1] == since_ns else since_ns
            intervals.append((begin_ns, time_ns))
        since_ns, state = time_ns, after
    return intervals


def outages(fresh_ns: FloatArray, commanded: Sequence[Interval], limit_ns: float) -> list[Interval]:
    """Return the outages of a drive: no command from a newer frame arrived for more than `limit_ns`.

    `fresh_ns` are the arrivals of such commands, ascending. An outage lasts from one arrival to the next, or to the end
    of the commanded time. The part before the commanded time counts for the limit, but not for the outage's length.
    """
    found = []
    for begin_ns, end_ns in commanded:
        earlier = fresh_ns[fresh_ns <= begin_ns]
        since_ns = float(earlier[-1]) if len(earlier) else begin_ns
        times = np.concatenate([[since_ns], fresh_ns[(fresh_ns > begin_ns) & (fresh_ns < end_ns)], [end_ns]])
        found += [
            (max(float(times[index]), begin_ns), float(times[index + 1]))
            for index in np.flatnonzero(np.diff(times) > limit_ns)
        ]
    return found


def manoeuvres(changes: Sequence[StateChange], speeds: SpeedReports) -> list[Manoeuvre]:
    """Return the minimal-risk manoeuvres of a drive; a stop that becomes an emergency stop is one manoeuvre."""
    found = []
    for index, change in enumerate(changes):
        if change.after not in STOPPED or change.before not in COMMANDED:
            continue
        later = changes[index + 1 :]
        left = next((other for other in later if other.after not in STOPPED), None)
        last_ns = float(speeds.time_ns[-1]) if len(speeds.time_ns) else change.time_ns
        until_ns = max(last_ns, change.time_ns) if left is None else left.time_ns
        standstill = speeds.standstill_ns(change.time_ns)
        if standstill is not None and standstill[1] > until_ns:
            standstill = None
        end_ns = until_ns if standstill is None else standstill[1]
        raised = any(
            other.after == "emergency_stop" and other.time_ns <= end_ns
            for other in later[: later.index(left) if left else None]
        )
        found.append(
            Manoeuvre(
                change.time_ns,
                "emergency_stop" if raised else change.after,
                change.reason,
                speeds.at(change.time_ns),
                standstill,
                end_ns,
                speeds.distance_m(change.time_ns, end_ns),
                is_taken_over=standstill is None and left is not None,
            )
        )
    return found
