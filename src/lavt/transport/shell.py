"""Asking a program again and again without starting it from here.

To start a process holds up every thread of this one until the new program has been loaded (Python keeps its lock over
vfork(2)): 10 ms and more on a slow machine, once a second. So a shell that stays starts it.
"""

from __future__ import annotations

import os
import select
import shlex
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final, NamedTuple

from lavt.clock import Clock, MachineClock
from lavt.domain import NS_PER_S

END: Final = "lavt: ended with"
"""Begins the line after a program's output."""
NICENESS: Final = 10
"""Less of the processor than others get: a question must not hold up who drives."""
NOT_FOUND: Final = 127
"""Exit code where there is no such program (POSIX, shell command language, 2.8.2)."""


class Ended(NamedTuple):
    """A program's exit code and standard output."""

    code: int
    output: str


Run = Callable[[Sequence[str], float], Ended | None]
"""Runs a program for so many seconds at most; None where it has not ended by then."""


class Shell:
    """A shell that runs one program after the other, started with the first one; to be closed."""

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or MachineClock()
        self._process: subprocess.Popen[bytes] | None = None
        self._one_at_a_time = threading.Lock()

    def run(self, command: Sequence[str], timeout_s: float) -> Ended | None:
        """Run a program to its end; None where that takes too long, or where there is no shell."""
        with self._one_at_a_time:
            try:
                return self._ask(
                    f"{shlex.join(command)} 2>/dev/null </dev/null; printf '\\n{END} %s\\n' $?\n", timeout_s
                )
            except OSError:  # it was killed: the next question starts another
                self._end()
                return None

    def close(self) -> None:
        """End the shell."""
        with self._one_at_a_time:
            self._end()

    def _ask(self, line: str, timeout_s: float) -> Ended | None:
        if self._process is None:
            self._process = subprocess.Popen(
                ["/bin/sh"],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C at the terminal is for us
            )  # fmt: skip
            with suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)
        assert self._process.stdin is not None  # noqa: S101 (a pipe was asked for)
        assert self._process.stdout is not None  # noqa: S101
        os.write(self._process.stdin.fileno(), line.encode())
        limit_ns = self._clock.now().mono_ns + round(timeout_s * NS_PER_S)
        answer, output = b"", self._process.stdout.fileno()
        while b"\n" + END.encode() not in answer or not answer.endswith(b"\n"):
            left_s = (limit_ns - self._clock.now().mono_ns) / NS_PER_S
            if left_s <= 0 or not select.select([output], [], [], left_s)[0]:
                self._end()  # what it still says would be taken for the next answer
                return None
            piece = os.read(output, 65_536)
            if not piece:
                raise OSError
            answer += piece
        said, _, code = answer.decode(errors="replace").rpartition(f"\n{END} ")
        return Ended(int(code), said)

    def _end(self) -> None:
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)  # what it runs too, in its session
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    pipe.close()  # unread: who escaped from the session may hold the other end for ever
            self._process.wait()
            self._process = None
