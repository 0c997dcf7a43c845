"""The only module that reads the machine's clocks."""

from __future__ import annotations

import time
from typing import Protocol

from lavt.domain import NS_PER_S, Now


class Clock(Protocol):
    """Something that tells the time of one host."""

    def now(self) -> Now:
        """Read both clocks."""
        ...


class MachineClock:
    """This machine's own clocks."""

    def now(self) -> Now:
        """Read both clocks, one right after the other."""
        return Now(time.monotonic_ns(), time.time_ns())


def pause(duration_ns: int) -> None:
    """Sleep; for the outermost loops of programs only."""
    if duration_ns > 0:
        time.sleep(duration_ns / NS_PER_S)
