"""Test the priority of processes and of their sessions."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from lavt.runtime.process_priority import session_niceness

CHANGES_ITS_PRIORITY = """
import os
from lavt.runtime.process_priority import raise_priority, session_niceness
raise_priority(5)
print(os.getpriority(os.PRIO_PROCESS, 0), session_niceness())
"""


@pytest.mark.parametrize("leads_a_session", [True, False])
def test_only_the_leader_of_a_session_changes_its_priority(leads_a_session: bool) -> None:
    """A process that leads a session also changes the session's priority; other processes change only their own."""
    before = session_niceness()
    command = [sys.executable, "-c", CHANGES_ITS_PRIORITY]
    completed = subprocess.run(
        command, capture_output=True, text=True, check=True, start_new_session=leads_a_session, timeout=280
    )
    own, session = completed.stdout.split()
    can_lower = os.geteuid() == 0
    assert int(own) == (5 if can_lower else max(5, os.getpriority(os.PRIO_PROCESS, 0)))
    expected = before if before is None or not leads_a_session else 5
    assert session == str(expected)
