"""What all tests share: the summary says which tests were run again, and why."""

from __future__ import annotations

import pytest


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for report in terminalreporter.getreports("rerun"):
        terminalreporter.write_line(f"AGAIN {report.nodeid}: {report.longrepr.reprcrash.message}")
