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
    help="Measures what network delay does to driving by video.",
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


def _version(wanted: bool) -> None:
    if wanted:
        console.show(f"lavt {lavt.__version__}")
        raise typer.Exit


@app.callback()
def common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Measures what network delay does to driving by video."""


def main() -> None:
    """Run the command line; the exit code is that of the command."""
    console.run_command(app)
