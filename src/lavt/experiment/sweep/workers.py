"""Who drives the runs of a sweep: processes of this machine, or Dask's workers on many.

Either is a `concurrent.futures` executor (`cluster.py` has Dask's). Processes write a run's directory where it belongs;
workers elsewhere, which need not see this machine's files, drive into a directory of their own and send it back.
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

TERMINAL = (signal.SIGINT, signal.SIGHUP)
"""What Ctrl-C and a closed terminal send."""


@dataclass(frozen=True, slots=True)
class Workers:
    """An executor with room for `jobs` runs at a time; `far` ones send back what they have written."""

    executor: Executor
    jobs: int
    far: bool

    def submit(self, planned: PlannedRun, directory: Path) -> Future[Any]:
        """Have a run driven; `collect` takes what comes of it."""
        if self.far:
            return self.executor.submit(run_elsewhere, planned)
        return self.executor.submit(drive_once, planned, directory)

    def collect(self, done: Any, directory: Path) -> DriveData:
        """Give a run whose files are then in `directory`."""
        drive: DriveData = done
        if self.far:
            drive, files = done
            put_files(files, directory)
        return replace(drive, directory=directory)

    def stop(self) -> None:
        """Begin nothing more; wait for what is under way, but for `far` runs, which are lost."""
        if self.far:
            self.executor.shutdown(wait=False)  # Dask's cancels all then, and knows no cancel_futures
        else:
            self.executor.shutdown(wait=True, cancel_futures=True)


@contextmanager
def processes(jobs: int) -> Iterator[Workers]:
    """Give processes of this machine, which end with this one, whatever ends it."""
    context = multiprocessing.get_context("spawn")  # a fork copies locks that nobody will ever release
    with terminal_held():
        executor = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin_process)
    with terminal_held():  # again: Python's resource tracker, which has been started now, lets Ctrl-C through
        for _ in range(jobs):
            executor.submit(os.getpid)  # which starts a process
    with executor:
        yield Workers(executor, jobs, far=False)


@contextmanager
def terminal_held() -> Iterator[None]:
    """Hold Ctrl-C and a closed terminal back; from processes that are started meanwhile, until `ignore_terminal`."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore_terminal() -> None:
    """Let Ctrl-C and a closed terminal be: they go to all processes of the terminal, but only the parent decides."""
    for number in TERMINAL:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, TERMINAL)


def _begin_process() -> None:
    ignore_terminal()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End when the parent is gone, so that nobody writes into a sweep that is resumed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def run_elsewhere(planned: PlannedRun) -> tuple[DriveData, dict[str, bytes]]:
    """Drive a run into a directory that is gone afterwards; give what came of it, and its files by name."""
    with TemporaryDirectory(prefix="lavt-") as scratch:
        directory = Path(scratch) / "run"
        drive = drive_once(planned, directory)
        return drive, {path.name: path.read_bytes() for path in directory.iterdir()}


def put_files(files: Mapping[str, bytes], directory: Path) -> None:
    """Write a run's files, the result last: what says that a run is finished must not be there before the rest."""
    prepare_directory(directory)
    for name in sorted(files, key=lambda name: name == RESULT):
        unfinished = directory / f"{name}.part"
        unfinished.write_bytes(files[name])
        unfinished.replace(directory / name)
