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
    changes: console.SetOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """Forward the video of a vehicle behind NAT to its clients.

    The command also forwards the clock probe. It runs in the cloud until Ctrl-C, and the vehicle registers with it.

    Example: lavt rendezvous configs/rendezvous.yaml --set vehicle_key=keys/vehicle-1.sign.pub
    """
    process_priority.raise_priority()
    settings = load_config(RendezvousConfig, config, changes or [])
    forwarders = open_rendezvous(settings, MachineClock())
    ports = {f"{flow}_port": forwarder.port for flow, forwarder in forwarders.items()}
    printed_addresses: dict[FlowName, Address | None] = dict.fromkeys(forwarders)
    failures: list[BaseException] = []

    def fail(error: BaseException) -> None:
        failures.append(error)
        stop.set()

    with console.stop_on_signals() as stop, fail_on_thread_errors(fail):
        for forwarder in forwarders.values():
            forwarder.start()
        if as_json:
            console.print_json({"ready": ports})
        else:
            console.print_result(
                f"forwarding video at port {forwarders['video'].port} and probes at port {forwarders['probe'].port}; "
                "Ctrl-C ends it"
            )
        while not stop.wait(POLL_PERIOD_S):
            for flow, forwarder in forwarders.items():
                address = forwarder.vehicle_address()
                if address != printed_addresses[flow]:
                    _print_address(settings.vehicle_id, flow, address, as_json=as_json)
                    printed_addresses[flow] = address
    for forwarder in forwarders.values():
        forwarder.close()
    if failures:
        raise WorkError(f"stopped because a part failed: {describe_error(failures[0])}")
    if as_json:
        console.print_json({"counts": {flow: forwarder.counts for flow, forwarder in forwarders.items()}})


def _print_address(vehicle: str, flow: str, address: Address | None, *, as_json: bool) -> None:
    """Print the vehicle's new address for a flow; None: the vehicle no longer registers."""
    if as_json:
        console.print_json({"flow": flow, "vehicle_at": address})
    elif address is None:
        console.print_result(f"{flow}: {vehicle} no longer registers")
    else:
        host, port = address
        console.print_result(f"{flow}: {vehicle} is at {host}:{port}")
