"""The only module that reads the machine's clocks."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from itertools import pairwise
from typing import Protocol

from lavt.domain import NS_PER_S, Now


class Clock(Protocol):
    """The clocks of one host."""

    def now(self) -> Now:
        """Return a reading of both clocks."""
        ...


def _shortest_gap_ns() -> int:
    """Return the shortest measured time between two readings of a clock on this machine."""
    readings_ns = [time.monotonic_ns() for _ in range(10)]
    return min(second_ns - first_ns for first_ns, second_ns in pairwise(readings_ns))


SIMULTANEOUS_NS = max(100_000, 3 * _shortest_gap_ns())
"""Two readings that are at most this far apart are treated as simultaneous. The value depends on the machine: on a
kernel that runs in user mode, one reading takes more than 50 us."""
MAX_ATTEMPTS = 4


class MachineClock:
    """The clocks of this machine."""

    def now(self) -> Now:
        """Return simultaneous readings of both clocks; if interrupted, try again, with at most `MAX_ATTEMPTS` tries."""
        mono_ns = time.monotonic_ns()
        for _ in range(MAX_ATTEMPTS):
            wall_ns = time.time_ns()
            before_ns, mono_ns = mono_ns, time.monotonic_ns()
            if mono_ns - before_ns <= SIMULTANEOUS_NS:
                break
        return Now(mono_ns, wall_ns)


def suspended_ns() -> int:
    """Return how long this machine has been suspended since its start; an interruption lowers the result."""
    boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)  # read first, so that an interruption cannot raise the result
    return boot_ns - time.monotonic_ns()


def pause(duration_ns: int) -> None:
    """Sleep for `duration_ns`; only the outermost loops of programs may call this."""
    if duration_ns > 0:
        time.sleep(duration_ns / NS_PER_S)


def wall_time_ns(iso_text: str) -> int:
    """Return the wall clock time of a date and time in ISO 8601; raise `ValueError` if it has no offset from UTC."""
    moment = datetime.fromisoformat(iso_text)
    if moment.tzinfo is None:
        raise ValueError("no offset from UTC")
    return round(moment.timestamp()) * NS_PER_S


def calendar_time(wall_ns: int) -> datetime:
    """Return a wall clock time as a date and time in UTC, in whole seconds."""
    return datetime.fromtimestamp(wall_ns // NS_PER_S, UTC)
