"""`lavt`: the table of commands."""

from __future__ import annotations

from typing import Annotated

import typer

import lavt
from lavt.cli import (
    boundary,
    can,
    client,
    clock,
    console,
    demo,
    doctor,
    join,
    keys,
    netem,
    perception,
    relay,
    rendezvous,
    report,
    road,
    router,
    run,
    sdp,
    server,
    software_car,
    stop,
    sweep,
    watch,
)

app = typer.Typer(
    name="lavt",
    help="Measure how network latency affects vision-based teleoperation.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
COMMANDS = (
    demo,
    run,
    sweep,
    boundary,
    report,
    join,
    road,
    perception,
    server,
    software_car,
    client,
    sdp,
    watch,
    stop,
    router,
    keys,
    relay,
    rendezvous,
    netem,
    can,
    clock,
    doctor,
)
for command in COMMANDS:
    command.register(app)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        console.print_result(f"lavt {lavt.__version__}")
        raise typer.Exit


@app.callback()
def global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Measure how network latency affects vision-based teleoperation."""


def main() -> None:
    """Run the command line and exit with the command's exit code."""
    console.run_command(app)
