"""Child processes that run LAVT: each prints JSON lines, and is ended with SIGINT when the run ends.

They also end if the parent process dies, even by SIGKILL (`runtime/parent_watch.py`).
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from lavt.errors import UserError, WorkError
from lavt.runtime.parent_watch import ENDS_WITH_STDIN

READY_LIMIT_S = 60.0
"""The time limit for the first line of a process. On a quiet machine, imports and preparations take 1 to 5 s."""
END_LIMIT_S = 15.0
"""A process that has not ended this long after SIGINT is killed."""
OUTPUT_LIMIT_S = 5.0
"""How long to wait for the last lines of a process that has ended: another process may hold its output open."""
USER_ERROR_CODE = 2
"""The exit code of a program whose input was wrong."""
LAVT = ("-m", "lavt")
"""Python's arguments that start LAVT. Tests replace them by arguments that start a program with deliberate faults."""


class Process:
    """A child process `lavt ARGUMENTS --json` with JSON lines on standard output and messages in a log file."""

    def __init__(self, name: str, arguments: Sequence[str], log_dir: Path, program: Sequence[str] = LAVT) -> None:
        self.name = name
        self.latest: dict[str, Any] = {}
        """The newest line of the process."""
        self.first: dict[str, Any] = {}
        """The first line of the process, which says that it is ready."""
        self._log = log_dir / f"{name}.log"
        self._first: queue.Queue[dict[str, Any] | None] = queue.Queue()
        with self._log.open("wb") as log:
            self.popen = subprocess.Popen(  # noqa: S603 (our own program)
                [sys.executable, *program, *arguments, "--json"],
                stdout=subprocess.PIPE,
                stderr=log,
                stdin=subprocess.PIPE,  # nothing is written: it closes when this process dies
                start_new_session=True,  # the parent alone receives Ctrl-C, and ends its processes in order
                env={**os.environ, "OPENCV_FOR_THREADS_NUM": "1", ENDS_WITH_STDIN: "1"},
            )
        self._reader = threading.Thread(target=self._read, name=f"{name} lines", daemon=True)
        self._reader.start()

    def wait_ready(self) -> dict[str, Any]:
        """Wait for the first line, and return it.

        Raises `WorkError` if the process prints nothing in time or ends before, and `UserError` if it ends because of
        wrong input.
        """
        try:
            line = self._first.get(timeout=READY_LIMIT_S)
        except queue.Empty:
            raise WorkError(f"{self.name} did not get ready within {READY_LIMIT_S:.0f} s") from None
        if line is None:
            code = self.popen.wait()
            if code == USER_ERROR_CODE:
                raise UserError(self.last_message().removeprefix("lavt: "))
            ended = f"was ended by signal {-code} during its start" if code < 0 else "did not start"
            raise WorkError(f"{self.name} {ended}: {self.last_message()}")
        return line

    @property
    def running(self) -> bool:
        """Whether the process has not ended yet."""
        return self.popen.poll() is None

    @property
    def exit_code(self) -> int | None:
        """The exit code of the process, None while it runs; negative: the number of the signal that ended it."""
        return self.popen.poll()

    def last_message(self) -> str:
        """Return the last line on standard error."""
        with suppress(OSError):  # the file has been deleted
            if lines := self._log.read_text(errors="replace").strip().splitlines():
                return lines[-1]
        return "no message"

    def end(self) -> None:
        """End the process with SIGINT, and kill it if it does not end in time."""
        if self.running:
            self.popen.send_signal(signal.SIGCONT)  # a stopped process would not handle SIGINT
            self.popen.send_signal(signal.SIGINT)
            try:
                self.popen.wait(END_LIMIT_S)
            except subprocess.TimeoutExpired:
                self.popen.kill()
        self.popen.wait()
        self._reader.join(OUTPUT_LIMIT_S)
        if self.popen.stdin is not None:
            self.popen.stdin.close()

    def last_line(self) -> dict[str, Any]:
        """Wait for the end of the output of a process that has ended, and return its last line."""
        self._reader.join(OUTPUT_LIMIT_S)
        return self.latest

    def _read(self) -> None:
        """Read lines until the process ends; kill it if reading fails, so that the run does not wait for its lines."""
        assert self.popen.stdout is not None  # noqa: S101 (it is a pipe)
        try:
            with self.popen.stdout as lines:
                for text in lines:
                    with suppress(ValueError):
                        self.latest = json.loads(text)
                        self.first = self.first or self.latest
                        self._first.put(self.latest)
        except BaseException:
            self.popen.kill()
            raise
        finally:
            self._first.put(None)


class Processes:
    """A context manager of several processes, which it ends in reverse order of their start."""

    def __init__(self, log_dir: Path) -> None:
        self.started: list[Process] = []
        self._log_dir = log_dir

    def start(self, name: str, *arguments: str, program: Sequence[str] = LAVT) -> Process:
        """Start a process."""
        process = Process(name, arguments, self._log_dir, program)
        self.started.append(process)
        return process

    def __enter__(self) -> Processes:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        for process in reversed(self.started):
            process.end()
