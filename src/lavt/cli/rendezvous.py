"""`lavt rendezvous`: connect clients to a vehicle behind a NAT without port forwarding."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.rendezvous import open_rendezvous
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import RendezvousConfig
from lavt.config_file import load_config
from lavt.errors import WorkError, describe_error
from lavt.runtime import process_priority
from lavt.runtime.thread_failures import fail_on_thread_errors
from lavt.transport.rendezvous.forwarder import Address, FlowName

POLL_PERIOD_S = 0.2


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("rendezvous")(rendezvous)


def rendezvous(
    config: Annotated[Path, typer.Argument(help="A rendezvous config in YAML, such as configs/rendezvous.yaml.")],
    changes: console.Set = None,
    as_json: console.Json = False,
) -> None:
    """Forward video to clients from a vehicle behind NAT.

    The command also forwards the clock probe. It runs in the cloud, where the vehicle registers, until Ctrl-C.

    Example: lavt rendezvous configs/rendezvous.yaml --set vehicle_key=keys/vehicle-1.sign.pub
    """
    process_priority.raise_priority()
    settings = load_config(RendezvousConfig, config, changes or [])
    forwarders = open_rendezvous(settings, MachineClock())
    ports = {f"{flow}_port": each.port for flow, each in forwarders.items()}
    known: dict[FlowName, Address | None] = dict.fromkeys(forwarders)
    failures: list[BaseException] = []

    def fail(error: BaseException) -> None:
        failures.append(error)
        stop.set()

    with console.stop_on_signals() as stop, fail_on_thread_errors(fail):
        for each in forwarders.values():
            each.start()
        if as_json:
            console.print_json({"ready": ports})
        else:
            console.print_result(
                f"forwarding video at port {forwarders['video'].port} and probes at port {forwarders['probe'].port}; "
                "Ctrl-C ends it"
            )
        while not stop.wait(POLL_PERIOD_S):
            addresses = {flow: each.vehicle_address() for flow, each in forwarders.items()}
            for flow in (each for each in forwarders if addresses[each] != known[each]):
                _print_address(settings.vehicle_id, flow, addresses[flow], as_json=as_json)
            known.update(addresses)
    for each in forwarders.values():
        each.close()
    if failures:
        raise WorkError(f"stopped because a part failed: {describe_error(failures[0])}")
    if as_json:
        console.print_json({"counts": {flow: each.counts for flow, each in forwarders.items()}})


def _print_address(vehicle: str, flow: str, address: Address | None, *, as_json: bool) -> None:
    """Print the vehicle's address; None if it does not register any more."""
    if as_json:
        console.print_json({"flow": flow, "vehicle_at": address})
    elif address is None:
        console.print_result(f"{flow}: {vehicle} no longer registers")
    else:
        console.print_result(f"{flow}: {vehicle} is at {address[0]}:{address[1]}")
