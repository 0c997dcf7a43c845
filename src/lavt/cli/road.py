"""`lavt road`: draw roads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.cli import console
from lavt.domain import CameraModel
from lavt.errors import UserError
from lavt.vehicle.sim.road.road import load_road


def register(app: typer.Typer) -> None:
    """Add the command."""
    road = typer.Typer(no_args_is_help=True, help="Draw roads: shipped ones and your own.")
    road.callback()(_callback)  # with a callback, Typer keeps a single command as a subcommand
    road.command("draw")(draw)
    app.add_typer(road, name="road")


def _callback() -> None:
    """Draw roads: shipped ones and your own (docs/roads.md)."""


def draw(
    name: Annotated[
        str, typer.Argument(metavar="FILE_OR_NAME", help="A road's YAML file, or the name of a shipped road.")
    ],
    out: Annotated[Path | None, typer.Option(help="Output file, a PNG; default: out/road_NAME.png.")] = None,
) -> None:
    """Draw a road from above and from the driver's seat.

    Example: lavt road draw a_key --out a_key.png
    """
    road = load_road(name)
    out = out or Path("out") / f"road_{Path(name).stem}.png"
    if out.suffix != ".png":
        raise UserError(f"--out {out}: the picture is a PNG, so its name must end with .png")
    from lavt.vehicle.sim.rendering.drawing import draw_road  # noqa: PLC0415 (slow: matplotlib)

    out.parent.mkdir(parents=True, exist_ok=True)
    draw_road(road, model=CameraModel()).savefig(out)
    console.print_result(f"the picture is {out}")
