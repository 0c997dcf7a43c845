"""The priority of LAVT's processes, which is raised if the system permits this, as it does for root."""

from __future__ import annotations

import os
import resource
from contextlib import suppress
from pathlib import Path
from typing import Final

NICENESS: Final = -10
"""Default priority: above ordinary programs, without starving the system (0 is normal, -20 is the highest)."""
VEHICLE_NICENESS: Final = -15
"""Priority of the actuator's process and of a software car: above that of the server."""

REALTIME_PRIORITY: Final = 1
"""The lowest real-time priority, which is still above that of every ordinary program."""
REALTIME_LIMIT_S: Final = 1
"""The kernel ends a real-time process if one of its threads computes for this long without waiting: it hangs."""

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


def request_realtime() -> str:
    """Schedule this thread, and the threads that it starts, before all ordinary programs; return why not, or ""."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(REALTIME_PRIORITY))
    except OSError as error:
        return f"this user may not have real-time priority ({error.strerror})"
    return ""


def limit_realtime() -> None:
    """Let the kernel end this process if a real-time thread of it hangs, which would starve other programs."""
    limit_us = REALTIME_LIMIT_S * 1_000_000
    resource.setrlimit(resource.RLIMIT_RTTIME, (limit_us, 2 * limit_us))  # SIGXCPU, then SIGKILL


def realtime_rejection() -> str:
    """Return why this thread may not have real-time priority, or "", and leave its priority as it was."""
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    reason = request_realtime()
    if not reason:
        os.sched_setscheduler(0, policy, parameters)
    return reason


def session_niceness() -> int | None:
    """Return the niceness of this process's session, or None if the kernel does not share processors among sessions."""
    try:
        is_enabled = Path("/proc/sys/kernel/sched_autogroup_enabled").read_text().strip() == "1"
        return int(SESSION.read_text().rpartition("nice")[2]) if is_enabled else None
    except (OSError, ValueError):
        return None
