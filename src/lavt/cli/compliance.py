"""`lavt compliance`: judge the latency of finished drives by a limit, from their records."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.cli import console
from lavt.cli.run_directories import find_runs, sweep_names
from lavt.errors import UserError
from lavt.experiment.analysis.results import read_failed
from lavt.experiment.compliance.criteria import CRITERIA, ComplianceLimits, parse_thresholds
from lavt.recording.output_directory import disk_errors_named, make_directory

FOLDER = "compliance"
"""The directory with the report in the output directory."""
DEFAULTS = ComplianceLimits()


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("compliance")(compliance)


def compliance(
    directories: Annotated[list[Path], typer.Argument(help="Directories of runs and of sweeps.")],
    limit_ms: Annotated[float, typer.Option(help="Latency limit in ms.")] = DEFAULTS.latency_ms,
    outage_ms: Annotated[
        float, typer.Option(help="An outage begins when no command from a newer frame arrived for longer, in ms.")
    ] = DEFAULTS.outage_ms,
    nominal_kmh: Annotated[
        float | None,
        typer.Option(help="Allowed speed while the latency is within the limit. Default: the run's speed limit."),
    ] = None,
    camera_ms: Annotated[
        float | None,
        typer.Option(help="Largest time from exposure to stamp of a camera that does not report the exposure."),
    ] = None,
    threshold: Annotated[
        list[str] | None,
        typer.Option(help=f"Largest allowed value of a criterion, as KEY=NUMBER: {', '.join(CRITERIA)}; repeatable."),
    ] = None,
    out: console.OutOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """Judge the latency of finished drives by a limit.

    The command reads the records, and writes compliance/index.html, compliance.csv and compliance.json: the time above
    the limit, outages, minimal-risk manoeuvres, and speed compared with what the latency allowed, each with bounds and
    a verdict. It is a measurement and no certification.

    Example: lavt compliance out/paper --limit-ms 250 --threshold above_share=0.01
    """
    limits = ComplianceLimits(
        latency_ms=limit_ms,
        outage_ms=outage_ms,
        nominal_mps=None if nominal_kmh is None else nominal_kmh / 3.6,
        camera_ms=camera_ms,
        thresholds=parse_thresholds(threshold or []),
    )
    out = (out or directories[0]) / FOLDER
    if any(parent.exists() and not parent.is_dir() for parent in (out, *out.parents)):
        raise UserError(f"{out} is not a directory: name another with --out")
    names = sweep_names(directories)
    found = {directory: find_runs(directory) for directory in directories}
    runs = list({run.resolve(): run for inside in found.values() for run in inside}.values())
    sweeps = {run: names[directory] for directory, inside in found.items() if directory in names for run in inside}
    failed = [run for directory in directories for run in read_failed(directory)]
    from lavt.experiment.compliance.compliance import evaluate_fleet, write_compliance  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.compliance.sentences import finding_sentences  # noqa: PLC0415 (the same)

    fleet = evaluate_fleet(runs, limits, sweeps=sweeps, failed=failed)
    make_directory(out)
    with disk_errors_named(out):
        page = write_compliance(fleet, out)
    if as_json:
        console.print_json(fleet.content())
        return
    for line in finding_sentences(fleet.content()):
        console.print_result(line)
    console.print_result(f"the report is {page}")
