"""Picture and video files: reading what people have, and writing what they can open."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lavt.domain import Picture
from lavt.errors import UserError, WorkError
from lavt.recording.record import read_record
from lavt.transport.video.h264 import Decoder

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEO_SUFFIXES = (".mp4", ".mkv")
USUAL_RATE_HZ = 30.0


@dataclass(frozen=True, slots=True)
class PictureFile:
    """A file's pictures, one after another, read as they are asked for."""

    pictures: Iterator[Picture]
    moving: bool
    rate_hz: float = USUAL_RATE_HZ


def read_pictures(path: Path) -> PictureFile:
    """Open a picture, a video or a record (`client.mcap` of a run); raises `UserError` for what is none of them."""
    if not path.is_file():
        raise UserError(f"{path} is not there: name a picture, a video or a record")
    if path.suffix == ".mcap":
        return PictureFile(_of_record(path), moving=True)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(
        cv2.utils.logging.LOG_LEVEL_SILENT
    )  # what is wrong with a file is said below, in one sentence
    try:
        data = np.fromfile(path, dtype=np.uint8)
        still = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): name another file") from error
    except cv2.error:
        still = None
    if still is not None:
        return PictureFile(iter([np.asarray(still, dtype=np.uint8)]), moving=False)
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise UserError(f"{path} is neither a picture nor a video that can be read: give PNG, JPEG, MP4, MKV or MCAP")
    rate_hz = video.get(cv2.CAP_PROP_FPS)
    return PictureFile(_of_video(path, video), moving=True, rate_hz=rate_hz if 1 <= rate_hz <= 240 else USUAL_RATE_HZ)


def _of_video(path: Path, video: cv2.VideoCapture) -> Iterator[Picture]:
    there, picture = video.read()
    if not there:
        raise UserError(f"{path} holds no picture that can be read: give PNG, JPEG, MP4, MKV or MCAP")
    while there:
        yield np.asarray(picture, dtype=np.uint8)
        there, picture = video.read()


def _of_record(path: Path) -> Iterator[Picture]:
    decoder, found = Decoder(), False
    for _, unit in read_record(path, channels=()).video():
        decoded = decoder.decode(unit)
        if decoded is not None:
            found = True
            yield decoded.picture
    if not found:
        raise UserError(
            f"{path} holds no picture: name a run's client.mcap or server.mcap, whole and made with record.video"
        )


def check_output(out: Path, *, source: Path, moving: bool) -> None:
    """Raise `UserError` for a name from which nobody could tell what to write, and for that of the source itself."""
    known = VIDEO_SUFFIXES if moving else PICTURE_SUFFIXES
    if out.suffix.lower() not in known:
        raise UserError(f"{out} cannot be written: a {'video' if moving else 'picture'} ends with {' or '.join(known)}")
    if not out.parent.is_dir():
        raise UserError(f"{out.parent} is not a directory: make it, or name another with --out")
    if out.exists() and out.samefile(source):
        raise UserError(f"{out} is what is read, and would be lost: name another file with --out")


def write_picture(out: Path, picture: Picture) -> None:
    """Write one picture."""
    if not cv2.imwrite(str(out), picture):
        raise WorkError(f"{out} could not be written")


def write_video(out: Path, pictures: Iterable[Picture], rate_hz: float) -> int:
    """Write a video and give its number of pictures."""
    writer: cv2.VideoWriter | None = None
    count = 0
    try:
        for picture in pictures:
            if writer is None:
                size = (picture.shape[1], picture.shape[0])
                writer = cv2.VideoWriter(str(out), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, size)
                if not writer.isOpened():
                    raise WorkError(f"{out} could not be written as MPEG-4 video")
            writer.write(picture)
            count += 1
    finally:
        if writer is not None:
            writer.release()
    return count
