"""`lavt rendezvous`: where a client meets a vehicle behind a NAT that forwards nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.rendezvous import open_rendezvous
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import RendezvousConfig
from lavt.config_file import load_config
from lavt.runtime import process_priority
from lavt.transport.rendezvous.forwarder import Address, FlowName

LOOK_S = 0.2


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("rendezvous")(rendezvous)


def rendezvous(
    config: Annotated[Path, typer.Argument(help="A rendezvous config in YAML, such as configs/rendezvous.yaml.")],
    changes: console.Set = None,
    as_json: console.Json = False,
) -> None:
    """Carry video and clock probe between clients and a vehicle that dials here, until Ctrl-C.

    Example: lavt rendezvous configs/rendezvous.yaml --set vehicle_key=keys/vehicle-1.sign.pub
    """
    process_priority.raise_priority()
    settings = load_config(RendezvousConfig, config, changes or [])
    opened = open_rendezvous(settings, MachineClock())
    ports = {f"{flow}_port": each.port for flow, each in opened.items()}
    there: dict[FlowName, Address | None] = dict.fromkeys(opened)
    with console.until_told() as told:
        for each in opened.values():
            each.start()
        if as_json:
            console.show_json({"ready": ports})
        else:
            console.show(f"forwarding video at port {opened['video'].port} and probes at {opened['probe'].port}; "
                         "Ctrl-C ends it")  # fmt: skip
        while not told.wait(LOOK_S):
            now_there = {flow: each.vehicle_address() for flow, each in opened.items()}
            for flow in (each for each in opened if now_there[each] != there[each]):
                _tell(settings.vehicle_id, flow, now_there[flow], as_json=as_json)
            there.update(now_there)
    for each in opened.values():
        each.close()
    if as_json:
        console.show_json({"counts": {flow: each.counts for flow, each in opened.items()}})


def _tell(vehicle: str, flow: str, at: Address | None, *, as_json: bool) -> None:
    """Print from where the vehicle can be reached now, or that it cannot."""
    if as_json:
        console.show_json({"flow": flow, "vehicle_at": at})
    elif at is None:
        console.show(f"{flow}: {vehicle} is not heard any more")
    else:
        console.show(f"{flow}: {vehicle} is at {at[0]}:{at[1]}")
