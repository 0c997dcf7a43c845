"""A persistent process that answers queries, so that LAVT need not start a process for each query.

While a Python process starts another process, all its threads are blocked until the new program is loaded (Python keeps
its lock over vfork(2)): for 10 ms and more on a slow machine. So a persistent program is queried, or a persistent shell
starts the program.
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
"""Exit code if there is no such program (POSIX, shell command language, 2.8.2)."""


class Completed(NamedTuple):
    """A program's exit code and standard output."""

    code: int
    output: str


Run = Callable[[Sequence[str], float], Completed | None]
"""Runs a command line for at most a number of seconds, the second argument; None: it did not complete in time."""


class PersistentProcess(ABC):
    """A process that executes one command after the other. It starts with the first one; `close` ends it for good."""

    program: tuple[str, ...]
    niceness = 0

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or MachineClock()
        self._process: subprocess.Popen[bytes] | None = None
        self._is_closed = False
        self._lock = threading.Lock()

    @abstractmethod
    def encode(self, command: Sequence[str]) -> str:
        """Return a command in the program's input format, then a second command that marks the end of the answer."""

    @abstractmethod
    def parse_answer(self, answer: bytes) -> Completed | None:
        """Return the parsed answer, or None if it is not complete yet."""

    def run(self, command: Sequence[str], timeout_s: float) -> Completed | None:
        """Run a command to completion. Return None if it takes too long, or the process has died or was closed."""
        with self._lock:
            if self._is_closed:  # a query of another thread can come later than `close`
                return None
            try:
                return self._query(self.encode(command), timeout_s)
            except (FileNotFoundError, PermissionError):  # the latter also if a directory of PATH cannot be searched
                return Completed(NOT_FOUND, "")
            except OSError:  # the process was killed: the next query starts another one
                self._kill()
                return None

    def close(self) -> None:
        """End the process; later commands do not start another one."""
        with self._lock:
            self._is_closed = True
            self._kill()

    def _query(self, encoded_command: str, timeout_s: float) -> Completed | None:
        if self._process is None:
            self._process = subprocess.Popen(  # noqa: S603 (the program is a constant of the class)
                self.program,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C at the terminal must not end it
            )
            if self.niceness:
                with suppress(OSError):
                    os.setpriority(os.PRIO_PROCESS, self._process.pid, self.niceness)
        assert self._process.stdin is not None  # noqa: S101 (Popen was called with a pipe)
        assert self._process.stdout is not None  # noqa: S101
        os.write(self._process.stdin.fileno(), encoded_command.encode())
        limit_ns = self._clock.now().mono_ns + round(timeout_s * NS_PER_S)
        answer, output = b"", self._process.stdout.fileno()
        while (completed := self.parse_answer(answer)) is None:
            remaining_s = (limit_ns - self._clock.now().mono_ns) / NS_PER_S
            if remaining_s <= 0 or not select.select([output], [], [], remaining_s)[0]:
                self._kill()  # its late output would be taken for the next answer
                return None
            chunk = os.read(output, 65_536)
            if not chunk:
                raise OSError
            answer += chunk
        return completed

    def _kill(self) -> None:
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)  # including its children, in its session
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()  # without reading: a child outside the session can keep the other end open for ever
            self._process.wait()
            self._process = None


class Shell(PersistentProcess):
    """A persistent shell that runs one program after the other and discards their standard error."""

    program = ("/bin/sh",)
    niceness = 10
    """Higher than normal, because the start of a program must not delay the processes that drive."""
    END: Final = "lavt: ended with"
    """Prefix of the line after a program's output."""

    def encode(self, command: Sequence[str]) -> str:
        """Return a command line with every argument quoted, which also prints the exit code."""
        return f"{shlex.join(command)} 2>/dev/null </dev/null; printf '\\n{self.END} %s\\n' $?\n"

    def parse_answer(self, answer: bytes) -> Completed | None:
        """Return a program's output and exit code."""
        output, end, code = answer.decode(errors="replace").rpartition(f"\n{self.END} ")
        return Completed(int(code), output) if end and code.endswith("\n") else None
