"""`lavt router`: a Zenoh router in this process."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.cli import console
from lavt.config_file import shipped, split_change
from lavt.runtime import process_priority

LOOK_S = 0.5
"""A signal that the kernel gives to one of Zenoh's threads does not end the wait of this one, which then looks."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("router")(router)


def router(
    file: Annotated[Path, typer.Argument(help="A JSON5 config, yours or one of zenoh-configs/.")],
    changes: console.Set = None,
    as_json: console.Json = False,
) -> None:
    """Run a Zenoh router until Ctrl-C.

    Example: lavt router zenoh-configs/router-server.json5 --set 'listen.endpoints=[tcp/127.0.0.1:7447]'
    """
    console.keep_stdout_for_results()
    process_priority.raise_priority()
    from lavt.transport.zenoh_link import Router, quiet_logs  # noqa: PLC0415 (nobody else should wait for Zenoh)

    quiet_logs()
    opened = Router(find(file), overrides(changes or []))
    try:
        with console.until_told() as told:
            locators = opened.locators()
            if as_json:
                console.show_json({"locators": locators})
            else:
                console.show(f"routing at {', '.join(locators)}; Ctrl-C ends it")
            while not told.wait(LOOK_S):
                pass
    finally:
        opened.close()  # without it the process would not end


def find(file: Path) -> Path:
    """Give the file itself or, where there is none of that name, the one that comes with LAVT."""
    return file if file.exists() else shipped(str(file))


def overrides(changes: list[str]) -> dict[str, Any]:
    """Read `--set a.b=value` as Zenoh's keys with slashes."""
    return {"/".join(parts): value for parts, value in map(split_change, changes)}
