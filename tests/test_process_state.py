"""What keeps one test from changing the pytest process for those after it."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.support.process_state import process_state, process_unchanged, pytest_configure


def ignore(number: signal.Signals) -> None:
    signal.signal(number, signal.SIG_IGN)


CHANGES: dict[str, Callable[[pytest.MonkeyPatch], object]] = {
    "niceness": lambda patch: patch.setattr(os, "getpriority", lambda *_: -10),
    "switch interval": lambda _: sys.setswitchinterval(0.001),
    "directory": lambda patch: patch.chdir(Path(os.sep)),
    "$LAVT_CHANGED": lambda patch: patch.setenv("LAVT_CHANGED", "1"),
    "signal mask": lambda _: signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1}),
    "SIGINT": lambda _: ignore(signal.SIGINT),
    "SIGTERM": lambda _: ignore(signal.SIGTERM),
}


@pytest.fixture
def _put_back(own_switch_interval: None) -> Iterator[None]:  # noqa: ARG001 (put back as well)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    yield
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("_put_back")
@pytest.mark.parametrize("name", CHANGES)
def test_a_test_that_leaves_the_process_changed_fails(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A test that leaves a process-wide setting changed fails, and the message names the setting alone."""
    with pytest.raises(pytest.fail.Exception) as failed, process_unchanged():
        CHANGES[name](monkeypatch)
    assert [each for each in process_state() if f"{each!r}: " in str(failed.value)] == [name]


@pytest.mark.usefixtures("_put_back")
def test_ctrl_c_is_not_ignored() -> None:
    """Tests started as a background job, where the shell has SIGINT ignored, react to Ctrl-C like those at a prompt."""
    ignore(signal.SIGINT)
    pytest_configure()
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler
