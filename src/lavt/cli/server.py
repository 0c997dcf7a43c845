"""`lavt server`: the vehicle's side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.side import open_server
from lavt.cli import console
from lavt.cli.side import run_side
from lavt.clock import MachineClock
from lavt.config import ServerConfig
from lavt.config_file import build_config, load_config
from lavt.runtime import process_priority


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("server")(server)


def server(
    config: Annotated[
        Path | None,
        typer.Argument(help="A server config in YAML, such as configs/server.yaml; default: the simulator, plain."),
    ] = None,
    out: console.OutOption = None,
    changes: console.SetOption = None,
    once: Annotated[bool, typer.Option("--once", help="Exit when the first drive has ended.")] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Run the vehicle's side: stream video and execute commands.

    The server executes the commands of the client that has control. If no valid command arrives, it stops the vehicle.
    With experiment.remote_runs it drives the runs that `lavt sweep --server` requests.

    Without a config, the vehicle is the built-in simulator, and nothing is encrypted or signed.

    Example: lavt server configs/server.yaml --out out/server
    """
    console.reserve_stdout()
    process_priority.raise_priority()
    if config is None:
        settings = build_config(ServerConfig, {}, changes or [], "the default config")
        console.print_message(
            f"lavt: default settings, vehicle: {settings.vehicle.kind}; drive it with `lavt client HOST`; HOST is "
            "the address of this machine"
        )
    else:
        settings = load_config(ServerConfig, config, changes or [])
    if settings.experiment.remote_runs:
        from lavt.cli.serve_runs import serve_runs  # noqa: PLC0415 (a server of a vehicle needs none of it)

        serve_runs(settings, out or Path("out") / "runs", as_json=as_json)
        return
    with (
        console.closing_on_signals(),
        open_server(settings, out, MachineClock(), console.print_message) as (side, ready),
    ):
        run_side(side, "", once=once, as_json=as_json, ready=ready)
