"""`lavt client`: the operator's side."""

from __future__ import annotations

import signal
from typing import Annotated

import typer

from lavt.assembly.side import open_client
from lavt.assembly.zenoh import load_client_config
from lavt.cli import console
from lavt.cli.side import run_side
from lavt.cli.vehicles import TIMEOUT_S, ScoutOption, list_vehicles
from lavt.clock import MachineClock
from lavt.config import HUMAN
from lavt.errors import UserError
from lavt.runtime import process_priority


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("client")(client)


def client(
    target: Annotated[
        str | None,
        typer.Argument(
            metavar="[HOST|CONFIG]",
            help="The vehicle's machine, or a client config such as configs/client.yaml; default: list the vehicles.",
            show_default=False,
        ),
    ] = None,
    out: console.OutOption = None,
    changes: console.SetOption = None,
    take_over: Annotated[
        bool, typer.Option("--take-over", help="Ask the client in control to hand over the vehicle.")
    ] = False,
    human: Annotated[
        bool, typer.Option("--human", help="Drive yourself, from a web page on this machine (docs/drive.md).")
    ] = False,
    watches: console.WatchOption = False,
    use_scouting: ScoutOption = False,
    as_json: console.JsonOption = False,
) -> None:
    """Run the operator's side: acquire control, arm and drive.

    The controller drives the vehicle by the received video. SIGUSR1 triggers an emergency stop. SIGUSR2 releases
    control: to the client that requests a handover, if there is one. Ctrl-C releases control and exits.

    With a host, the settings are the defaults, without encryption. Without an argument, the command only lists the
    vehicles that answer, like `lavt vehicles`.

    Example: lavt client 192.0.2.7
    """
    if target is None and (out is not None or changes or take_over or human or watches):
        raise UserError(
            "--out, --set, --take-over, --human and --watch are for driving: name the vehicle's host or a config"
        )
    if target is not None and use_scouting:
        raise UserError("--scout is for a list of vehicles: leave it out, or name no host and no config")
    console.reserve_stdout()
    if target is None:
        if list_vehicles(None, None, use_scouting=use_scouting, timeout_s=TIMEOUT_S, as_json=as_json):
            console.print_message("lavt: drive a vehicle with `lavt client HOST`, the address of its machine")
        return
    process_priority.raise_priority()
    options = {"take_over=true": take_over, f"controller.kind={HUMAN}": human}
    chosen = [change for change, is_chosen in options.items() if is_chosen]
    settings = load_client_config(target, [*(changes or []), *chosen])
    if ":" in settings.video.server:
        raise UserError("video goes over IPv4: set video.server to an IPv4 address, or to a name that has one")
    with open_client(settings, out, MachineClock(), console.print_message, is_watched=watches) as side:
        signal.signal(signal.SIGUSR1, lambda *_: side.send("operator", "emergency_stop"))
        signal.signal(signal.SIGUSR2, lambda *_: side.send("operator", "release"))
        ready = {}
        if side.console_url is not None:
            ready["console"] = side.console_url
            console.print_message(f"lavt: {'watch at' if watches else 'drive from'} {side.console_url}")
        run_side(side, settings.who, once=False, as_json=as_json, ready=ready)
