"""A pytest plugin that writes the names of the running tests to the file LAVT_PROGRESS."""

from __future__ import annotations

import os
from pathlib import Path

RUNNING: dict[str, None] = {}


def write_running() -> None:
    """Write the names of the running tests, one per line."""
    if path := os.environ.get("LAVT_PROGRESS"):
        Path(path).write_text("\n".join(RUNNING))


def pytest_runtest_logstart(nodeid: str) -> None:
    """Record that a test begins; if tests run in parallel, pytest calls this for the tests of every worker."""
    RUNNING[nodeid] = None
    write_running()


def pytest_runtest_logfinish(nodeid: str) -> None:
    """Record that a test has ended."""
    RUNNING.pop(nodeid, None)
    write_running()
