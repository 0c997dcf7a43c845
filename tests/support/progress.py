"""Tell who started the tests which of them are running: LAVT_PROGRESS names the file."""

from __future__ import annotations

import os
from pathlib import Path

RUNNING: dict[str, None] = {}


def tell() -> None:
    """Write the tests that are running, one a line."""
    if path := os.environ.get("LAVT_PROGRESS"):
        Path(path).write_text("\n".join(RUNNING))


def pytest_runtest_logstart(nodeid: str) -> None:
    """Note that a test begins; where tests run side by side this is called for those of every worker."""
    RUNNING[nodeid] = None
    tell()


def pytest_runtest_logfinish(nodeid: str) -> None:
    """Note that a test has ended."""
    RUNNING.pop(nodeid, None)
    tell()
