"""`lavt join`: join the records of two machines into one run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.cli import console
from lavt.cli.run import print_run
from lavt.experiment.runs.join import join_sides
from lavt.recording.output_directory import disk_errors_named


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("join")(join)


def join(
    server: Annotated[Path, typer.Argument(help="The output directory of `lavt server`.")],
    client: Annotated[Path, typer.Argument(help="The output directory of `lavt client`.")],
    out: Annotated[Path, typer.Option(help="Output directory of the run.")],
    as_json: console.JsonOption = False,
) -> None:
    """Join the records of two machines into one run.

    The command also computes the result of the run.

    Example: lavt join out/server out/client --out out/joined; lavt report out/joined
    """
    with disk_errors_named(out):
        result = join_sides(server, client, out)
    print_run(result, out, result["seed"], as_json=as_json)
