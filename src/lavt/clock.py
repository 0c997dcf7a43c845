"""The only module that reads the machine's clocks."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from itertools import pairwise
from typing import Protocol

from lavt.domain import NS_PER_S, Now


class Clock(Protocol):
    """Something that tells the time of one host."""

    def now(self) -> Now:
        """Read both clocks."""
        ...


def _nearest_ns() -> int:
    """How near to each other two readings come on this machine."""
    readings_ns = [time.monotonic_ns() for _ in range(10)]
    return min(late_ns - early_ns for early_ns, late_ns in pairwise(readings_ns))


TOGETHER_NS = max(100_000, 3 * _nearest_ns())
"""Two readings so close to each other are of one moment; a user-mode kernel needs more than 50 us for each."""
ATTEMPTS = 4


class MachineClock:
    """This machine's own clocks."""

    def now(self) -> Now:
        """Read both clocks at one moment: again, where other work came between the readings."""
        mono_ns = time.monotonic_ns()
        for _ in range(ATTEMPTS):
            wall_ns = time.time_ns()
            before_ns, mono_ns = mono_ns, time.monotonic_ns()
            if mono_ns - before_ns <= TOGETHER_NS:
                break
        return Now(mono_ns, wall_ns)


def pause(duration_ns: int) -> None:
    """Sleep; for the outermost loops of programs only."""
    if duration_ns > 0:
        time.sleep(duration_ns / NS_PER_S)


def calendar_time(wall_ns: int) -> datetime:
    """Say a time of the wall clock as the calendar does, in UTC and in whole seconds."""
    return datetime.fromtimestamp(wall_ns // NS_PER_S, UTC)
