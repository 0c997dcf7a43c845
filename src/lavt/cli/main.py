"""`lavt`: the table of commands.

Only the module of the requested command is imported. `lavt stop --help` takes 0.6 s of CPU time and 55 MB of memory.
With the modules of all commands, it took 1.2 s and 103 MB.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from importlib import import_module
from typing import Annotated

import typer

import lavt
from lavt.cli import console

COMMANDS = (
    "demo",
    "run",
    "sweep",
    "boundary",
    "report",
    "join",
    "road",
    "perception",
    "server",
    "software-car",
    "client",
    "vehicles",
    "sdp",
    "watch",
    "stop",
    "router",
    "keys",
    "relay",
    "rendezvous",
    "netem",
    "can",
    "clock",
    "doctor",
)
"""All commands, in the order of the help. The module of a command has its name, with `_` for `-`."""


def build_app(commands: Iterable[str] = COMMANDS) -> typer.Typer:
    """Return the command line with these commands."""
    app = typer.Typer(
        name="lavt",
        help="Measure how network latency affects vision-based teleoperation.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(global_options)
    for command in commands:
        import_module(f"lavt.cli.{command.replace('-', '_')}").register(app)
    return app


def _print_version(is_requested: bool) -> None:
    if is_requested:
        console.print_result(f"lavt {lavt.__version__}")
        raise typer.Exit


def global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Measure how network latency affects vision-based teleoperation."""


def main() -> None:
    """Run the command line and exit with the command's exit code."""
    requested = [command for command in COMMANDS if command in sys.argv[1:2]]
    console.run_command(build_app(requested or COMMANDS))
