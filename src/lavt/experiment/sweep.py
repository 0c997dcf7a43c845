"""Many runs on all cores, and their summary and report. A run that fails is told and does not stop the others."""

from __future__ import annotations

import functools
import itertools
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from lavt.clock import MachineClock
from lavt.config import RunConfig, SweepConfig
from lavt.config_file import load_config
from lavt.domain import NS_PER_S
from lavt.errors import LavtError, UserError, WorkError
from lavt.experiment.directory import prepare_directory
from lavt.experiment.plan import PlannedRun, plan_sweep
from lavt.experiment.report import write_report
from lavt.experiment.results import read_json
from lavt.experiment.run import CONFIG, RESULT, config_text, run_once

SWEEP = "sweep.yaml"
"""The whole config of a sweep, in its directory."""

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Driven:
    """Results of a sweep's runs, and the names of those that failed with the reason."""

    results: Sequence[dict[str, Any]]
    failed: Sequence[tuple[str, str]]


def run_all(
    planned: Sequence[PlannedRun], runs_dir: Path, *, jobs: int | None, tell: Tell
) -> tuple[Driven, dict[str, Any] | None]:
    """Drive the runs that have no result yet, `jobs` at a time (None: one a core), those in real time one by one.

    Returns the results, those of runs that were driven before among them, and the entry `speed` of the summary: of the
    virtual runs that were driven now, None where there were none.
    """
    jobs = jobs or os.cpu_count() or 1
    clock = MachineClock()
    start_ns = clock.now().mono_ns
    results: list[dict[str, Any]] = []
    failed: list[tuple[str, str]] = []
    todo = []
    for each in planned:
        finished = runs_dir / each.name / RESULT
        if finished.is_file():
            results.append(read_json(finished))
        else:
            todo.append(each)
    before = len(results)
    jobs = 1 if any(each.config.time == "real" for each in todo) else jobs
    context = multiprocessing.get_context("spawn")  # a fork copies locks that nobody will ever release
    ignore = (signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all processes of a terminal; only this one decides
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=signal.signal, initargs=ignore) as executor:
        futures = {executor.submit(run_once, each, runs_dir / each.name): each for each in todo}
        try:
            for future in as_completed(futures):
                name = futures[future].name
                try:
                    result = future.result()
                    results.append(result)
                    tell(f"{name}: {result['ending']}")
                except Exception as error:  # whatever it is, the other runs have nothing to do with it
                    why = str(error) if isinstance(error, LavtError) else f"{type(error).__name__}: {error}"
                    failed.append((name, why))
                    tell(f"{name} failed: {why}")
        except KeyboardInterrupt:
            executor.shutdown(wait=True, cancel_futures=True)  # what is under way is finished, and kept
            raise
    simulated = [result for result in results[before:] if result["time"] == "virtual"]
    if not simulated:
        return Driven(results, failed), None
    speed = {
        "simulated_s": sum(result["duration_s"] or 0.0 for result in simulated),
        "wall_s": (clock.now().mono_ns - start_ns) / NS_PER_S,
        "jobs": jobs,
    }
    return Driven(results, failed), speed


def open_sweep(out: Path, *, resume: bool) -> None:
    """Make the directory of a sweep or, to resume one, find it; raises `UserError` where that cannot be."""
    if resume and not out.is_dir():
        raise UserError(f"there is nothing to resume in {out}: leave --resume away to begin")
    if not resume:
        prepare_directory(out)


def sweep(
    config: SweepConfig, planned: Sequence[PlannedRun], out: Path, *, jobs: int | None, tell: Tell
) -> tuple[Path, Driven]:
    """Drive what is missing of a sweep into `out`, and write its config, summary and report.

    `planned` are the runs of `config`. Returns the report's page, and what was driven.
    """
    runs_dir = out / "runs"
    runs_dir.mkdir(exist_ok=True)
    for each in planned:
        if (runs_dir / each.name / RESULT).is_file():
            _check_config(each, runs_dir / each.name)
    (out / SWEEP).write_text(yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False))
    _remove_unfinished(planned, runs_dir)
    driven, speed = run_all(planned, runs_dir, jobs=jobs, tell=tell)
    if not driven.results:
        raise WorkError("no run was finished: " + "; ".join(f"{name}: {why}" for name, why in driven.failed))
    return write_report(out, speed=speed, base=base_of(config, planned)), driven


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


def _check_config(planned: PlannedRun, directory: Path) -> None:
    """Raise `UserError` where a finished run was driven with another config than the sweep now asks for."""
    if (directory / CONFIG).read_text() != config_text(planned):
        raise UserError(f"{directory} was driven with another config: resume with that one, or name another --out")


def _remove_unfinished(planned: Sequence[PlannedRun], runs_dir: Path) -> None:
    """A run that was killed left a directory without a result: it is driven again, from an empty one."""
    for each in planned:
        directory = runs_dir / each.name
        if directory.is_dir() and not (directory / RESULT).is_file():
            for file in directory.iterdir():
                file.unlink()
            directory.rmdir()
