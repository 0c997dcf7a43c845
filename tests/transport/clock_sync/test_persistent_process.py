from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from lavt.clock import MachineClock
from lavt.domain import NS_PER_S
from lavt.transport.clock_sync.persistent_process import NOT_FOUND, Completed, Shell


@pytest.fixture
def shell() -> Iterator[Shell]:
    with closing(Shell()) as persistent_shell:
        yield persistent_shell


def test_one_shell_runs_all_programs(shell: Shell) -> None:
    """One persistent shell returns each program's output and exit code, without its standard error."""
    assert shell.run(["sh", "-c", "echo one; echo two >&2; echo three; exit 3"], 10) == Completed(3, "one\nthree\n")
    assert shell.run(["printf", "no end of line"], 10) == Completed(0, "no end of line")
    parents = {shell.run(["sh", "-c", "echo $PPID"], 10) for _ in range(2)}
    assert len(parents) == 1
    assert parents != {Completed(0, f"{os.getpid()}\n")}


def test_a_closed_shell_starts_no_process() -> None:
    """After `close`, a late command has no result and starts no process, because nothing would end it."""
    shell = Shell()
    with closing(shell):
        assert shell.run(["echo", "one"], 10) == Completed(0, "one\n")
    try:
        assert shell.run(["echo", "late"], 10) is None
    finally:
        shell.close()


def test_missing_program_has_exit_code_127(shell: Shell) -> None:
    """A program that is not installed has exit code 127, as in any shell."""
    assert shell.run(["no-such-program-of-ours"], 10) == Completed(NOT_FOUND, "")


def test_arguments_are_quoted(shell: Shell) -> None:
    """Shell syntax in an argument has no effect."""
    completed = shell.run(["printf", "%s|", "$HOME; echo 'x'", "a b", "*"], 10)
    assert completed == Completed(0, "$HOME; echo 'x'|a b|*|")


def test_timeout_does_not_disturb_the_next_program(shell: Shell) -> None:
    """A program that exceeds its timeout has no result, and the next result has nothing of its output."""
    assert shell.run(["sh", "-c", "sleep 10; echo late"], 0.05) is None
    assert shell.run(["echo", "next"], 10) == Completed(0, "next\n")


def test_program_is_killed_at_the_timeout(shell: Shell, tmp_path: Path) -> None:
    """At the timeout the caller continues, and the program is killed."""
    os.mkfifo(tmp_path / "fifo")
    with os.fdopen(os.open(tmp_path / "fifo", os.O_RDONLY | os.O_NONBLOCK)) as fifo:
        os.set_blocking(fifo.fileno(), True)
        began_ns = MachineClock().now().mono_ns
        assert shell.run(["sh", "-c", 'exec > "$0"; echo begun; exec sleep 60', str(tmp_path / "fifo")], 1.0) is None
        assert fifo.read() == "begun\n"  # to the end of file, which comes when no writer is left
        assert MachineClock().now().mono_ns - began_ns < 30 * NS_PER_S


def test_killed_shell_is_replaced(shell: Shell) -> None:
    """If the shell has been killed, one command has no result, and the next one starts a new shell."""
    completed = shell.run(["sh", "-c", "echo $PPID"], 10)
    assert completed is not None
    os.kill(int(completed.output), signal.SIGKILL)
    assert shell.run(["echo", "lost"], 10) is None
    assert shell.run(["echo", "next"], 10) == Completed(0, "next\n")


def test_a_program_that_cannot_be_executed_is_not_found(tmp_path: Path) -> None:
    """A persistent program that the user may not execute counts as missing, as if no such file existed."""

    class Forbidden(Shell):
        """A shell from a file without the permission to execute it."""

        program = (str(tmp_path / "sh"),)

    (tmp_path / "sh").touch(mode=0o600)
    with closing(Forbidden()) as forbidden:
        assert forbidden.run(["true"], 10) == Completed(NOT_FOUND, "")
