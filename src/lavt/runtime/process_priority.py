"""The priority of LAVT's processes, which is raised if the system permits this, as it does for root."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Final

NICENESS: Final = -10
"""Default priority: above ordinary programs, without starving the system (0 is normal, -20 is the highest)."""
VEHICLE_NICENESS: Final = -15
"""Priority of the actuator's process and of a software car: above that of the server."""

SESSION: Final = Path("/proc/self/autogroup")
"""The niceness of this process's session. With automatic task groups, Linux shares the processors among sessions; the
niceness of a process then has an effect only inside its session."""


def raise_priority(niceness: int = NICENESS) -> None:
    """Raise the priority of this process, and that of its session if it leads one; without permission, do nothing.

    Other load on the machine must not show as latency. Threads started later inherit the priority. The session of a
    shell keeps its priority.
    """
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
    if os.getsid(0) == os.getpid():
        with suppress(OSError):
            SESSION.write_text(str(niceness))


def session_niceness() -> int | None:
    """Return the niceness of this process's session, or None if the kernel does not share processors among sessions."""
    try:
        is_enabled = Path("/proc/sys/kernel/sched_autogroup_enabled").read_text().strip() == "1"
        return int(SESSION.read_text().rpartition("nice")[2]) if is_enabled else None
    except (OSError, ValueError):
        return None
