"""`lavt drive`: a person drives the built-in simulator's car from a web page, on one machine."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import typer

from lavt.assembly.side import Side, open_client
from lavt.cli import console
from lavt.cli.page import show_page
from lavt.cli.side import run_side
from lavt.clock import MachineClock
from lavt.config import ConsoleConfig
from lavt.errors import WorkError
from lavt.experiment.runs.human_drive import HumanDrive, drive_config, start_human_drive
from lavt.recording.output_directory import check_directory
from lavt.runtime import process_priority
from lavt.transport.console.console_link import check_installed


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("drive")(drive)


def drive(
    out: console.OutOption = None,
    changes: console.SetOption = None,
    opens_page: console.BrowserOption = True,
    port: console.PagePortOption = 0,
    as_json: console.JsonOption = False,
) -> None:
    """Drive yourself: the simulator's car, from a web page on this machine.

    Hold the space bar to arm and to drive; steer and accelerate with the arrow keys. The keys 0 to 5 choose the delays
    of the conditions L0 to L5. To drive a vehicle on another machine: lavt client HOST --human

    Example: lavt drive --set vehicle.route=b
    """
    console.reserve_stdout()
    process_priority.raise_priority()
    check_installed()
    config, clock = drive_config(changes or []), MachineClock()
    if out is not None:
        check_directory(out)
    with console.closing_on_signals(), start_human_drive(config, out, clock) as human_drive:
        client = human_drive.client.model_copy(update={"console": ConsoleConfig(port=port)})
        own_out = None if out is None else out / "client"
        with open_client(
            client, own_out, clock, console.print_message, relay=human_drive.relay, delays=human_drive.delays
        ) as side:
            assert side.console_url is not None  # noqa: S101 (a person drives)
            show_page(side.console_url, human_drive.work, opens_page=opens_page)
            human_drive.relay.start()
            with _fail_with_server(human_drive, side):
                run_side(side, client.who, once=False, as_json=as_json, ready={"console": side.console_url})


@contextmanager
def _fail_with_server(human_drive: HumanDrive, side: Side) -> Iterator[None]:
    """Let the side fail if the server's process ends during the `with` block."""
    is_over = threading.Event()

    def watch() -> None:
        human_drive.server.popen.wait()
        if not is_over.is_set():
            side.runtime.fail(WorkError(f"the vehicle's side has ended: {human_drive.server.last_message()}"))

    threading.Thread(target=watch, name="server watch", daemon=True).start()
    try:
        yield
    finally:
        is_over.set()
