"""The workers that drive the runs of a sweep: processes of this machine, or Dask workers on one or several machines.

Both kinds are `concurrent.futures` executors; `cluster.py` creates Dask's. Local processes write the files of a run
directly into the run's directory. Remote workers need no access to this machine's files: they write into a temporary
directory and send the files back.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lavt.experiment.analysis.drive_data import DriveData
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.run import RESULT, drive_once
from lavt.recording.output_directory import prepare_directory

TERMINAL_SIGNALS = (signal.SIGINT, signal.SIGHUP)
"""The signals that Ctrl-C and the closing of a terminal send."""


@dataclass(frozen=True, slots=True)
class Workers:
    """An executor for `jobs` runs at a time; `remote` workers send back the files of a run."""

    executor: Executor
    jobs: int
    remote: bool

    def submit(self, planned: PlannedRun, directory: Path) -> Future[Any]:
        """Start a run, and return a future whose result is an argument of `collect`."""
        if self.remote:
            return self.executor.submit(drive_remotely, planned)
        return self.executor.submit(drive_once, planned, directory)

    def collect(self, result: Any, directory: Path) -> DriveData:
        """Return the data of a finished run; if the run was remote, first write its files into `directory`."""
        drive: DriveData = result
        if self.remote:
            drive, files = result
            write_files(files, directory)
        return replace(drive, directory=directory)

    def stop(self) -> None:
        """Start no more runs, and wait for the local runs in progress; remote runs in progress are lost."""
        if self.remote:
            self.executor.shutdown(wait=False)  # Dask's executor always cancels all runs; it has no `cancel_futures`
        else:
            self.executor.shutdown(wait=True, cancel_futures=True)


@contextmanager
def process_workers(jobs: int) -> Iterator[Workers]:
    """Yield worker processes on this machine, which end when this process ends or is killed."""
    context = multiprocessing.get_context("spawn")  # a fork would copy locks that are never released
    with terminal_signals_blocked():
        executor = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_process)
    with terminal_signals_blocked():  # again: the start of Python's resource tracker unblocked SIGINT
        for _ in range(jobs):
            executor.submit(os.getpid)  # starts a process
    with executor:
        yield Workers(executor, jobs, remote=False)


@contextmanager
def terminal_signals_blocked() -> Iterator[None]:
    """Block the terminal's signals inside the `with` block.

    In processes that are started in the block, these signals are blocked until they call `ignore_terminal_signals`.
    """
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


def ignore_terminal_signals() -> None:
    """Ignore the terminal's signals: all processes of the terminal receive them, but only the parent handles them."""
    for number in TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, TERMINAL_SIGNALS)


def _begin_process() -> None:
    ignore_terminal_signals()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit when the parent process has ended, so that no process of an old sweep writes into a resumed sweep."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        try:
            parent.join()
        finally:
            os._exit(1)


def drive_remotely(planned: PlannedRun) -> tuple[DriveData, dict[str, bytes]]:
    """Drive a run in a temporary directory, and return its data and its files by name."""
    with TemporaryDirectory(prefix="lavt-") as scratch:
        directory = Path(scratch) / "run"
        drive = drive_once(planned, directory)
        return drive, {path.name: path.read_bytes() for path in directory.iterdir()}


def write_files(files: Mapping[str, bytes], directory: Path) -> None:
    """Write the files of a run; the result is the last file, because its existence marks the run as finished."""
    prepare_directory(directory)
    for name in sorted(files, key=lambda name: name == RESULT):
        unfinished = directory / f"{name}.part"
        unfinished.write_bytes(files[name])
        unfinished.replace(directory / name)
