"""The replay in a report: the runs with the least and with the most injected delay, side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from lavt.domain import NS_PER_S, Picture
from lavt.experiment.analysis.drive_data import DriveData
from lavt.experiment.report import html_page
from lavt.experiment.report.run_sections import DriveSets
from lavt.experiment.report.sections import Parts, ReportContext

FILE, POSTER = "replay.mp4", "replay.jpg"
WIDTH_PX, RATE_HZ, SPEED, UNTIL_S = 960, 10.0, 2.0, 40.0


def replay_parts(report: ReportContext, sets: DriveSets) -> Parts:
    """Return the replay of two runs that differ in delay; nothing if no two runs with video do."""
    pairs = (least_and_most_delayed(drives) for drives in sets.values())
    pair = next((pair for pair in pairs if pair), None)
    if pair is None:
        return []
    # Slow to import, and not needed without video.
    from lavt.experiment.replay.drawing import KEY  # noqa: PLC0415
    from lavt.experiment.replay.replay import replay_pictures  # noqa: PLC0415
    from lavt.transport.video.video_file import write_video  # noqa: PLC0415

    pictures = replay_pictures(
        [drive.directory for drive in pair], rate_hz=RATE_HZ, speed=SPEED, until_s=UNTIL_S, width_px=WIDTH_PX
    )
    video, poster = report.directory / FILE, report.directory / POSTER
    poster_s = largest_error_s(pair[-1])
    write_video(video, _with_poster(pictures, int(poster_s * RATE_HZ / SPEED), poster), RATE_HZ)
    names = " and ".join(str(drive.result["run"]) for drive in pair)
    caption = (
        f"The runs {names}, those with the least and the most injected delay on the first route and in the first "
        f"repetition, at {SPEED:g} times the speed: the frame from which the command in force was made; the road from "
        f"above; and the distance from the lane centre. Printed: {poster_s:.1f} s, when {pair[-1].condition} is "
        "farthest from the lane centre."
    )
    invalid = [str(drive.result["run"]) for drive in pair if not drive.result.get("valid", True)]
    if invalid:
        caption += f" Not valid, so an example only: {' and '.join(invalid)}."
    key = [(f"#{red:02x}{green:02x}{blue:02x}", meaning) for (blue, green, red), meaning in KEY]
    return [html_page.video(video, poster, f"replay of the runs {names}", caption, key)]


def largest_error_s(drive: DriveData) -> float:
    """Return the time of a drive's largest cross-track error that the replay shows, since the drive began."""
    time_s = (drive.truth.ints("mono_ns") - drive.began_ns) / NS_PER_S
    error_m = np.abs(np.nan_to_num(drive.truth.floats("cross_track_m")))
    return float(time_s[np.argmax(np.where(time_s <= UNTIL_S, error_m, -1.0))])


def _with_poster(pictures: Iterator[Picture], index: int, poster: Path) -> Iterator[Picture]:
    """Yield the pictures, and write the one with this index to a file."""
    for number, picture in enumerate(pictures):
        if number == index:
            cv2.imwrite(str(poster), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
        yield picture


def least_and_most_delayed(drives: Sequence[DriveData]) -> list[DriveData]:
    """Return the runs with the least and the most injected delay of the first route and repetition that has both.

    Runs without video or without a drive do not count. The result is empty if there are no such runs.
    """
    groups: dict[tuple[str, int], list[DriveData]] = {}
    for drive in drives:
        has_video = drive.result.get("fidelity") in {None, "video"} and (drive.directory / "client.mcap").is_file()
        if has_video and len(drive.truth):
            key = str(drive.result["route"]), int(drive.result.get("repetition") or 0)
            groups.setdefault(key, []).append(drive)
    for _, members in sorted(groups.items()):
        least, most = (choose(members, key=_injected_ms) for choose in (min, max))
        if _injected_ms(least) < _injected_ms(most):
            return [least, most]
    return []


def _injected_ms(drive: DriveData) -> float:
    injected_ms = drive.result.get("injected_ms") or {}
    return sum(value or 0.0 for value in injected_ms.values())
