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
    with closing(Shell()) as opened:
        yield opened


def test_programs_are_run_one_after_the_other_by_one_process(shell: Shell) -> None:
    """Each program's output and exit code come back, what it says on standard error does not, and the shell stays."""
    assert shell.run(["sh", "-c", "echo one; echo two >&2; echo three; exit 3"], 10) == Completed(3, "one\nthree\n")
    assert shell.run(["printf", "no end of line"], 10) == Completed(0, "no end of line")
    parents = {shell.run(["sh", "-c", "echo $PPID"], 10) for _ in range(2)}
    assert len(parents) == 1
    assert parents != {Completed(0, f"{os.getpid()}\n")}


def test_a_program_that_is_not_there(shell: Shell) -> None:
    """A program that is not installed has the exit code by which shells say so."""
    assert shell.run(["no-such-program-of-ours"], 10) == Completed(NOT_FOUND, "")


def test_words_are_words(shell: Shell) -> None:
    """What means something to a shell means nothing in an argument."""
    ended = shell.run(["printf", "%s|", "$HOME; echo 'x'", "a b", "*"], 10)
    assert ended == Completed(0, "$HOME; echo 'x'|a b|*|")


def test_one_that_takes_too_long_is_given_up_and_the_next_is_not_disturbed(shell: Shell) -> None:
    """An answer that does not come in time is none, and is not taken for the answer of the next program."""
    assert shell.run(["sh", "-c", "sleep 10; echo late"], 0.05) is None
    assert shell.run(["echo", "next"], 10) == Completed(0, "next\n")


def test_the_limit_holds_and_what_took_too_long_is_ended(shell: Shell, tmp_path: Path) -> None:
    """Who asks is not held up until a program ends that takes longer than it may, and the program does not go on."""
    os.mkfifo(tmp_path / "said")
    with os.fdopen(os.open(tmp_path / "said", os.O_RDONLY | os.O_NONBLOCK)) as said:
        os.set_blocking(said.fileno(), True)
        began_ns = MachineClock().now().mono_ns
        assert shell.run(["sh", "-c", 'exec > "$0"; echo begun; exec sleep 60', str(tmp_path / "said")], 1.0) is None
        assert said.read() == "begun\n"  # to the end, which comes when nobody can write any more
        assert MachineClock().now().mono_ns - began_ns < 30 * NS_PER_S


def test_a_shell_that_was_killed_is_replaced(shell: Shell) -> None:
    """Where the shell has died the question has no answer, and the next one has."""
    ended = shell.run(["sh", "-c", "echo $PPID"], 10)
    assert ended is not None
    os.kill(int(ended.output), signal.SIGKILL)
    assert shell.run(["echo", "lost"], 10) is None
    assert shell.run(["echo", "next"], 10) == Completed(0, "next\n")
