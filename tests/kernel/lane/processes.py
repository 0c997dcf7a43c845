"""Run and stop programs on one machine: the functions that `Machine` calls on that machine."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path

_numbers = itertools.count()
_started: dict[int, tuple[subprocess.Popen[bytes], Path]] = {}


def run(command: list[str], timeout_s: float) -> tuple[int, str, str]:
    """Run a program to completion; return exit code, standard output and standard error."""
    completed = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, check=False
    )
    return completed.returncode, completed.stdout, completed.stderr


def start(command: list[str], environment: dict[str, str]) -> int:
    """Start a program with its output in files; return the number by which the other functions know it."""
    folder = Path(tempfile.mkdtemp(prefix="started-"))
    with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            env={**os.environ, **environment},
            start_new_session=True,
        )
    number = next(_numbers)
    _started[number] = (process, folder)
    return number


def poll(number: int) -> int | None:
    """Return the exit code, or None while the program runs."""
    return _started[number][0].poll()


def stop(number: int, with_signal: int, timeout_s: float) -> int:
    """Signal a program, kill it and its children after the timeout, and return the exit code."""
    process = _started[number][0]
    if process.poll() is None:
        process.send_signal(with_signal)
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout_s)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    return process.wait()


def send_signal(number: int, with_signal: int) -> None:
    """Send a signal to a program."""
    _started[number][0].send_signal(with_signal)


def output(number: int, name: str) -> str:
    """Return the program's output so far on `out` or `err`."""
    return (_started[number][1] / name).read_text(errors="replace")


def newest_line(number: int) -> str:
    """Return the newest complete line of standard output, or an empty string."""
    with (_started[number][1] / "out").open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - 65536))
        lines = file.read().decode(errors="replace").splitlines(keepends=True)
    return next((line for line in reversed(lines) if line.endswith("\n")), "")


def write(path: str, text: str) -> None:
    """Write a file, and create its directory if necessary."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(text)
