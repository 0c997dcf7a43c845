"""The pictures of a replay: one or several drives side by side, from their beginnings, at the same times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lavt.domain import Picture
from lavt.errors import UserError
from lavt.experiment.replay.drawing import ReplayLayout, Seen, draw_columns, draw_scene
from lavt.experiment.replay.drive import DriverView, ReplayDrive, read_driver_view, read_replay_drive

RATE_HZ = 20.0
HOLD_S = 2.0
"""How long the last moment is shown."""


def replay_pictures(
    directories: Sequence[Path],
    *,
    rate_hz: float = RATE_HZ,
    speed: float = 1.0,
    until_s: float | None = None,
    width_px: int | None = None,
) -> Iterator[Picture]:
    """Yield the pictures of a replay of the runs in `directories`, for a video with `rate_hz` pictures a second.

    `speed` is the time of the drive that passes in a second of video. `until_s` is the time of the drive at which the
    replay ends, by default the end of the longest drive. A drive that ends earlier shows its last moment. `width_px` is
    the width of the pictures, by default that of their parts together. Raises `UserError` or `WorkError` if a run
    cannot be shown.
    """
    drives = [read_replay_drive(directory) for directory in directories]
    views = [read_driver_view(directory) for directory in directories]
    for drive in drives:
        if drive.duration_s <= 0:
            raise UserError(f"{drive.directory} has no drive to replay: its vehicle never drove")
    errors_m = np.concatenate([drive.truth.floats("cross_track_m") for drive in drives])
    layout = ReplayLayout(
        any(view.units for view in views),
        len(errors_m) > 0,
        longest_s=max(drive.duration_s for drive in drives),
        largest_error_m=float(np.nanmax(np.abs(errors_m), initial=0.0)),
    )
    if not (layout.has_pictures or layout.has_truth):
        raise UserError(f"{directories[0]} has neither video nor the vehicle's position: record it with record.video")
    shown_s = layout.longest_s if until_s is None else min(until_s, layout.longest_s)
    step_s = speed / rate_hz
    times_s = [index * step_s for index in range(int(shown_s / step_s) + 1)] + [shown_s] * round(HOLD_S * rate_hz)
    columns = [_column(drive, view, layout, times_s) for drive, view in zip(drives, views, strict=True)]
    for parts in zip(*columns, strict=True):
        yield draw_columns(parts, width_px)


def _column(drive: ReplayDrive, view: DriverView, layout: ReplayLayout, times_s: Sequence[float]) -> Iterator[Picture]:
    """Yield the drawing of a drive at each time."""
    scenes = [drive.scene(time_s) for time_s in times_s]
    pictures = view.pictures(scene.stamp_ns for scene in scenes)
    for scene, picture in zip(scenes, pictures, strict=True):
        lane = None if scene.stamp_ns is None else view.lanes.get(scene.stamp_ns)
        yield draw_scene(drive, scene, layout, Seen(picture, lane, view.camera))
