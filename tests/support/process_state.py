"""Pytest hooks and fixtures that check that no test changes the pytest process.

`tests/conftest.py` loads this plugin. A test that changed the priority, the signal handlers or the directory of the
process, for example, would affect later tests.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PYTEST_PREFIX = "PYTEST_"
"""Prefix of the environment variables that pytest itself sets while a test runs."""


def pytest_configure() -> None:
    """Let Ctrl-C end the tests and their programs, even if a shell without job control made pytest ignore SIGINT."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def process_state() -> dict[str, Any]:
    """Return the state that a test could change for later tests."""
    return {
        "niceness": os.getpriority(os.PRIO_PROCESS, 0),
        "scheduler": os.sched_getscheduler(0),
        "processors": os.sched_getaffinity(0),
        "switch interval": sys.getswitchinterval(),
        "directory": os.getcwd(),  # noqa: PTH109 (ten times as fast as Path.cwd)
        **{f"${key}": value for key, value in os.environ.items() if not key.startswith(PYTEST_PREFIX)},
        "signal mask": signal.pthread_sigmask(signal.SIG_BLOCK, ()),
        **{number.name: signal.getsignal(number) for number in SIGNALS},
    }


@contextmanager
def process_unchanged() -> Iterator[None]:
    """Fail the test if the context changes the process."""
    before = process_state()
    yield
    after = process_state()
    if after != before:
        names = sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
        changed = {name: (before.get(name), after.get(name)) for name in names}
        pytest.fail(f"the test left the process changed (before, after): {changed}", pytrace=False)


@pytest.fixture(autouse=True)
def _process_unchanged() -> Iterator[None]:
    """Check every test with `process_unchanged`."""
    with process_unchanged():
        yield


@pytest.fixture
def own_switch_interval() -> Iterator[None]:
    """Restore the switch interval after a test of the real-time runtime, which sets it."""
    before = sys.getswitchinterval()
    yield
    sys.setswitchinterval(before)


@pytest.fixture
def restored_environment() -> Iterator[None]:
    """Restore the environment variables after a test of a library that sets some."""
    before = dict(os.environ)
    yield
    for name in set(os.environ) - set(before):
        del os.environ[name]
    os.environ.update(before)


@pytest.fixture
def default_sighup_action() -> Iterator[None]:
    """Let SIGHUP end a program that the test starts, even if the tests run under `nohup`."""
    previous = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, previous)
