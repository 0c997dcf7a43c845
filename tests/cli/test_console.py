from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from lavt.cli import console
from lavt.errors import WorkError


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_what_runs_until_told_is_told_by_each_signal_that_ends(number: signal.Signals) -> None:
    """Ctrl-C, SIGTERM and a closed terminal each set the event, and afterwards mean what they meant before."""
    heard = list[int]()
    before = signal.signal(number, lambda *_: heard.append(number))
    try:
        with console.until_told() as told:
            assert not told.is_set()
            signal.raise_signal(number)
            assert (told.is_set(), heard) == (True, [])
        signal.raise_signal(number)
        assert heard == [number]
    finally:
        signal.signal(number, before)


TOLD_AT_EVERY_LINE = """
import signal, sys
from lavt.cli import console

def again(frame, event, argument):
    signal.raise_signal(signal.SIGTERM)
    return again

with console.until_told() as told:
    for use in (told.set, told.is_set, told.clear, lambda: told.wait(0.01), told.clear, lambda: told.wait(0.01)):
        sys.settrace(again)
        use()
        sys.settrace(None)
    assert told.is_set() and told.wait(0.01) and told.wait()
    told.clear()
    assert not told.is_set() and not told.wait(0.01)
"""


def test_a_signal_that_interrupts_the_handler_of_another_is_no_deadlock() -> None:
    """However many signals come, and at whichever line of what they set, the program goes on, and has been told."""
    subprocess.run([sys.executable, "-c", TOLD_AT_EVERY_LINE], check=True, timeout=60)


@pytest.mark.usefixtures("hangup_ends")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_long_work_ends_with_a_sentence(number: signal.Signals) -> None:
    """SIGTERM and a closed terminal end long work as Ctrl-C does, and afterwards mean what they meant before."""
    before = signal.getsignal(number)
    with pytest.raises(WorkError, match="what was finished is kept"), console.interruptible():
        signal.raise_signal(number)
    assert signal.getsignal(number) == before


def test_a_closed_terminal_that_is_ignored_stays_ignored() -> None:
    """Under nohup, long work and a program that runs until told go on when their terminal is closed."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with console.until_told() as told, console.interruptible():
            signal.raise_signal(signal.SIGHUP)
            assert not told.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)
