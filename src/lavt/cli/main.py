"""`lavt`: the table of commands.

Only the module of the requested command is imported, and none for the help of `lavt` itself, whose sentences are in
this table. Compared with the modules of all commands, `lavt --help` takes 0.11 of the processor time and 0.36 of the
memory (`benchmarks/start.py`, medians of five rounds).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Container, Sequence
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import lavt
from lavt.cli import console
from lavt.errors import WorkError
from lavt.operating_system import require_real_time
from lavt.runtime.parent_watch import end_with_parent

GROUPS = {
    "Try LAVT on this machine": {
        "demo": "Run the demo: show what delay does to driving by video.",
        "drive": "Drive yourself: the simulator's car, from a web page on this machine.",
        "run": "Drive one route under one network condition.",
        "replay": "Make a video of runs side by side.",
        "doctor": "Check whether this machine is ready to drive.",
    },
    "Drive a vehicle on another machine": {
        "server": "Run the vehicle's side: stream video and execute commands.",
        "client": "Run the operator's side: acquire control, arm and drive.",
        "vehicles": "List the vehicles that answer: state, who has control, and latency.",
        "stop": "Trigger an emergency stop, whoever has control, and wait until the vehicle confirms it.",
        "sdp": "Print the SDP file for watching the video in a player.",
        "watch": "Receive an RTP/H.264 stream and measure its latency.",
    },
    "Experiment": {
        "sweep": "Drive routes under network conditions and report.",
        "boundary": "Find the maximum tolerable latency.",
        "study": "Drive a study: participants, balanced conditions, tests.",
        "report": "Write a report of finished runs.",
        "compliance": "Judge the latency of finished drives by a limit.",
        "join": "Join the records of two machines into one run.",
    },
    "Network and clocks": {
        "relay": "Forward video and control with injected latency.",
        "netem": "Inject latency with tc netem (docs/netem.md).",
        "clock": "Report the error of this machine's clock.",
        "keys": "Create certificates and signing keys with a test certificate authority.",
        "router": "Run a Zenoh router until Ctrl-C.",
        "rendezvous": "Forward the video of a vehicle behind NAT to its clients.",
    },
    "Vehicle, camera and road": {
        "road": "Draw roads; import and export OpenDRIVE maps.",
        "camera": "Calibrate a camera (docs/camera.md).",
        "perception": "Inspect lane detection.",
        "software-car": "Simulate a car with a by-wire kit on a CAN bus.",
        "can": "Inspect drive-by-wire CAN buses (docs/can.md).",
        "carla": "Check a CARLA server (docs/carla.md).",
    },
}
"""All commands by what one does with them, in the order of the help, with the first sentence of their own help. The
module of a command has its name, with `_` for `-`."""

COMMANDS = {command: summary for group in GROUPS.values() for command, summary in group.items()}
"""All commands."""

ON_ANY_SYSTEM = {
    "demo",
    "run",
    "replay",
    "sweep",
    "boundary",
    "study",
    "report",
    "compliance",
    "join",
    "road",
    "perception",
    "camera",
}
"""The commands that do something without real time, and so on other systems than Linux."""


class GroupedHelp(TyperGroup):
    """The help of `lavt`, with the commands in groups."""

    def format_commands(self, _ctx: Any, formatter: Any) -> None:
        """Write the commands of each group."""
        for title, commands in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(command, COMMANDS[command]) for command in commands])


def build_app(commands: Container[str] = COMMANDS, *, has_all: bool = True) -> typer.Typer:
    """Return the command line with these commands; with `has_all`, the help also lists the others, not imported."""
    app = typer.Typer(
        name="lavt",
        cls=GroupedHelp,
        help="Measure how network latency affects vision-based teleoperation.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(global_options)
    for command, summary in COMMANDS.items():
        if command in commands:
            import_module(f"lavt.cli.{command.replace('-', '_')}").register(app)
        elif has_all:
            app.command(command, help=summary)(_not_imported)
    return app


def _not_imported() -> None:
    """Stand for a command in the help of `lavt`."""
    raise WorkError("the command has not been imported")


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


def main(on_imported: Callable[[], object] = lambda: None) -> None:
    """Run the command line and exit with the command's exit code; call `on_imported` before the command begins."""
    end_with_parent()
    console.run_command(lambda: _run(sys.argv[1:], on_imported))


def _run(words: Sequence[str], on_imported: Callable[[], object]) -> None:
    is_plain = bool(words) and words[0] in COMMANDS
    app = build_app(words[:1] if is_plain else words, has_all=not is_plain)
    if is_plain and words[0] not in ON_ANY_SYSTEM and "--help" not in words:
        require_real_time(f"lavt {words[0]}")
    on_imported()
    app()
