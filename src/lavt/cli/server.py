"""`lavt server`: the vehicle's side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.actuator_process import start_actuator
from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.nodes import build_server
from lavt.cli import console
from lavt.cli.side import Side, run_side
from lavt.clock import MachineClock
from lavt.config import ServerConfig
from lavt.config_file import load_config
from lavt.runtime import process_priority
from lavt.transport.clock_sync.clock_report import kernel_identity


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("server")(server)


def server(
    config: Annotated[Path, typer.Argument(help="A server config in YAML, such as configs/server.yaml.")],
    out: console.Out = None,
    changes: console.Set = None,
    once: Annotated[bool, typer.Option("--once", help="Exit when the first drive has ended.")] = False,
    as_json: console.Json = False,
) -> None:
    """Run the vehicle's side: stream video and execute commands.

    The server executes the commands of the client that has control. If no valid command arrives, it stops the vehicle.

    Example: lavt server configs/server.yaml --out out/server
    """
    console.reserve_stdout()
    process_priority.raise_priority()
    settings = load_config(ServerConfig, config, changes or [])
    clock = MachineClock()
    with Side(settings, out, clock) as side:
        port = side.open_video("feedback", bind=(settings.video.bind, settings.video.port))
        probe_port = side.open_probe("probe_request", bind=(settings.video.bind, settings.clock.probe_port))
        host = kernel_identity()
        nodes = build_server(settings, clock.now, MachineEntropy(), host=host, video_port=port)
        ready = {"video_port": port, "probe_port": probe_port}
        if nodes.actuator is None:
            side.actuator = actuator = start_actuator(settings, host=host, video_port=port)
            side.in_force = lambda: actuator.in_force
            ready |= {"actuator_pid": actuator.pid}
        else:
            gate = nodes.actuator.gate
            side.in_force = lambda: gate.in_force
        run_side(side, nodes.all, once=once, as_json=as_json, ready=ready)
