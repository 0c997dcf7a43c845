from __future__ import annotations

import ast
import errno
import io
import os
import re
import signal
import subprocess
import sys
import weakref
from pathlib import Path

import pytest

import lavt
from lavt.cli import console
from lavt.clock import pause
from lavt.domain import NS_PER_S
from lavt.errors import WorkError


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_each_termination_signal_sets_the_stop_event(signal_number: signal.Signals) -> None:
    """Ctrl-C, SIGTERM and a closed terminal set the stop event; afterwards the former handlers are restored."""
    received = list[int]()
    former_handler = signal.signal(signal_number, lambda *_: received.append(signal_number))
    try:
        with console.stop_on_signals() as stop:
            assert not stop.is_set()
            signal.raise_signal(signal_number)
            assert (stop.is_set(), received) == (True, [])
        signal.raise_signal(signal_number)
        assert received == [signal_number]
    finally:
        signal.signal(signal_number, former_handler)


SIGNAL_AT_EVERY_LINE = """
import signal, sys
from lavt.cli import console

def raise_at_each_line(frame, event, argument):
    signal.raise_signal(signal.SIGTERM)
    return raise_at_each_line

with console.stop_on_signals() as stop:
    for method in (stop.set, stop.is_set, stop.clear, lambda: stop.wait(0.01), stop.clear, lambda: stop.wait(0.01)):
        sys.settrace(raise_at_each_line)
        method()
        sys.settrace(None)
    assert stop.is_set() and stop.wait(0.01) and stop.wait()
    stop.clear()
    assert not stop.is_set() and not stop.wait(0.01)
"""


def test_nested_signals_do_not_deadlock() -> None:
    """Signals that interrupt any line of the stop event's methods do not block the program, and set the event."""
    subprocess.run([sys.executable, "-c", SIGNAL_AT_EVERY_LINE], check=True, timeout=280)


@pytest.mark.usefixtures("default_sighup_action")
@pytest.mark.parametrize("signal_number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_interrupts_long_work(signal_number: signal.Signals) -> None:
    """SIGTERM and SIGHUP (closed terminal) end long work like Ctrl-C; afterwards the former handlers are restored."""
    former_handler = signal.getsignal(signal_number)
    with pytest.raises(WorkError, match="stopped"), console.interruptible():
        signal.raise_signal(signal_number)
    assert signal.getsignal(signal_number) == former_handler


def test_the_first_interrupt_says_what_is_finished(capsys: pytest.CaptureFixture[str]) -> None:
    """The first Ctrl-C during long work says what is finished before the end; the second adds nothing."""

    def work() -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(WorkError, match="stopped"), console.interruptible("runs"):
        work()
    assert capsys.readouterr().err.count("finishing the runs in progress; Ctrl-C again ends at once") == 1


def test_ctrl_c_in_a_callback_that_discards_errors_interrupts_long_work() -> None:
    """Ctrl-C in a callback of a weak reference, whose errors Python discards, is repeated after the callback."""

    class Figure:
        pass

    def interrupt(_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    def work() -> None:
        figure = Figure()
        reference = weakref.ref(figure, interrupt)
        del figure
        assert reference() is None
        pause(10 * NS_PER_S)

    with pytest.raises(WorkError, match="stopped"), console.interruptible():
        work()


def test_an_ignored_ctrl_c_stays_ignored_by_long_work() -> None:
    """Ctrl-C for another program does not end a sweep that a shell script has started in the background."""
    former_handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with console.interruptible("runs"):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, former_handler)


def test_an_ignored_hangup_stays_ignored() -> None:
    """Under nohup, a closed terminal ends neither long work nor a program that runs until it is stopped."""
    former_handler = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with console.stop_on_signals() as stop, console.interruptible():
            signal.raise_signal(signal.SIGHUP)
            assert not stop.is_set()
    finally:
        signal.signal(signal.SIGHUP, former_handler)


@pytest.mark.parametrize(
    ("number", "advice", "code"), [(errno.ENOSPC, "free space", 1), (errno.EISDIR, "remove this directory", 2)]
)
def test_an_error_of_the_system_comes_with_advice(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, number: int, advice: str, code: int
) -> None:
    """An error of the operating system ends a command with the path and advice, and exit code 2 if a name is wrong."""

    def fail() -> None:
        raise OSError(number, os.strerror(number), str(tmp_path))

    with pytest.raises(SystemExit) as exit_error:
        console.run_command(fail)
    message = capsys.readouterr().err
    assert exit_error.value.code == code
    assert str(tmp_path) in message
    assert advice in message


def test_a_result_that_cannot_be_printed_names_the_standard_output(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the standard output is redirected to a full disk, the error says that it was the standard output."""

    class FullDisk(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, f"No space left on device for {len(text)} characters")

    monkeypatch.setattr(sys, "stdout", FullDisk())
    with pytest.raises(OSError, match="the standard output"):
        console.print_json([1])


def messages(call: ast.Call) -> str:
    """Return the constant texts of the message of an exception."""
    constants = [part.value for part in ast.walk(call) if isinstance(part, ast.Constant)]
    return "".join(text for text in constants if isinstance(text, str))


def test_every_rejection_says_what_to_do() -> None:
    """The message of each `UserError` has two parts: the error, and after a colon or semicolon the remedy."""
    without_remedy = []
    for path in Path(lavt.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)):
                continue
            if isinstance(node.exc.func, ast.Name) and node.exc.func.id == "UserError":
                text = messages(node.exc)
                if text and not re.search(r"[:;] ", text):
                    without_remedy.append(f"{path.name}:{node.lineno}: {text}")
    assert without_remedy == []
