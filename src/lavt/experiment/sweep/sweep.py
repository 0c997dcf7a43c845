"""Sweeps: many runs on all cores, and their summary and report. A failed run is listed and does not stop the others."""

from __future__ import annotations

import functools
import itertools
import os
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, as_completed
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml

from lavt.clock import MachineClock
from lavt.config import RunConfig, SweepConfig
from lavt.config_file import load_config
from lavt.domain import NS_PER_S
from lavt.errors import UserError, WorkError, describe_error
from lavt.experiment.analysis.drive_data import DriveData, read_drive
from lavt.experiment.analysis.results import FAILED, read_json, write_json
from lavt.experiment.runs.plan import PlannedRun, plan_sweep
from lavt.experiment.runs.run import CONFIG, RESULT, config_text
from lavt.experiment.sweep.cluster import cluster_workers
from lavt.experiment.sweep.workers import Workers, process_workers
from lavt.recording.output_directory import prepare_directory

SWEEP = "sweep.yaml"
"""In the directory of a sweep: its complete config."""

ProgressCallback = Callable[[str], None]
"""A callback that shows one line of progress."""


@dataclass(frozen=True, slots=True)
class SweepResult:
    """The results of a sweep's runs, the data of those driven by this call, and the failed runs with their reasons."""

    results: Sequence[Mapping[str, Any]]
    drives: Sequence[DriveData]
    failed: Sequence[tuple[str, str]]


def run_all(
    planned: Sequence[PlannedRun],
    runs_dir: Path,
    *,
    jobs: int | None,
    on_progress: ProgressCallback,
    cluster_address: str | None = None,
) -> tuple[SweepResult, dict[str, Any] | None]:
    """Drive the runs that have no result yet, `jobs` at a time (None: one per core), or one by one in real time.

    With `cluster_address`, the Dask workers of that scheduler drive them. Returns all results, including those of
    earlier calls, and the entry `speed` of the summary for the virtual runs of this call; None without such runs.
    """
    clock = MachineClock()
    start_ns = clock.now().mono_ns
    before = [read_json(runs_dir / each.name / RESULT) for each in planned if is_finished(runs_dir / each.name)]
    todo = [each for each in planned if not is_finished(runs_dir / each.name)]
    progress = _SweepProgress(runs_dir, on_progress)
    if cluster_address is None:
        jobs = 1 if any(each.config.time == "real" for each in todo) else jobs or os.cpu_count() or 1
        _drive_in_processes(progress, todo, jobs)
    elif todo:
        with cluster_workers(cluster_address, jobs) as workers:
            jobs = workers.jobs
            progress.drive(workers, todo)
    results = [drive.result for drive in progress.drives]
    simulated = [result for result in results if result["time"] == "virtual"]
    driven = SweepResult([*before, *results], progress.drives, progress.failed)
    if not simulated:
        return driven, None
    speed = {
        "simulated_s": sum(result["duration_s"] or 0.0 for result in simulated),
        "wall_s": (clock.now().mono_ns - start_ns) / NS_PER_S,
        "jobs": jobs,
    }
    return driven, speed


def is_finished(directory: Path) -> bool:
    """Return whether the run in `directory` was driven to any ending."""
    return (directory / RESULT).is_file()


class _SweepProgress:
    """The finished and the failed runs of a sweep so far."""

    def __init__(self, runs_dir: Path, on_progress: ProgressCallback) -> None:
        self.drives: list[DriveData] = []
        self.failed: list[tuple[str, str]] = []
        self.runs_dir = runs_dir
        self._on_progress = on_progress

    def drive(self, workers: Workers, todo: Sequence[PlannedRun]) -> list[PlannedRun]:
        """Drive runs, and return those that were not driven because a worker's process died."""
        futures = {workers.submit(each, self.runs_dir / each.name): each for each in todo}
        broken = []
        # The import of matplotlib and SciPy takes long, so it overlaps the drives. It is not in the main thread: where
        # Ctrl-C interrupts the execution of a string, as for a dataclass, `python -m` dies although it was handled.
        threading.Thread(target=import_module, args=("lavt.experiment.report.report",)).start()
        try:
            for future in as_completed(list(futures)):
                planned = futures.pop(future)  # frees the result, which has the files of a remote run
                try:
                    drive = workers.collect(future.result(), self.runs_dir / planned.name)
                except BrokenExecutor:
                    broken.append(planned)
                except Exception as error:  # of any kind: the other runs are independent of it
                    self.fail(planned, describe_error(error))
                else:
                    self.take(planned, drive)
        except KeyboardInterrupt:
            workers.stop()
            _remove_unfinished(todo, self.runs_dir)  # the files of remote runs may be incomplete
            raise
        return broken

    def take(self, planned: PlannedRun, drive: DriveData) -> None:
        """Add a finished run."""
        self.drives.append(drive)
        self._on_progress(f"{planned.name}: {drive.result['ending']}")

    def fail(self, planned: PlannedRun, reason: str) -> None:
        """Add a failed run."""
        self.failed.append((planned.name, reason))
        self._on_progress(f"{planned.name} failed: {reason}")


def _drive_in_processes(progress: _SweepProgress, todo: Sequence[PlannedRun], jobs: int) -> None:
    """Drive runs in processes; where one dies, the pool breaks, and the runs that had begun are driven again, alone."""
    while todo:
        with process_workers(jobs) as workers:
            broken = progress.drive(workers, todo)
        begun = [each for each in broken if (progress.runs_dir / each.name).exists()]
        _remove_unfinished(broken, progress.runs_dir)
        for each in begun:
            directory = progress.runs_dir / each.name
            if is_finished(directory):  # the process died after the run
                progress.take(each, read_drive(directory, read_json(directory / RESULT)))
                continue
            with process_workers(1) as single:
                if progress.drive(single, [each]):
                    progress.fail(each, "the process that drove it died, twice")
        todo = [each for each in broken if each not in begun]
        if todo and not begun:
            for each in todo:
                progress.fail(each, "its process died before it began")
            return


def open_sweep(out: Path, *, resume: bool) -> None:
    """Create the directory of a sweep, or check that a sweep to resume has one; raise `UserError` otherwise."""
    if resume and not out.is_dir():
        raise UserError(f"there is nothing to resume in {out}: omit --resume to begin")
    if not resume:
        prepare_directory(out)


def drive_sweep(
    config: SweepConfig,
    planned: Sequence[PlannedRun],
    out: Path,
    *,
    jobs: int | None,
    on_progress: ProgressCallback,
    cluster_address: str | None = None,
) -> tuple[Path, SweepResult]:
    """Drive the missing runs of a sweep into `out`, and write its config, summary and report.

    `planned` are the runs of `config`; `cluster_address` is that of `run_all`. Returns the path of the report's page,
    and the results. Failed runs are in `out`/failed.json, in the summary and in the report.
    """
    _check_sweep(config, out)
    runs_dir = out / "runs"
    runs_dir.mkdir(exist_ok=True)
    for each in planned:
        if is_finished(runs_dir / each.name):
            _check_config(each, runs_dir / each.name)
    (out / SWEEP).write_text(yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False))
    _remove_unfinished(planned, runs_dir)
    driven, speed = run_all(planned, runs_dir, jobs=jobs, on_progress=on_progress, cluster_address=cluster_address)
    failed = [{"run": name, "reason": reason} for name, reason in driven.failed]
    write_json(out / FAILED, failed)
    if not driven.results:
        raise WorkError("no run was finished: " + "; ".join(f"{name}: {reason}" for name, reason in driven.failed))
    from lavt.experiment.report.report import write_report  # noqa: PLC0415 (slow: see `_SweepProgress.drive`)

    drives = {drive.directory: drive for drive in driven.drives}
    return write_report(out, speed=speed, base=base_of(config, planned), drives=drives, failed=failed), driven


def base_of(config: SweepConfig, planned: Sequence[PlannedRun]) -> dict[str, Any]:
    """Return the value of each further axis in the sweep's base config, which identifies the runs of that config.

    No run is of the base config where one of its values is not among those of the axis.
    """
    base = {key: _value_at(config, key) for key in config.axes}
    for run, key in itertools.product(planned, config.axes):
        if _value_at(run.config, key) == _value_at(config, key):
            base[key] = run.identity["axes"][key]  # in the notation of the axis: 20 or 20.0, a section or a part of it
    return base


def recorded_base(out: Path) -> dict[str, Any] | None:
    """Return `base_of` of the sweep in `out`; None without a sweep's config there."""
    if not (out / SWEEP).is_file():
        return None
    config = load_config(SweepConfig, out / SWEEP)
    return base_of(config, plan_sweep(config))


def _value_at(config: RunConfig, key: str) -> Any:
    return functools.reduce(lambda section, name: section[name], key.split("."), config.model_dump(mode="json"))


def _check_sweep(config: SweepConfig, out: Path) -> None:
    """Raise `UserError` where another sweep was begun in `out`: the report would mix the runs of both sweeps."""
    if not (out / SWEEP).is_file():
        return
    begun, requested = (each.model_dump(mode="json") for each in (load_config(SweepConfig, out / SWEEP), config))
    different = [key for key in requested if requested[key] != begun[key]]
    if different:
        raise UserError(
            f"{out} was begun with another config ({', '.join(different)}): resume with that one, or name another --out"
        )


def _check_config(planned: PlannedRun, directory: Path) -> None:
    """Raise `UserError` where a finished run was driven with another config than the sweep's."""
    if (directory / CONFIG).read_text() != config_text(planned):
        raise UserError(f"{directory} was driven with another config: resume with that one, or name another --out")


def _remove_unfinished(planned: Sequence[PlannedRun], runs_dir: Path) -> None:
    """Remove the directories of killed runs, which have no result, so that these runs are driven again."""
    for each in planned:
        directory = runs_dir / each.name
        if directory.is_dir() and not is_finished(directory):
            shutil.rmtree(directory)
