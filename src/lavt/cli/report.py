"""`lavt report`: the report of runs that were driven, made again from their records."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.cli import console
from lavt.errors import UserError, WorkError
from lavt.experiment.directory import make_directory
from lavt.experiment.results import IDENTITY, read_json
from lavt.experiment.run import RESULT, compute_result


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("report")(report)


def report(
    directories: Annotated[list[Path], typer.Argument(help="Run directories, or sweep directories of runs.")],
    out: console.Out = None,
) -> None:
    """Compute the results of runs again from their records, and write summary.json and report/index.html.

    Example: lavt report out/sweep --out out/sweep
    """
    out = out or directories[0]
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is not a directory: name another with --out")
    from lavt.experiment.report import write_report  # noqa: PLC0415 (slow: scipy, matplotlib)
    from lavt.experiment.sweep import recorded_base  # noqa: PLC0415 (slow: scipy, matplotlib)

    runs = [run for directory in directories for run in _runs(directory)]
    results = [_read_result(run / RESULT) for run in runs]  # all of them, before any is written
    for run, result in zip(runs, results, strict=True):
        compute_result(run, result, result.get("digest"))
    base = recorded_base(directories[0]) if len(directories) == 1 else None
    make_directory(out)
    console.show(f"the report is {write_report(out, run_dirs=runs, base=base)}")


def _runs(directory: Path) -> list[Path]:
    """Give the run directories in `directory`, which may be one itself."""
    if (directory / RESULT).is_file():
        return [directory]
    runs = sorted(result.parent for result in directory.glob(f"runs/*/{RESULT}"))
    if not runs:
        raise UserError(f"{directory} holds no finished run: name a run directory or that of a sweep")
    return runs


def _read_result(path: Path) -> dict[str, Any]:
    """Read what a run was; raises `WorkError` where the file does not say that."""
    result = read_json(path)
    if not isinstance(result, dict):
        raise WorkError(f"{path} is not the result of a run: it holds no JSON object")
    missing = [key for key in IDENTITY if key not in result]
    if missing:
        raise WorkError(f"{path} is not the result of a run: it lacks {', '.join(missing)}")
    for key in ("axes", "injected_ms", "injected_least_ms"):
        if not isinstance(result.get(key, {}), dict):
            raise WorkError(f"{path} is not the result of a run: {key!r} is no JSON object")
    return result
