"""Processes of LAVT started by LAVT: each prints JSON lines, and is told to end with SIGINT when its run ends.

Only a run that is killed outright (SIGKILL) leaves its processes behind.
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
from pathlib import Path
from types import TracebackType
from typing import Any

from lavt.errors import UserError, WorkError

READY_S = 60.0
"""Importing and preparing takes 1 to 5 s on a quiet machine."""
END_S = 15.0
USER_ERROR = 2
"""Exit code of a program whose input was wrong."""
LAVT = ("-m", "lavt")
"""What Python runs: the installed program. Tests give a program of their own that breaks a part on purpose."""


class Process:
    """`lavt ARGUMENTS --json`, its JSON lines on standard output, its messages in a log file."""

    def __init__(self, name: str, arguments: Sequence[str], log_dir: Path, program: Sequence[str] = LAVT) -> None:
        self.name = name
        self.latest: dict[str, Any] = {}
        """Newest line."""
        self._log = log_dir / f"{name}.log"
        self._first: queue.Queue[dict[str, Any] | None] = queue.Queue()
        with self._log.open("wb") as log:
            self.popen = subprocess.Popen(  # noqa: S603 (our own program)
                [sys.executable, *program, *arguments, "--json"],
                stdout=subprocess.PIPE,
                stderr=log,
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C at the terminal goes to who started it, who ends it in order
                env={**os.environ, "OPENCV_FOR_THREADS_NUM": "1"},
            )
        self._reader = threading.Thread(target=self._read, name=f"{name} lines", daemon=True)
        self._reader.start()

    def ready(self) -> dict[str, Any]:
        """Wait for the first line.

        Raises `WorkError` where the process says nothing or ends, and `UserError` where it ends for wrong input.
        """
        try:
            line = self._first.get(timeout=READY_S)
        except queue.Empty:
            raise WorkError(f"{self.name} did not get ready within {READY_S:.0f} s") from None
        if line is None:
            if self.popen.wait() == USER_ERROR:
                raise UserError(self.said().removeprefix("lavt: "))
            raise WorkError(f"{self.name} did not start: {self.said()}")
        return line

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.popen.poll() is None

    def said(self) -> str:
        """Last words on standard error."""
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

    def end(self) -> None:
        """Tell it to end, and see that it does."""
        if self.running:
            self.popen.send_signal(signal.SIGCONT)  # one that was stopped could not hear
            self.popen.send_signal(signal.SIGINT)
            try:
                self.popen.wait(END_S)
            except subprocess.TimeoutExpired:
                self.popen.kill()
        self.popen.wait()
        self._reader.join()
        if self.popen.stdout is not None:
            self.popen.stdout.close()

    def last_line(self) -> dict[str, Any]:
        """Give the last line that the process printed before it ended."""
        self._reader.join()
        return self.latest

    def _read(self) -> None:
        assert self.popen.stdout is not None  # noqa: S101 (a pipe was asked for)
        for text in self.popen.stdout:
            try:
                line = json.loads(text)
            except ValueError:
                continue
            self.latest = line
            self._first.put(line)
        self._first.put(None)


class Processes:
    """Several processes that end together, last started first."""

    def __init__(self, log_dir: Path) -> None:
        self.started: list[Process] = []
        self._log_dir = log_dir

    def start(self, name: str, *arguments: str, program: Sequence[str] = LAVT) -> Process:
        """Start one."""
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
