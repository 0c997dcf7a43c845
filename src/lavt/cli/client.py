"""`lavt client`: the operator's side."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.side import open_client
from lavt.cli import console
from lavt.cli.side import run_side
from lavt.clock import MachineClock
from lavt.config import ClientConfig
from lavt.config_file import load_config
from lavt.runtime import process_priority


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("client")(client)


def client(
    config: Annotated[Path, typer.Argument(help="A client config in YAML, such as configs/client.yaml.")],
    out: console.OutOption = None,
    changes: console.SetOption = None,
    take_over: Annotated[
        bool, typer.Option("--take-over", help="Ask the client in control to hand over the vehicle.")
    ] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Run the operator's side: acquire control, arm and drive.

    The controller drives the vehicle by the received video. SIGUSR1 triggers an emergency stop. SIGUSR2 releases
    control: to the client that requests a handover, if there is one. Ctrl-C releases control and exits.

    Example: lavt client configs/client.yaml --set video.server=192.0.2.7
    """
    console.reserve_stdout()
    process_priority.raise_priority()
    settings = load_config(ClientConfig, config, [*(changes or []), *(["take_over=true"] if take_over else [])])
    with open_client(settings, out, MachineClock(), console.print_message) as side:
        signal.signal(signal.SIGUSR1, lambda *_: side.send("operator", "emergency_stop"))
        signal.signal(signal.SIGUSR2, lambda *_: side.send("operator", "release"))
        run_side(side, settings.who, once=False, as_json=as_json, ready={})
