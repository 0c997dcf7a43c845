"""Measure the effects of outages from the records of the server and of the observer (`command_observer.py`).

A command is stale if, since the command or its picture was sent, the vehicle has begun a safe stop or its server was
restarted. A command that was sent more than 500 ms before it arrived is also stale.

The observer records each command's send time, stamp and arrival at the vehicle's machine; all processes read the
clocks of one kernel. The server's records say when the vehicle stopped and which commands were accepted. A busy router
can drop a command for one of its subscribers. So the observer misses a few accepted commands; for these, the server's
record gives send time, stamp and arrival.
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

MAX_AGE_NS = 500 * NS_PER_MS
STANDSTILL_MPS = 0.05
END_OF_TIME_NS = 2**63 - 1
TIME_COLUMNS = ("to degraded", "to safe stop", "to standstill", "to driving again")
COLUMNS = ("outage", *TIME_COLUMNS, "commands observed", "stale", "accepted", "stale")
CommandId = tuple[int, int]
"""Epoch and sequence of a command."""


@dataclass(frozen=True)
class Transition:
    """A change of the safety state."""

    at: Now
    before: str
    after: str


@dataclass(frozen=True)
class ReceivedCommand:
    """A command as the observer or the server received it."""

    command_id: CommandId
    sent_wall_ns: int
    stamp_ns: int
    at: Now


@dataclass(frozen=True)
class AcceptedCommand:
    """A command that the server accepted; `fresh`: its picture is newer than the pictures of all earlier commands."""

    command: ReceivedCommand
    fresh: bool


@dataclass(frozen=True)
class OutageEffects:
    """The effects of one outage: times in seconds from its beginning, or None for what did not happen."""

    outage: Outage
    to_degraded_s: float | None
    to_safe_stop_s: float | None
    to_standstill_s: float | None
    to_driving_s: float | None
    """Counted from the end of the outage."""
    command_gap_at_degraded_s: float | None
    """Time from the last fresh command to the degraded state."""
    command_gap_at_safe_stop_s: float | None
    stopping_s: float | None
    """From the safe stop to standstill."""
    stopped_from_mps: float | None
    """Speed at the beginning of the safe stop."""
    observed: int
    """Commands that the observer received from the beginning of the outage to the beginning of the next one."""
    stale_observed: int
    accepted: int
    stale_accepted: int
    accepted_unobserved: int


def measure(drive: Drive) -> list[OutageEffects]:
    """Measure the effects of all outages of a drive that has ended."""
    evidence = _Evidence(drive)
    ends_ns = [outage.begin.mono_ns for outage in drive.outages[1:]] + [END_OF_TIME_NS]
    return [evidence.measure(outage, until_ns) for outage, until_ns in zip(drive.outages, ends_ns, strict=True)]


class _Evidence:
    """The records of the server and the observer, over all restarts."""

    def __init__(self, drive: Drive) -> None:
        records = drive.records("server")
        self.transitions = [transition for record in records for transition in transitions(record)]
        self.accepted = [command for record in records for command in _accepted_commands(record)]
        truths = [record.table("truth") for record in records]
        self.truth_ns: IntArray = np.concatenate([truth.ints("mono_ns") for truth in truths])
        self.speed_mps: FloatArray = np.concatenate([truth.floats("speed_mps") for truth in truths])
        self.observed = {command.command_id: command for command in map(_parse_observed, drive.observed_commands())}
        stops = [transition.at for transition in self.transitions if transition.after == "safe_stop"]
        restarts = [_first_time(record) for record in records[1:]]
        self.stops = sorted([*stops, *restarts], key=lambda stop: stop.mono_ns)

    def measure(self, outage: Outage, until_ns: int) -> OutageEffects:
        begin_ns = outage.begin.mono_ns
        changes = [transition for transition in self.transitions if begin_ns < transition.at.mono_ns < until_ns]
        degraded = next((change for change in changes if change.after == "degraded"), None)
        stop = next((change for change in changes if change.after == "safe_stop"), None)
        left_driving = next((change for change in changes if change.before == "driving"), None)
        driving = next((change for change in changes if change.after == "driving"), None)
        stationary_since_ns = None if stop is None else self._stationary_since_ns(stop.at.mono_ns)
        observed = [command for command in self.observed.values() if begin_ns < command.at.mono_ns < until_ns]
        accepted = [
            acceptance.command for acceptance in self.accepted if begin_ns < acceptance.command.at.mono_ns < until_ns
        ]
        return OutageEffects(
            outage,
            _delay_s(begin_ns, degraded),
            _delay_s(begin_ns, stop),
            None if stationary_since_ns is None else (stationary_since_ns - begin_ns) / NS_PER_S,
            _delay_s(outage.end.mono_ns, driving),
            None if left_driving is None else self._since_fresh_command_s(left_driving),
            None if stop is None else self._since_fresh_command_s(stop),
            None if stop is None or stationary_since_ns is None else (stationary_since_ns - stop.at.mono_ns) / NS_PER_S,
            None if stop is None else float(self.speed_mps[np.searchsorted(self.truth_ns, stop.at.mono_ns)]),
            len(observed),
            sum(self._is_stale(command, command.at.mono_ns) for command in observed),
            len(accepted),
            sum(
                self._is_stale(self.observed.get(command.command_id, command), command.at.mono_ns)
                for command in accepted
            ),
            sum(command.command_id not in self.observed for command in accepted),
        )

    def _is_stale(self, command: ReceivedCommand, received_ns: int) -> bool:
        """Return whether a command that was received at `received_ns` is stale."""
        stopped_ns = next((stop.wall_ns for stop in reversed(self.stops) if stop.mono_ns < received_ns), 0)
        is_from_before_stop = min(command.sent_wall_ns, command.stamp_ns) <= stopped_ns
        return is_from_before_stop or command.at.wall_ns - command.sent_wall_ns > MAX_AGE_NS

    def _since_fresh_command_s(self, transition: Transition) -> float:
        fresh_ns = [acceptance.command.at.mono_ns for acceptance in self.accepted if acceptance.fresh]
        return (transition.at.mono_ns - max(at_ns for at_ns in fresh_ns if at_ns < transition.at.mono_ns)) / NS_PER_S

    def _stationary_since_ns(self, after_ns: int) -> int | None:
        stationary_ns = self.truth_ns[(self.truth_ns > after_ns) & (self.speed_mps < STANDSTILL_MPS)]
        return int(stationary_ns[0]) if len(stationary_ns) else None


def transitions(record: Record) -> Iterator[Transition]:
    """Yield the transitions of the safety state in a server's record."""
    events = record.table("event")
    rows = zip(events.texts("kind"), events.texts("detail"), events.ints("mono_ns"), events.wall_ns, strict=True)
    for kind, detail, mono_ns, wall_ns in rows:
        if kind == "safety":
            before, after = detail.partition(":")[0].split(" -> ")
            yield Transition(Now(int(mono_ns), int(wall_ns)), before, after)


def _accepted_commands(record: Record) -> Iterator[AcceptedCommand]:
    admissions = record.table("admission")
    commands = admissions.where(np.array(admissions.texts("verdict")) == "accepted")
    stamps_ns = commands.ints("stamp_ns")
    fresh = np.append(True, stamps_ns[1:] > np.maximum.accumulate(stamps_ns)[:-1])[: len(commands)]
    columns = (commands.ints(f"{name}_ns") for name in ("sent_wall", "stamp", "received_mono", "received_wall"))
    rows = zip(commands.objects("epoch"), commands.ints("sequence"), *columns, fresh, strict=True)
    for epoch, sequence, sent_wall_ns, stamp_ns, mono_ns, wall_ns, is_fresh in rows:
        at = Now(int(mono_ns), int(wall_ns))
        command = ReceivedCommand((epoch, int(sequence)), int(sent_wall_ns), int(stamp_ns), at)
        yield AcceptedCommand(command, bool(is_fresh))


def _parse_observed(line: Mapping[str, Any]) -> ReceivedCommand:
    at = Now(line["mono_ns"], line["wall_ns"])
    return ReceivedCommand((line["epoch"], line["sequence"]), line["sent_wall_ns"], line["stamp_ns"], at)


def _first_time(record: Record) -> Now:
    truth = record.table("truth")
    return Now(int(truth.mono_ns[0]), int(truth.wall_ns[0]))


def _delay_s(begin_ns: int, transition: Transition | None) -> float | None:
    return None if transition is None else (transition.at.mono_ns - begin_ns) / NS_PER_S


def effects_table(effects: Sequence[OutageEffects]) -> str:
    """Return the effects of outages as a Markdown table; times in seconds."""
    lines = [f"| {' | '.join(COLUMNS)} |", "|---" * len(COLUMNS) + "|"]
    for effect in effects:
        times = (effect.to_degraded_s, effect.to_safe_stop_s, effect.to_standstill_s, effect.to_driving_s)
        counts = (effect.observed, effect.stale_observed, effect.accepted, effect.stale_accepted)
        cells = [effect.outage.name, *("–" if time is None else f"{time:.2f}" for time in times), *map(str, counts)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
