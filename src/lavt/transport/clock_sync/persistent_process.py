"""Asking a program again and again without starting it from here.

To start a process holds up every thread of this one until the new program has been loaded (Python keeps its lock over
vfork(2)): 10 ms and more on a slow machine, once a second. So one that stays is asked, or a shell that stays starts it.
"""

from __future__ import annotations

import os
import select
import shlex
import signal
import subprocess
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, NamedTuple

from lavt.clock import Clock, MachineClock
from lavt.domain import NS_PER_S

NOT_FOUND: Final = 127
"""Exit code where there is no such program (POSIX, shell command language, 2.8.2)."""


class Completed(NamedTuple):
    """A program's exit code and standard output."""

    code: int
    output: str


Run = Callable[[Sequence[str], float], Completed | None]
"""Runs a program for so many seconds at most; None where it has not ended by then."""


class PersistentProcess(ABC):
    """A program that stays and obeys one command after the other, started with the first one; to be closed."""

    program: tuple[str, ...]
    niceness = 0

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or MachineClock()
        self._process: subprocess.Popen[bytes] | None = None
        self._one_at_a_time = threading.Lock()

    @abstractmethod
    def lines(self, command: Sequence[str]) -> str:
        """Write a command as the program reads it, with one behind it that marks where its answer ends."""

    @abstractmethod
    def ended(self, answer: bytes) -> Completed | None:
        """Read an answer; None as long as its end has not come."""

    def run(self, command: Sequence[str], timeout_s: float) -> Completed | None:
        """Run a command to its end; None where that takes too long, or where the program has died."""
        with self._one_at_a_time:
            try:
                return self._ask(self.lines(command), timeout_s)
            except FileNotFoundError:
                return Completed(NOT_FOUND, "")
            except OSError:  # it was killed: the next question starts another
                self._end()
                return None

    def close(self) -> None:
        """End the program."""
        with self._one_at_a_time:
            self._end()

    def _ask(self, lines: str, timeout_s: float) -> Completed | None:
        if self._process is None:
            self._process = subprocess.Popen(  # noqa: S603 (the program is one of the two in the code)
                self.program,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C at the terminal is for us
            )  # fmt: skip
            if self.niceness:
                with suppress(OSError):
                    os.setpriority(os.PRIO_PROCESS, self._process.pid, self.niceness)
        assert self._process.stdin is not None  # noqa: S101 (a pipe was asked for)
        assert self._process.stdout is not None  # noqa: S101
        os.write(self._process.stdin.fileno(), lines.encode())
        limit_ns = self._clock.now().mono_ns + round(timeout_s * NS_PER_S)
        answer, output = b"", self._process.stdout.fileno()
        while (ended := self.ended(answer)) is None:
            left_s = (limit_ns - self._clock.now().mono_ns) / NS_PER_S
            if left_s <= 0 or not select.select([output], [], [], left_s)[0]:
                self._end()  # what it still says would be taken for the next answer
                return None
            piece = os.read(output, 65_536)
            if not piece:
                raise OSError
            answer += piece
        return ended

    def _end(self) -> None:
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)  # what it runs too, in its session
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()  # unread: who escaped from the session may hold the other end for ever
            self._process.wait()
            self._process = None


class Shell(PersistentProcess):
    """A shell that starts one program after the other; what they say on standard error is not heard."""

    program = ("/bin/sh",)
    niceness = 10
    """Less of the processor than others get: the start of a program must not hold up who drives."""
    END: Final = "lavt: ended with"
    """Begins the line after a program's output."""

    def lines(self, command: Sequence[str]) -> str:
        """Write a command line whose words mean only themselves."""
        return f"{shlex.join(command)} 2>/dev/null </dev/null; printf '\\n{self.END} %s\\n' $?\n"

    def ended(self, answer: bytes) -> Completed | None:
        """Read a program's output and its exit code."""
        said, end, code = answer.decode(errors="replace").rpartition(f"\n{self.END} ")
        return Completed(int(code), said) if end and code.endswith("\n") else None
