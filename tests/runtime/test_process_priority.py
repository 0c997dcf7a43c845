"""Test the priority of processes and of their sessions."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from lavt.runtime.process_priority import realtime_rejection, session_niceness

CHANGES_ITS_PRIORITY = """
import os
from lavt.runtime.process_priority import raise_priority, session_niceness
raise_priority(5)
print(os.getpriority(os.PRIO_PROCESS, 0), session_niceness())
"""

BECOMES_REALTIME = """
import os, sys, threading
from lavt.runtime.process_priority import limit_realtime, request_realtime

def report():
    print(os.sched_getscheduler(0) == os.SCHED_RR, flush=True)

if sys.argv[1:] == ["unprivileged"]:
    import resource
    resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
    if os.getuid() == 0:
        os.setuid(65534)
print(request_realtime())
limit_realtime()
thread = threading.Thread(target=report)
thread.start()
thread.join()
while sys.argv[1:] == ["hang"]:
    pass
"""
needs_realtime = pytest.mark.skipif(realtime_rejection() != "", reason=realtime_rejection())


def run_realtime(*arguments: str) -> tuple[int, str, str]:
    """Run the program; return its exit code, why it has no real-time priority, and whether a new thread has it."""
    command = [sys.executable, "-c", BECOMES_REALTIME, *arguments]
    completed = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    reason, thread = completed.stdout.splitlines()
    return completed.returncode, reason, thread


@needs_realtime
def test_a_realtime_process_starts_realtime_threads() -> None:
    """With permission, a process has real-time priority, and so have its new threads."""
    assert run_realtime() == (0, "", "True")


def test_without_permission_the_priority_is_ordinary() -> None:
    """Without permission, a process keeps its priority, and the reason says so."""
    code, reason, thread = run_realtime("unprivileged")
    assert (code, thread) == (0, "False")
    assert "may not have real-time priority" in reason


@needs_realtime
def test_a_realtime_process_that_hangs_is_ended() -> None:
    """The kernel ends a real-time process with a thread that computes without waiting."""
    assert run_realtime("hang") == (-signal.SIGXCPU, "", "True")


@needs_realtime
def test_a_query_of_the_permission_changes_nothing() -> None:
    """`realtime_rejection` leaves the priority as it was."""
    before = os.sched_getscheduler(0)
    assert realtime_rejection() == ""
    assert os.sched_getscheduler(0) == before


@pytest.mark.parametrize("leads_a_session", [True, False])
def test_only_the_leader_of_a_session_changes_its_priority(leads_a_session: bool) -> None:
    """A process that leads a session also changes the session's priority; other processes change only their own."""
    before = session_niceness()
    command = [sys.executable, "-c", CHANGES_ITS_PRIORITY]
    completed = subprocess.run(
        command, capture_output=True, text=True, check=True, start_new_session=leads_a_session, timeout=60
    )
    own, session = completed.stdout.split()
    can_lower = os.geteuid() == 0
    assert int(own) == (5 if can_lower else max(5, os.getpriority(os.PRIO_PROCESS, 0)))
    expected = before if before is None or not leads_a_session else 5
    assert session == str(expected)
