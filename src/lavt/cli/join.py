"""`lavt join`: two machines' directories made into one run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.cli import console
from lavt.cli.run import tell
from lavt.experiment.runs.join import join_sides


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("join")(join)


def join(
    server: Annotated[Path, typer.Argument(help="What `lavt server --out` wrote.")],
    client: Annotated[Path, typer.Argument(help="What `lavt client --out` wrote.")],
    out: Annotated[Path, typer.Option(help="Directory of the run.")],
    as_json: console.Json = False,
) -> None:
    """Make one run of the records of two machines, and compute its result.

    Example: lavt join out/server out/client --out out/run; lavt report out/run
    """
    tell(join_sides(server, client, out), out, as_json=as_json)
