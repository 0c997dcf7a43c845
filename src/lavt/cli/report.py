"""`lavt report`: write the report of finished runs from their records."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.cli import console
from lavt.cli.run_directories import find_runs, sweep_names
from lavt.errors import UserError, WorkError
from lavt.experiment.analysis.results import read_failed, read_result
from lavt.experiment.runs.run import RESULT, compute_result
from lavt.recording.output_directory import disk_errors_named, make_directory


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("report")(report)


def report(
    directories: Annotated[list[Path], typer.Argument(help="Directories of runs, of sweeps, and of `lavt boundary`.")],
    out: console.OutOption = None,
) -> None:
    """Write a report of finished runs.

    The command computes the results from the records again, and writes summary.json and report/index.html. Of several
    sweeps, it also prints completed runs and cross-track errors side by side, by route and condition.

    Example: lavt report out/paper out/designed --out out/both
    """
    out = out or directories[0]
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is not a directory: name another with --out")
    from lavt.experiment.boundary.boundary_files import BOUNDARY  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.report.report import write_report  # noqa: PLC0415 (slow: scipy, matplotlib)
    from lavt.experiment.report.side_by_side import side_by_side  # noqa: PLC0415 (the same)

    searched = [directory for directory in directories if (directory / BOUNDARY).is_file()]
    boundaries = [_read_boundary(directory) for directory in searched]
    found_runs = {directory: find_runs(directory) for directory in directories if directory not in searched}
    if not found_runs:
        raise UserError(f"{directories[0]} has a boundary but no runs: name the directory of a sweep, too")
    runs = [run for runs_in_directory in found_runs.values() for run in runs_in_directory]
    results = [read_result(run / RESULT) for run in runs]  # all are read before any is written
    computed = {
        run: compute_result(run, result, result.get("digest")) for run, result in zip(runs, results, strict=True)
    }
    names = sweep_names(list(found_runs))
    sweeps = {run: name for directory, name in names.items() for run in found_runs[directory]}
    make_directory(out)
    failed = [run for directory in found_runs for run in read_failed(directory)]
    base = _base_config(list(found_runs), names)
    answers = _read_answers(list(found_runs), names)
    with disk_errors_named(out):
        page = write_report(
            out, run_dirs=runs, base=base, sweeps=sweeps, boundaries=boundaries, failed=failed, answers=answers
        )
    if names:
        for line in side_by_side({name: [computed[run] for run in found_runs[at]] for at, name in names.items()}):
            console.print_result(line)
    console.print_result(f"the report is {page}")


def _base_config(directories: Sequence[Path], names: dict[Path, str]) -> dict[str, Any] | None:
    """Return the base config by which the report groups its runs: that of the first sweep; None without a sweep.

    If there are several sweeps (`names`), the result also contains the name of the first sweep.
    """
    from lavt.experiment.sweep.sweep import recorded_base  # noqa: PLC0415 (slow: scipy, matplotlib)

    first = next((directory for directory in directories if not (directory / RESULT).is_file()), None)
    if first is None:
        return None
    base = recorded_base(first)
    return {**(base or {}), "sweep": names[first]} if first in names else base


def _read_answers(directories: Sequence[Path], names: dict[Path, str]) -> list[dict[str, Any]]:
    """Return the answers of the participants of all studies; of several sweeps, each has the name of its sweep."""
    from lavt.experiment.study.answers import read_answers  # noqa: PLC0415 (slow: scipy, matplotlib)

    return [
        {**entry, **({"sweep": names[directory]} if directory in names else {})}
        for directory in directories
        for entry in read_answers(directory)
    ]


def _read_boundary(directory: Path) -> dict[str, Any]:
    from lavt.experiment.boundary.boundary_files import read_results  # noqa: PLC0415 (slow: scipy)

    boundary = read_results(directory)
    if not boundary["runs"]:
        raise WorkError(f"no search in {directory} was finished: continue with `lavt boundary --resume`")
    return boundary
