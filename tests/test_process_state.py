"""Tests of a pytest plugin: a test fails if it changes the pytest process for later tests."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.support.process_state import process_state, process_unchanged, pytest_configure


def ignore_signal(number: signal.Signals) -> None:
    signal.signal(number, signal.SIG_IGN)


CHANGES: dict[str, Callable[[pytest.MonkeyPatch], object]] = {
    "niceness": lambda patch: patch.setattr(os, "getpriority", lambda *_: -10),
    "switch interval": lambda _: sys.setswitchinterval(0.001),
    "directory": lambda patch: patch.chdir(Path(os.sep)),
    "$LAVT_CHANGED": lambda patch: patch.setenv("LAVT_CHANGED", "1"),
    "signal mask": lambda _: signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1}),
    "SIGINT": lambda _: ignore_signal(signal.SIGINT),
    "SIGTERM": lambda _: ignore_signal(signal.SIGTERM),
}


@pytest.fixture
def _restore(own_switch_interval: None) -> Iterator[None]:  # noqa: ARG001 (it restores the switch interval)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    yield
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("_restore")
@pytest.mark.parametrize("name", CHANGES)
def test_a_change_of_the_process_fails_the_test(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A test that leaves a process-wide setting changed fails, and the message names only that setting."""
    with pytest.raises(pytest.fail.Exception) as failure, process_unchanged():
        CHANGES[name](monkeypatch)
    assert [setting for setting in process_state() if f"{setting!r}: " in str(failure.value)] == [name]


@pytest.mark.usefixtures("_restore")
def test_pytest_reacts_to_sigint_in_a_background_job() -> None:
    """A shell starts background jobs with SIGINT (Ctrl-C) ignored; pytest reacts to it nevertheless."""
    ignore_signal(signal.SIGINT)
    pytest_configure()
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler
