"""`lavt router`: run a Zenoh router in this process."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.cli import console
from lavt.config_file import find_file, split_change
from lavt.runtime import process_priority

POLL_PERIOD_S = 0.5
"""How often the main thread wakes to run signal handlers: a signal that a Zenoh thread receives does not wake it."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("router")(router)


def router(
    file: Annotated[Path, typer.Argument(help="A Zenoh config in JSON5, such as one of zenoh-configs/.")],
    changes: console.SetOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """Run a Zenoh router until Ctrl-C.

    Example: lavt router zenoh-configs/router-server.json5 --set 'listen.endpoints=[tcp/127.0.0.1:7447]'
    """
    console.reserve_stdout()
    process_priority.raise_priority()
    from lavt.transport.zenoh_session import Router, quiet_logs  # noqa: PLC0415 (slow: Zenoh)

    quiet_logs()
    zenoh_router = Router(find_file(file), parse_overrides(changes or []))
    try:
        with console.stop_on_signals() as stop:
            locators = zenoh_router.locators()
            if as_json:
                console.print_json({"locators": locators})
            else:
                console.print_result(f"routing at {', '.join(locators)}; Ctrl-C ends it")
            while not stop.wait(POLL_PERIOD_S):
                zenoh_router.check()
    finally:
        zenoh_router.close()  # an open router would keep the process alive


def parse_overrides(changes: list[str]) -> dict[str, Any]:
    """Parse changes of the form a.b=value; return the values by Zenoh's keys, such as a/b."""
    return {"/".join(parts): value for parts, value in map(split_change, changes)}
