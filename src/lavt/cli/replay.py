"""`lavt replay`: make a video of finished runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.cli import console
from lavt.errors import UserError
from lavt.experiment.replay.replay import RATE_HZ, replay_pictures
from lavt.transport.video.video_file import VIDEO_CODECS, write_video

MAX_RUNS = 4


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("replay")(replay)


def replay(
    runs: Annotated[list[Path], typer.Argument(help="Directories of runs, to be shown side by side.")],
    out: Annotated[Path, typer.Option(help="The video: .mp4, .mkv or, animated, .webp.")] = Path("replay.mp4"),
    rate: Annotated[float, typer.Option(min=1, max=60, help="Pictures in a second of video.")] = RATE_HZ,
    speed: Annotated[float, typer.Option(min=0.1, max=20, help="Seconds of the drive in a second of video.")] = 1.0,
    until: Annotated[
        float | None, typer.Option(min=0.1, help="The time of the drive at which the replay ends, in s.")
    ] = None,
    width: Annotated[int | None, typer.Option(min=200, max=4096, help="Width of the video in pixels.")] = None,
) -> None:
    """Make a video of runs side by side.

    The video shows what the driver saw, the lane that it detected, and where the car was. The picture at
    each moment is the one from which the command in force was made. A run without recorded video shows only the car's
    position.

    Example: lavt replay out/demo/runs/real_a_key_L0_00 out/demo/runs/real_a_key_L5_00 --out replay.mp4
    """
    if out.suffix.lower() not in VIDEO_CODECS:
        raise UserError(f"{out} cannot be written: the name of a video ends with {', '.join(VIDEO_CODECS)}")
    if not out.parent.is_dir():
        raise UserError(f"{out.parent} is not a directory: create it, or name another with --out")
    if len(runs) > MAX_RUNS:
        raise UserError(f"{len(runs)} runs do not fit into one video: name at most {MAX_RUNS}")
    for run in runs:
        if not (run / "result.json").is_file():
            raise UserError(f"{run} is not a finished run: name a directory with result.json and the records")
    with console.interruptible():
        count = write_video(out, replay_pictures(runs, rate_hz=rate, speed=speed, until_s=until, width_px=width), rate)
    console.print_result(f"the replay of {count / rate:.0f} s is {out}")
