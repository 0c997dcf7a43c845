"""`lavt road`: look at roads."""

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
    road = typer.Typer(no_args_is_help=True, help="Look at roads: those that come with LAVT, and your own.")
    road.callback()(_roads)  # a single command stays a sub-command
    road.command("draw")(draw)
    app.add_typer(road, name="road")


def _roads() -> None:
    """Look at roads: those that come with LAVT, and your own (docs/roads.md)."""


def draw(
    name: Annotated[
        str, typer.Argument(metavar="FILE_OR_NAME", help="A road's YAML file, or a road that comes with LAVT.")
    ],
    out: Annotated[Path | None, typer.Option(help="The picture, a PNG; default: out/road_NAME.png.")] = None,
) -> None:
    """Draw a road from above and from the driver's seat.

    Example: lavt road draw a_key --out a_key.png
    """
    road = load_road(name)
    out = out or Path("out") / f"road_{Path(name).stem}.png"
    if out.suffix != ".png":
        raise UserError(f"--out {out}: the picture is a PNG, so let the name end with .png")
    from lavt.vehicle.sim.rendering.drawing import draw_road  # noqa: PLC0415 (slow: matplotlib)

    out.parent.mkdir(parents=True, exist_ok=True)
    draw_road(road, model=CameraModel()).savefig(out)
    console.show(f"the picture is {out}")
