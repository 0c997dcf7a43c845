"""Precedence of LAVT's processes over other programs, where the system allows it (as root)."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Final

NICENESS: Final = -10
"""Of 20 below the ordinary: enough to go first, not enough to starve the system."""
OF_THE_CAR: Final = -15
"""Of the actuator's process, which goes before the server's own, and of a software car, which is not the server's."""


def take(niceness: int = NICENESS) -> None:
    """Ask for more of the processor than ordinary programs get; without the right to it, nothing changes.

    Whatever else the machine does must not show as latency. Threads begun later have it too.
    """
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
