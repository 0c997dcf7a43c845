"""`lavt study`: drive a study with participants, in a balanced order of the conditions."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.cli import console
from lavt.cli.progress import progress
from lavt.config import StudyConfig
from lavt.config_file import load_config
from lavt.experiment.analysis.results import read_json


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("study")(study)


def study(
    config: Annotated[Path, typer.Argument(help="A study config in YAML, such as configs/study.yaml.")],
    participant: Annotated[
        int | None, typer.Option(metavar="NUMBER", help="The participant who drives; default: all.")
    ] = None,
    changes: console.SetOption = None,
    out: console.OutOption = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Number of parallel runs; default: one per core.")] = None,
    shows_plan: Annotated[bool, typer.Option("--plan", help="Print the order of the conditions and drive nothing.")] = (
        False
    ),
    as_json: console.JsonOption = False,
) -> None:
    """Drive a study: participants, balanced conditions, tests.

    Every participant drives all routes under all conditions. A model of a human driver stands in for the person. The
    same command continues a stopped study, and adds participants to it.

    Example: lavt study configs/study.yaml --participant 1 --out out/study
    """
    from lavt.experiment.study.study import drive_study, open_study  # noqa: PLC0415 (slow: scipy)
    from lavt.experiment.study.study_plan import plan_participant  # noqa: PLC0415 (slow: scipy)

    settings = load_config(StudyConfig, config, changes or [])
    participants = range(1, settings.participants + 1) if participant is None else [participant]
    blocks = [block for number in participants for block in plan_participant(settings, number)]
    if shows_plan:
        orders = {number: [b.condition for b in blocks if b.participant == number] for number in participants}
        if as_json:
            console.print_json(orders)
        else:
            for number, order in orders.items():
                console.print_result(f"participant {number}: {', '.join(order)}")
        return
    out = out or Path("out") / "study"
    remaining = open_study(settings, blocks, out)
    with console.interruptible(), progress(f"study, results in {out}", remaining) as report_done:
        page, result = drive_study(settings, blocks, out, jobs=jobs, on_progress=report_done)
    for name, reason in result.failed:
        console.print_message(f"failed: {name}: {reason}")
    if as_json:
        console.print_json(read_json(out / "study.json"))
    else:
        console.print_result(f"the report is {page}")
    if result.failed:
        raise typer.Exit(1)
