"""Many runs on all cores, and their summary and report. A run that fails is told and does not stop the others."""

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
from lavt.errors import UserError, WorkError, in_words
from lavt.experiment.analysis.drive_data import DriveData, read_drive
from lavt.experiment.analysis.results import FAILED, read_json, write_json
from lavt.experiment.runs.plan import PlannedRun, plan_sweep
from lavt.experiment.runs.run import CONFIG, RESULT, config_text
from lavt.experiment.sweep.cluster import cluster
from lavt.experiment.sweep.workers import Workers, processes
from lavt.recording.output_directory import prepare_directory

SWEEP = "sweep.yaml"
"""The whole config of a sweep, in its directory."""

ProgressCallback = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class SweepResult:
    """Results of a sweep's runs, the drives that were driven now, and which failed, with the reason."""

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
    """Drive the runs that have no result yet, `jobs` at a time (None: one a core), those in real time one by one.

    With `cluster_address` they are driven by Dask's workers there. Returns the results, those of runs that were driven
    before among them, and the entry `speed` of the summary: of the virtual runs that were driven now, None where there
    were none.
    """
    clock = MachineClock()
    start_ns = clock.now().mono_ns
    before = [read_json(runs_dir / each.name / RESULT) for each in planned if is_finished(runs_dir / each.name)]
    todo = [each for each in planned if not is_finished(runs_dir / each.name)]
    work = _SweepProgress(runs_dir, on_progress)
    if cluster_address is None:
        jobs = 1 if any(each.config.time == "real" for each in todo) else jobs or os.cpu_count() or 1
        _drive_in_processes(work, todo, jobs)
    elif todo:
        with cluster(cluster_address, jobs) as workers:
            jobs = workers.jobs
            work.drive(workers, todo)
    results = [drive.result for drive in work.drives]
    simulated = [result for result in results if result["time"] == "virtual"]
    driven = SweepResult([*before, *results], work.drives, work.failed)
    if not simulated:
        return driven, None
    speed = {
        "simulated_s": sum(result["duration_s"] or 0.0 for result in simulated),
        "wall_s": (clock.now().mono_ns - start_ns) / NS_PER_S,
        "jobs": jobs,
    }
    return driven, speed


def is_finished(directory: Path) -> bool:
    """Whether a run was driven to its end, however that was."""
    return (directory / RESULT).is_file()


class _SweepProgress:
    """What has become of the runs so far."""

    def __init__(self, runs_dir: Path, on_progress: ProgressCallback) -> None:
        self.drives: list[DriveData] = []
        self.failed: list[tuple[str, str]] = []
        self.runs_dir = runs_dir
        self._on_progress = on_progress

    def drive(self, workers: Workers, todo: Sequence[PlannedRun]) -> list[PlannedRun]:
        """Have runs driven; give those that were not, because a worker's process died."""
        futures = {workers.submit(each, self.runs_dir / each.name): each for each in todo}
        broken = []
        # With matplotlib and SciPy it takes long: the others drive already. Not in the main thread: where Ctrl-C finds
        # Python executing a string, as it does to define a dataclass, `python -m` dies of it although it was handled.
        threading.Thread(target=import_module, args=("lavt.experiment.report.report",)).start()
        try:
            for future in as_completed(list(futures)):
                planned = futures.pop(future)  # with it goes what it gave: a run's files, where they came from far
                try:
                    drive = workers.collect(future.result(), self.runs_dir / planned.name)
                except BrokenExecutor:
                    broken.append(planned)
                except Exception as error:  # whatever it is, the other runs have nothing to do with it
                    self.fail(planned, in_words(error))
                else:
                    self.take(planned, drive)
        except KeyboardInterrupt:
            workers.stop()
            _remove_unfinished(todo, self.runs_dir)  # files that came from far may be there in part
            raise
        return broken

    def take(self, planned: PlannedRun, drive: DriveData) -> None:
        """Note a drive."""
        self.drives.append(drive)
        self._on_progress(f"{planned.name}: {drive.result['ending']}")

    def fail(self, planned: PlannedRun, why: str) -> None:
        """Note that a run failed."""
        self.failed.append((planned.name, why))
        self._on_progress(f"{planned.name} failed: {why}")


def _drive_in_processes(work: _SweepProgress, todo: Sequence[PlannedRun], jobs: int) -> None:
    """Drive, also when a process dies, which takes the pool with it: what it was at is driven again, alone."""
    while todo:
        with processes(jobs) as workers:
            broken = work.drive(workers, todo)
        begun = [each for each in broken if (work.runs_dir / each.name).exists()]
        _remove_unfinished(broken, work.runs_dir)
        for each in begun:
            directory = work.runs_dir / each.name
            if is_finished(directory):  # its process died after it
                work.take(each, read_drive(directory, read_json(directory / RESULT)))
                continue
            with processes(1) as alone:
                if work.drive(alone, [each]):
                    work.fail(each, "the process that drove it died, twice")
        todo = [each for each in broken if each not in begun]
        if todo and not begun:
            for each in todo:
                work.fail(each, "the processes that were to drive it died before they began")
            return


def open_sweep(out: Path, *, resume: bool) -> None:
    """Make the directory of a sweep or, to resume one, find it; raises `UserError` where that cannot be."""
    if resume and not out.is_dir():
        raise UserError(f"there is nothing to resume in {out}: leave --resume away to begin")
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
    """Drive what is missing of a sweep into `out`, and write its config, summary and report.

    `planned` are the runs of `config`; `cluster_address` is that of `run_all`. Returns the report's page, and what was
    driven. Runs that failed are in `out`/failed.json, and in summary and report.
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
    failed = [{"run": name, "reason": why} for name, why in driven.failed]
    write_json(out / FAILED, failed)
    if not driven.results:
        raise WorkError("no run was finished: " + "; ".join(f"{name}: {why}" for name, why in driven.failed))
    from lavt.experiment.report.report import write_report  # noqa: PLC0415 (slow: see `_SweepProgress.drive`)

    drives = {drive.directory: drive for drive in driven.drives}
    return write_report(out, speed=speed, base=base_of(config, planned), drives=drives, failed=failed), driven


def base_of(config: SweepConfig, planned: Sequence[PlannedRun]) -> dict[str, Any]:
    """Tell what the runs of a sweep's base config have in common: the value of each further axis that it has itself.

    Where the base config has another value than those of the axis, it is that one, and no run is of the base config.
    """
    base = {key: _value_at(config, key) for key in config.axes}
    for run, key in itertools.product(planned, config.axes):
        if _value_at(run.config, key) == _value_at(config, key):
            base[key] = run.identity["axes"][key]  # as the axis writes it: 20 or 20.0, a section or a part of it
    return base


def recorded_base(out: Path) -> dict[str, Any] | None:
    """Tell `base_of` of the sweep that was driven into `out`; None where no sweep left its config there."""
    if not (out / SWEEP).is_file():
        return None
    config = load_config(SweepConfig, out / SWEEP)
    return base_of(config, plan_sweep(config))


def _value_at(config: RunConfig, key: str) -> Any:
    return functools.reduce(lambda section, name: section[name], key.split("."), config.model_dump(mode="json"))


def _check_sweep(config: SweepConfig, out: Path) -> None:
    """Raise `UserError` where another sweep was begun in `out`: the report would mix the runs of both."""
    if not (out / SWEEP).is_file():
        return
    begun, requested = (each.model_dump(mode="json") for each in (load_config(SweepConfig, out / SWEEP), config))
    different = [key for key in requested if requested[key] != begun[key]]
    if different:
        raise UserError(
            f"{out} was begun with another config ({', '.join(different)}): resume with that one, or name another --out"
        )


def _check_config(planned: PlannedRun, directory: Path) -> None:
    """Raise `UserError` where a finished run was driven with another config than the sweep now asks for."""
    if (directory / CONFIG).read_text() != config_text(planned):
        raise UserError(f"{directory} was driven with another config: resume with that one, or name another --out")


def _remove_unfinished(planned: Sequence[PlannedRun], runs_dir: Path) -> None:
    """A run that was killed left a directory without a result: it is driven again, from an empty one."""
    for each in planned:
        directory = runs_dir / each.name
        if directory.is_dir() and not is_finished(directory):
            shutil.rmtree(directory)
