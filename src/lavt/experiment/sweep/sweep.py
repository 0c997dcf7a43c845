"""Sweeps: many runs on all cores, and their summary and report. A failed run is listed and does not stop the others."""

from __future__ import annotations

import functools
import itertools
import os
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
from lavt.experiment.analysis.drive_data import DriveData
from lavt.experiment.analysis.results import FAILED, read_json, write_json
from lavt.experiment.runs.netem_run import restore_abandoned
from lavt.experiment.runs.plan import PlannedRun, plan_sweep
from lavt.experiment.runs.remote_run import RemoteServer
from lavt.experiment.runs.run import CONFIG, RESULT, config_text, drive_once
from lavt.experiment.sweep.cluster import cluster_workers
from lavt.experiment.sweep.workers import (
    DriveRun,
    Workers,
    attempt_in_processes,
    drives_alone,
    is_finished,
    remove_unfinished,
)
from lavt.recording.output_directory import replace_text

SWEEP = "sweep.yaml"
"""The file with the complete config of a sweep, in the sweep's directory."""

ProgressCallback = Callable[[str], None]
"""A callback that shows one line of progress."""


@dataclass(frozen=True, slots=True)
class SweepResult:
    """The results of a sweep's runs.

    `results` has all runs, including those of earlier calls, `drives` the data of the runs that this call drove, and
    `failed` the names of the failed runs with their reasons.
    """

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
    server: RemoteServer | None = None,
) -> tuple[SweepResult, dict[str, Any] | None]:
    """Drive the runs that have no result yet, `jobs` at a time (None: one per core), or one by one in real time.

    With `cluster_address`, the Dask workers of that scheduler drive the runs. With `server`, that server drives the
    vehicle. Returns all results, including those of
    earlier calls, and the entry `speed` of the summary. This entry is about the runs in virtual time of this call; it
    is None without such runs.
    """
    clock = MachineClock()
    start_ns = clock.now().mono_ns
    earlier = [read_json(runs_dir / run.name / RESULT) for run in planned if is_finished(runs_dir / run.name)]
    todo = [run for run in planned if not is_finished(runs_dir / run.name)]
    progress = _SweepProgress(runs_dir, on_progress, drive_once if server is None else server.drive)
    if cluster_address is None:
        jobs = 1 if any(drives_alone(run.config) for run in todo) else jobs or os.cpu_count() or 1
        try:
            for run in attempt_in_processes(progress.drive, todo, jobs):
                progress.fail(run, "each of the processes that drove it died")
        finally:
            for message in restore_abandoned(todo):  # a second Ctrl-C kills the processes
                on_progress(message)
    elif todo:
        with cluster_workers(cluster_address, jobs) as workers:
            jobs = workers.jobs
            progress.drive(workers, todo)
    results = [drive.result for drive in progress.drives]
    simulated = [result for result in results if result["time"] == "virtual"]
    sweep_result = SweepResult([*earlier, *results], progress.drives, progress.failed)
    if not simulated:
        return sweep_result, None
    speed = {
        "simulated_s": sum(result["duration_s"] or 0.0 for result in simulated),
        "wall_s": (clock.now().mono_ns - start_ns) / NS_PER_S,
        "jobs": jobs,
    }
    return sweep_result, speed


class _SweepProgress:
    """The finished and the failed runs of a sweep so far."""

    def __init__(self, runs_dir: Path, on_progress: ProgressCallback, drive_run: DriveRun) -> None:
        self.drives: list[DriveData] = []
        self.failed: list[tuple[str, str]] = []
        self.runs_dir = runs_dir
        self._on_progress = on_progress
        self._drive_run = drive_run

    def drive(self, workers: Workers, todo: Sequence[PlannedRun]) -> list[PlannedRun]:
        """Drive the runs `todo`; return the ones that have no result because a worker's process died."""
        futures = {workers.submit(run, self.runs_dir / run.name, self._drive_run): run for run in todo}
        broken = []
        # The import of matplotlib and SciPy takes long, so it is done during the drives. It is not done in the main
        # thread, because it executes strings (of dataclasses): if Ctrl-C interrupts such an execution, `python -m` dies
        # even if the program handles the interrupt.
        threading.Thread(target=import_module, args=("lavt.experiment.report.report",)).start()
        try:
            for future in as_completed(list(futures)):
                planned = futures.pop(future)  # so that the result, which has the files of a remote run, is freed
                try:
                    drive = workers.collect(future.result(), self.runs_dir / planned.name)
                except BrokenExecutor:
                    broken.append(planned)
                except Exception as error:  # an error of one run does not end the others
                    self.fail(planned, describe_error(error))
                else:
                    self.take(planned, drive)
        except KeyboardInterrupt:
            workers.stop()
            remove_all_unfinished(todo, self.runs_dir)  # the files of remote runs can be incomplete
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


def drive_sweep(
    config: SweepConfig,
    planned: Sequence[PlannedRun],
    out: Path,
    *,
    jobs: int | None,
    on_progress: ProgressCallback,
    cluster_address: str | None = None,
    server: RemoteServer | None = None,
) -> tuple[Path, SweepResult]:
    """Drive the missing runs of a sweep into `out`, and write its config, summary and report.

    `planned` are the runs of `config`; `cluster_address` and `server` are passed to `run_all`. Returns the path of the
    report's page, and the results. Failed runs are listed in `out`/failed.json, in the summary and in the report.
    """
    check_recorded_config(config, out / SWEEP)
    runs_dir = out / "runs"
    runs_dir.mkdir(exist_ok=True)
    for run in planned:
        check_run_config(run, runs_dir / run.name)
    replace_text(out / SWEEP, yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False))
    remove_all_unfinished(planned, runs_dir)
    sweep_result, speed = run_all(
        planned, runs_dir, jobs=jobs, on_progress=on_progress, cluster_address=cluster_address, server=server
    )
    failed = [{"run": name, "reason": reason} for name, reason in sweep_result.failed]
    write_json(out / FAILED, failed)
    if not sweep_result.results:
        raise WorkError(
            "no run was finished: " + "; ".join(f"{name}: {reason}" for name, reason in sweep_result.failed)
        )
    from lavt.experiment.report.report import write_report  # noqa: PLC0415 (slow: see `_SweepProgress.drive`)

    drives = {drive.directory: drive for drive in sweep_result.drives}
    return write_report(out, speed=speed, base=base_of(config, planned), drives=drives, failed=failed), sweep_result


def base_of(config: SweepConfig, planned: Sequence[PlannedRun]) -> dict[str, Any]:
    """Return the value of each further axis in the sweep's base config, which is the config without its axes.

    These values identify the runs of the base config. If such a value is not among the values of its axis, the sweep
    has no run of the base config.
    """
    base = {key: _value_at(config, key) for key in config.axes}
    for run, key in itertools.product(planned, config.axes):
        if _value_at(run.config, key) == _value_at(config, key):
            base[key] = run.identity["axes"][key]  # in the form of the axis: 20 or 20.0, a whole section or a part
    return base


def recorded_base(out: Path) -> dict[str, Any] | None:
    """Return `base_of` for the sweep whose config is in `out`; None if there is no such config."""
    if not (out / SWEEP).is_file():
        return None
    config = load_config(SweepConfig, out / SWEEP)
    return base_of(config, plan_sweep(config))


def _value_at(config: RunConfig, key: str) -> Any:
    return functools.reduce(lambda section, name: section[name], key.split("."), config.model_dump(mode="json"))


def check_recorded_config(config: RunConfig, path: Path) -> None:
    """Raise `UserError` if `path` has another config, because a report would mix the runs of both configs."""
    if not path.is_file():
        return
    recorded, requested = (loaded.model_dump(mode="json") for loaded in (load_config(type(config), path), config))
    different = [key for key in requested if requested[key] != recorded[key]]
    if different:
        raise UserError(
            f"{path.parent} was begun with another config ({', '.join(different)}): use that config, or name another "
            "--out"
        )


def check_run_config(planned: PlannedRun, directory: Path) -> None:
    """Raise `UserError` if the run in `directory` is finished, but was driven with another config than the planned."""
    if is_finished(directory) and (directory / CONFIG).read_text() != config_text(planned):
        raise UserError(f"{directory} was driven with another config: use that config, or name another --out")


def remove_all_unfinished(planned: Sequence[PlannedRun], runs_dir: Path) -> None:
    """Remove the directories of runs without a result, so that these runs are driven again."""
    for run in planned:
        remove_unfinished(runs_dir / run.name)
