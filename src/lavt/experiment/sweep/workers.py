"""The workers that drive the runs of a sweep: processes of this machine, or Dask workers on one or several machines.

Both kinds are `concurrent.futures` executors; `cluster.py` creates Dask's. Local processes write the files of a run
directly into the run's directory. Remote workers need no access to this machine's files: they write into a temporary
directory and send the files back.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from lavt.config import RunConfig
from lavt.experiment.analysis.drive_data import DriveData, read_drive
from lavt.experiment.analysis.results import read_json
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.run import RESULT, drive_once
from lavt.experiment.sweep.worker_processes import WorkerProcesses
from lavt.recording.output_directory import disk_errors_named, prepare_directory

Item = TypeVar("Item")
DriveRun = Callable[[PlannedRun, Path], DriveData]
"""Drives a run, and writes its files into a directory."""


@dataclass(frozen=True, slots=True)
class Workers:
    """An executor for `jobs` runs at a time; `remote` workers send back the files of a run."""

    executor: Executor
    jobs: int
    remote: bool

    def submit(self, planned: PlannedRun, directory: Path, drive: DriveRun) -> Future[Any]:
        """Start a run, and return a future whose result is an argument of `collect`; remote workers ignore `drive`."""
        if self.remote:
            return self.executor.submit(drive_remotely, planned)
        return self.executor.submit(drive_or_read, planned, directory, drive)

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
    with WorkerProcesses(jobs) as executor:
        yield Workers(executor, jobs, remote=False)


def attempt_in_processes(
    attempt: Callable[[Workers, Sequence[Item]], Sequence[Item]], todo: Sequence[Item], jobs: int
) -> Sequence[Item]:
    """Attempt all of `todo` in worker processes, at most three times; return the items without a result.

    `attempt` returns the items whose process died. The third attempt has a single process, for which the memory may
    suffice even if it does not suffice for several.
    """
    for processes in (jobs, jobs, 1):
        if todo:
            with process_workers(processes) as workers:
                todo = attempt(workers, todo)
    return todo


def drives_alone(config: RunConfig) -> bool:
    """Return whether no other run may be driven beside this one: in real time, or in a CARLA server."""
    return config.time == "real" or config.vehicle.kind == "carla"


def is_finished(directory: Path) -> bool:
    """Return whether the run in `directory` has a result, with any ending."""
    return (directory / RESULT).is_file()


def remove_unfinished(directory: Path) -> None:
    """Remove the directory of a run that has no result, so that the run can be driven again."""
    if directory.is_dir() and not is_finished(directory):
        shutil.rmtree(directory)


def drive_or_read(planned: PlannedRun, directory: Path, drive: DriveRun = drive_once) -> DriveData:
    """Drive a run, unless it was finished by a process that died afterwards; return its data."""
    if is_finished(directory):
        return read_drive(directory, read_json(directory / RESULT))
    remove_unfinished(directory)
    with disk_errors_named(directory):
        return drive(planned, directory)


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
