"""`lavt perception`: what perception does with a picture, step by step."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.cameras import camera_of_file
from lavt.cli import console
from lavt.cli.pictures import check_output, read_pictures, write_picture, write_video
from lavt.domain import Picture
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera
from lavt.perception.lane_detector import GRID, LANE_WIDTH_M, LaneDetector
from lavt.perception.panel import panel
from lavt.transport.video.stamp import has_stamp


def register(app: typer.Typer) -> None:
    """Add the group of commands."""
    group = typer.Typer(help="What perception does with pictures.", no_args_is_help=True, rich_markup_mode=None)
    group.callback()(_group)
    group.command("show")(show)
    app.add_typer(group, name="perception")


def _group() -> None:
    """What perception does with pictures."""


def show(
    source: Annotated[Path, typer.Argument(help="PNG, JPEG, MP4, MKV, or a run's client.mcap.")],
    camera: Annotated[Path, typer.Option(help="A calibration in YAML, or a config with a camera section.")],
    out: Annotated[
        Path | None, typer.Option(help=".png or .jpg, for a video .mp4 or .mkv; default: NAME-steps.")
    ] = None,
    lane_width_m: Annotated[float, typer.Option(min=2.0, max=5.0, help="Where it cannot be seen.")] = LANE_WIDTH_M,
) -> None:
    """Draw all steps from a picture to the lane in it, side by side; for a video, one such picture for each.

    Example: lavt perception show out/run/client.mcap --camera configs/demo.yaml --out steps.mp4
    """
    known = camera_of_file(camera)
    found = read_pictures(source)
    out = out or Path(f"{source.stem}-steps{'.mp4' if found.moving else '.png'}")
    check_output(out, source=source, moving=found.moving)
    first = next(found.pictures, None)
    if first is None:
        raise UserError(f"{source} holds no picture: name another")
    panels = _panels(chain([first], found.pictures), known, lane_width_m, stamped=has_stamp(first), source=source)
    if found.moving:
        with console.interruptible():
            count = write_video(out, panels, found.rate_hz)
        console.show(f"the steps of {count} pictures are in {out}")
    else:
        write_picture(out, next(panels))
        console.show(f"the steps are in {out}")


def _panels(
    pictures: Iterator[Picture], camera: CalibratedCamera, lane_width_m: float, *, stamped: bool, source: Path
) -> Iterator[Picture]:
    detector = LaneDetector(camera, GRID, lane_width_m, stamped=stamped)
    for picture in pictures:
        height_px, width_px, _ = picture.shape
        if (width_px, height_px) != (camera.width_px, camera.height_px):
            raise UserError(
                f"{source} is {width_px} x {height_px}, but the calibration is for {camera.width_px} x "
                f"{camera.height_px}: use pictures of that size, or calibrate for these"
            )
        yield panel(camera, detector, picture)
