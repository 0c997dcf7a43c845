"""What an outage did, from the server's records and from what a process outside has heard.

Stale is a command that comes to a vehicle which, since it was sent, has stopped for safety (or its server has been
started anew); or one whose picture was sent before that; or one that was sent more than 500 ms ago. Send times and
stamps are read by the process outside, which also knows when the command came to the vehicle's machine: all clocks are
those of one kernel. When the vehicle stopped and which commands it obeyed is what the server's records say. A router
that has no time drops a command for one of its listeners: the few that were obeyed and not heard outside are judged by
what the server wrote down of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from tests.field.driving import Drive, Outage

from lavt.domain import NS_PER_MS, NS_PER_S, FloatArray, Now
from lavt.recording.record import Record
from lavt.recording.table import IntArray

LONG_AGO_NS = 500 * NS_PER_MS
STANDSTILL_MPS = 0.05
FOR_EVER_NS = 2**63 - 1
HEAD = (
    "outage", "to degraded", "to safe stop", "to standstill", "to driving again", "commands heard", "stale", "accepted",
    "stale",
)  # fmt: skip
Name = tuple[int, int]
"""Of a command: epoch and sequence."""


@dataclass(frozen=True)
class Transition:
    """A change of the safety state."""

    at: Now
    before: str
    after: str


@dataclass(frozen=True)
class Came:
    """A command as it came: to the process outside, or to the server."""

    name: Name
    sent_wall_ns: int
    stamp_ns: int
    at: Now


@dataclass(frozen=True)
class Accepted:
    """A command that the server obeyed, and whether its picture was newer than those before."""

    command: Came
    fresh: bool


@dataclass(frozen=True)
class Measured:
    """What one outage did; seconds on the monotonic clock, None where it did not come to that."""

    outage: Outage
    to_degraded_s: float | None
    to_safe_stop_s: float | None
    to_standstill_s: float | None
    to_driving_s: float | None
    """From the end of the outage."""
    silence_to_degraded_s: float | None
    """From the last fresh command."""
    silence_to_safe_stop_s: float | None
    stopping_s: float | None
    """From the safe stop to standstill."""
    stopped_from_mps: float | None
    heard: int
    """Commands that the process outside heard from the outage's begin to that of the next."""
    stale_heard: int
    accepted: int
    stale_accepted: int
    accepted_unheard: int


def measure(drive: Drive) -> list[Measured]:
    """Measure all outages of a drive that has ended."""
    seen = _Seen(drive)
    begins = [outage.begin.mono_ns for outage in drive.outages] + [FOR_EVER_NS]
    return [seen.measured(outage, until) for outage, until in zip(drive.outages, begins[1:], strict=True)]


class _Seen:
    """Everything that was recorded and heard, over all restarts."""

    def __init__(self, drive: Drive) -> None:
        records = drive.records("server")
        self.transitions = [each for record in records for each in transitions(record)]
        self.accepted = [each for record in records for each in _accepted(record)]
        truths = [record.table("truth") for record in records]
        self.truth_ns: IntArray = np.concatenate([truth.ints("mono_ns") for truth in truths])
        self.speed_mps: FloatArray = np.concatenate([truth.floats("speed_mps") for truth in truths])
        self.heard = {each.name: each for each in map(_heard, drive.heard_outside())}
        stops = [each.at for each in self.transitions if each.after == "safe_stop"]
        restarts = [_begin(record) for record in records[1:]]
        self.stops = sorted([*stops, *restarts], key=lambda stop: stop.mono_ns)

    def measured(self, outage: Outage, until_ns: int) -> Measured:
        begin_ns = outage.begin.mono_ns
        here = [each for each in self.transitions if begin_ns < each.at.mono_ns < until_ns]
        degraded = next((each for each in here if each.after == "degraded"), None)
        stop = next((each for each in here if each.after == "safe_stop"), None)
        left = next((each for each in here if each.before == "driving"), None)
        again = next((each for each in here if each.after == "driving"), None)
        stationary_since_ns = None if stop is None else self._stationary_since_ns(stop.at.mono_ns)
        heard = [each for each in self.heard.values() if begin_ns < each.at.mono_ns < until_ns]
        accepted = [each.command for each in self.accepted if begin_ns < each.command.at.mono_ns < until_ns]
        return Measured(
            outage,
            _since(begin_ns, degraded),
            _since(begin_ns, stop),
            None if stationary_since_ns is None else (stationary_since_ns - begin_ns) / NS_PER_S,
            _since(outage.end.mono_ns, again),
            None if left is None else self._silence_s(left),
            None if stop is None else self._silence_s(stop),
            None if stop is None or stationary_since_ns is None else (stationary_since_ns - stop.at.mono_ns) / NS_PER_S,
            None if stop is None else float(self.speed_mps[np.searchsorted(self.truth_ns, stop.at.mono_ns)]),
            len(heard),
            sum(self._stale(each, each.at.mono_ns) for each in heard),
            len(accepted),
            sum(self._stale(self.heard.get(each.name, each), each.at.mono_ns) for each in accepted),
            sum(each.name not in self.heard for each in accepted),
        )

    def _stale(self, command: Came, came_ns: int) -> bool:
        """Tell whether a command is stale where it came at `came_ns`."""
        stopped_ns = next((stop.wall_ns for stop in reversed(self.stops) if stop.mono_ns < came_ns), 0)
        of_before = min(command.sent_wall_ns, command.stamp_ns) <= stopped_ns
        return of_before or command.at.wall_ns - command.sent_wall_ns > LONG_AGO_NS

    def _silence_s(self, transition: Transition) -> float:
        fresh_ns = [each.command.at.mono_ns for each in self.accepted if each.fresh]
        return (transition.at.mono_ns - max(at_ns for at_ns in fresh_ns if at_ns < transition.at.mono_ns)) / NS_PER_S

    def _stationary_since_ns(self, after_ns: int) -> int | None:
        stands = self.truth_ns[(self.truth_ns > after_ns) & (self.speed_mps < STANDSTILL_MPS)]
        return int(stands[0]) if len(stands) else None


def transitions(record: Record) -> Iterator[Transition]:
    """Give the changes of the safety state in a server's record."""
    events = record.table("event")
    rows = zip(events.texts("kind"), events.texts("detail"), events.ints("mono_ns"), events.wall_ns, strict=True)
    for kind, detail, mono_ns, wall_ns in rows:
        if kind == "safety":
            before, after = detail.partition(":")[0].split(" -> ")
            yield Transition(Now(int(mono_ns), int(wall_ns)), before, after)


def _accepted(record: Record) -> Iterator[Accepted]:
    admissions = record.table("admission")
    commands = admissions.where(np.array(admissions.texts("verdict")) == "accepted")
    stamps_ns = commands.ints("stamp_ns")
    fresh = np.append(True, stamps_ns[1:] > np.maximum.accumulate(stamps_ns)[:-1])[: len(commands)]
    columns = (commands.ints(f"{name}_ns") for name in ("sent_wall", "stamp", "received_mono", "received_wall"))
    rows = zip(commands.objects("epoch"), commands.ints("sequence"), *columns, fresh, strict=True)
    for epoch, sequence, sent_wall_ns, stamp_ns, mono_ns, wall_ns, newer in rows:
        command = Came((epoch, int(sequence)), int(sent_wall_ns), int(stamp_ns), Now(int(mono_ns), int(wall_ns)))
        yield Accepted(command, bool(newer))


def _heard(line: Mapping[str, Any]) -> Came:
    at = Now(line["mono_ns"], line["wall_ns"])
    return Came((line["epoch"], line["sequence"]), line["sent_wall_ns"], line["stamp_ns"], at)


def _begin(record: Record) -> Now:
    truth = record.table("truth")
    return Now(int(truth.mono_ns[0]), int(truth.wall_ns[0]))


def _since(begin_ns: int, transition: Transition | None) -> float | None:
    return None if transition is None else (transition.at.mono_ns - begin_ns) / NS_PER_S


def table(rows: Sequence[Measured]) -> str:
    """Write what was measured as a table in Markdown; times in seconds."""
    lines = [f"| {' | '.join(HEAD)} |", "|---" * len(HEAD) + "|"]
    for row in rows:
        times = (row.to_degraded_s, row.to_safe_stop_s, row.to_standstill_s, row.to_driving_s)
        counts = (row.heard, row.stale_heard, row.accepted, row.stale_accepted)
        cells = [row.outage.name, *("–" if time is None else f"{time:.2f}" for time in times), *map(str, counts)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
