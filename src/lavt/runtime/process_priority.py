"""The priority of LAVT's processes, which is raised if the system allows that (to root)."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Final

NICENESS: Final = -10
"""Default priority: above ordinary programs, without starving the system (0 is normal, -20 is the highest)."""
VEHICLE_NICENESS: Final = -15
"""Priority of the actuator's process, above that of the server, and of a software car."""


def raise_priority(niceness: int = NICENESS) -> None:
    """Raise the priority of this process; without permission, do nothing.

    Other load on the machine must not show as latency. Threads started later inherit the priority.
    """
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
