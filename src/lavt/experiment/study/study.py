"""The directory of a study: check it, drive the runs by a model of a driver, and write the report."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import yaml

from lavt.config import StudyConfig
from lavt.errors import UserError, WorkError
from lavt.experiment.analysis.drive_data import DriveData
from lavt.experiment.analysis.results import FAILED, read_failed, read_result, write_json
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.run import RESULT
from lavt.experiment.study.answers import has_answers, read_answers, write_answers
from lavt.experiment.study.study_plan import Block, check_order
from lavt.experiment.sweep.sweep import (
    ProgressCallback,
    SweepResult,
    check_recorded_config,
    check_run_config,
    remove_all_unfinished,
    run_all,
)
from lavt.experiment.sweep.workers import is_finished
from lavt.recording.output_directory import prepare_directory, replace_text

STUDY = "study.yaml"
"""The file with the complete config of a study, in the study's directory."""
NOT_ASKED = "not asked: {driver} drove, not a person"


def open_study(config: StudyConfig, blocks: Sequence[Block], out: Path) -> int:
    """Create the directory of a study, or check that its files agree with `config`; return the number of runs to drive.

    Raises `UserError` if `out` has another study, runs that are not in the plan, damaged files, or anything else.
    """
    if not os.path.isfile(out / STUDY):  # noqa: PTH113 (`Path.is_file` raises for a directory that cannot be read)
        prepare_directory(out)
    check_recorded_config(config, out / STUDY)
    check_order(blocks, out / "runs")
    runs = [run for block in blocks for run in block.runs]
    for run in runs:
        _check_run(run, out / "runs" / run.name)
    read_answers(out)
    return sum(not is_finished(out / "runs" / run.name) for run in runs)


def _check_run(run: PlannedRun, directory: Path) -> None:
    """Raise `UserError` if the planned run is finished, but its files are damaged or those of another run."""
    remedy = "restore its files, or remove it, to drive it again"
    if not is_finished(directory):
        return
    try:
        check_run_config(run, directory)
        result = read_result(directory / RESULT)
    except (OSError, ValueError, WorkError) as error:
        raise UserError(f"{directory} cannot be read ({error}): {remedy}") from error
    if any(result[key] != run.identity.get(key) for key in ("run", "condition", "participant")):
        raise UserError(f"{directory} has the result of another run: {remedy}")


def begin_study(config: StudyConfig, out: Path) -> None:
    """Write the config of a study into its directory; call `open_study` first."""
    (out / "runs").mkdir(exist_ok=True)
    replace_text(out / STUDY, yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False))


def drive_study(blocks: Sequence[Block], out: Path, *, jobs: int | None, on_progress: ProgressCallback) -> SweepResult:
    """Drive the runs of `blocks` that are not finished by the configured controller, and return all their results.

    The runs have no effect on each other, because a model learns nothing, so `jobs` of them are driven at the same
    time. Failed runs are listed in `out`/failed.json.
    """
    runs_dir = out / "runs"
    planned = [run for block in blocks for run in block.runs]
    remove_all_unfinished(planned, runs_dir)
    result, _ = run_all(planned, runs_dir, jobs=jobs, on_progress=on_progress)
    write_json(out / FAILED, [{"run": name, "reason": reason} for name, reason in result.failed])
    if not result.results:
        raise WorkError("no run was finished: " + "; ".join(f"{name}: {reason}" for name, reason in result.failed))
    for block in blocks:
        is_over = all(is_finished(runs_dir / run.name) for run in block.runs)
        if is_over and not has_answers(out, block):
            write_answers(out, block, None, NOT_ASKED.format(driver=block.runs[0].identity["driver"]))
    return result


def report_study(out: Path, drives: Sequence[DriveData] = ()) -> Path:
    """Write the report of all finished runs in `out`, and return its page; `drives` has data that need not be read."""
    from lavt.experiment.report.report import write_report  # noqa: PLC0415 (slow: matplotlib)

    by_directory = {drive.directory: drive for drive in drives}
    return write_report(out, drives=by_directory, failed=read_failed(out), answers=read_answers(out))
