"""`lavt perception`: draw the steps of perception."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.cameras import camera_of_file
from lavt.cli import console
from lavt.cli.pictures import check_output, read_pictures, write_picture
from lavt.domain import Picture
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera
from lavt.perception.lane_detector import GRID, LANE_WIDTH_M, LaneDetector
from lavt.perception.panel import draw_panel
from lavt.transport.video.stamp import has_stamp
from lavt.transport.video.video_file import write_video


def register(app: typer.Typer) -> None:
    """Add the command."""
    perception = typer.Typer(help="Inspect lane detection.", no_args_is_help=True, rich_markup_mode=None)
    perception.callback()(_callback)  # with a callback, Typer keeps a single command as a subcommand
    perception.command("show")(show)
    app.add_typer(perception, name="perception")


def _callback() -> None:
    """Inspect lane detection."""


def show(
    source: Annotated[Path, typer.Argument(help="PNG, JPEG, MP4, MKV, or a run's client.mcap.")],
    camera: Annotated[Path, typer.Option(help="A calibration in YAML, or a config with a camera section.")],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Output file: .png or .jpg for a picture, .mp4, .mkv or .webp for a video; default: NAME-steps."
        ),
    ] = None,
    lane_width_m: Annotated[
        float, typer.Option(min=2.0, max=5.0, help="The assumed lane width if only one marking is visible.")
    ] = LANE_WIDTH_M,
) -> None:
    """Draw the steps from a picture to its lane.

    The steps are drawn side by side. For a video, the output is a video with the steps of each picture.

    Example: lavt perception show out/run/client.mcap --camera configs/demo.yaml --out steps.mp4
    """
    calibrated_camera = camera_of_file(camera)
    file = read_pictures(source)
    out = out or Path(f"{source.stem}-steps{'.mp4' if file.is_video else '.png'}")
    check_output(out, source=source, is_video=file.is_video)
    first = next(file.pictures, None)
    if first is None:
        raise UserError(f"{source} has no picture: name another file")
    pictures = chain([first], file.pictures)
    panels = _panels(pictures, calibrated_camera, lane_width_m, stamped=has_stamp(first), source=source)
    if file.is_video:
        with console.interruptible():
            count = write_video(out, panels, file.rate_hz)
        console.print_result(f"the steps of {count} pictures are in {out}")
    else:
        write_picture(out, next(panels))
        console.print_result(f"the steps are in {out}")


def _panels(
    pictures: Iterator[Picture], camera: CalibratedCamera, lane_width_m: float, *, stamped: bool, source: Path
) -> Iterator[Picture]:
    detector = LaneDetector(camera, GRID, lane_width_m, stamped=stamped)
    for picture in pictures:
        height_px, width_px, _ = picture.shape
        if (width_px, height_px) != (camera.width_px, camera.height_px):
            raise UserError(
                f"{source} is {width_px} x {height_px}, but the calibration is for {camera.width_px} x "
                f"{camera.height_px}: use pictures of that size, or a calibration for this size"
            )
        yield draw_panel(camera, detector, picture)
