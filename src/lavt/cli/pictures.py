"""Reading of picture and video files, and writing of pictures."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from lavt.domain import Picture
from lavt.errors import UserError, WorkError
from lavt.recording.record import read_record
from lavt.transport.video.h264 import Decoder
from lavt.transport.video.video_file import VIDEO_CODECS

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEO_SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".mcap")
DEFAULT_RATE_HZ = 30.0
"""The picture rate of a video whose file states no plausible rate."""


class SourceKind(NamedTuple):
    """The kind of files that a command reads."""

    suffixes: tuple[str, ...]
    """The names of files that are read in a directory."""
    singular: str
    plural: str
    """The kind in messages."""


PICTURES_AND_VIDEOS = SourceKind(
    (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES), "picture, video or record", "pictures, videos, records"
)


@dataclass(frozen=True, slots=True)
class PictureFile:
    """The pictures of a file, read lazily."""

    pictures: Iterator[Picture]
    is_video: bool
    rate_hz: float = DEFAULT_RATE_HZ


def find_sources(paths: Sequence[Path], kind: SourceKind = PICTURES_AND_VIDEOS) -> list[Path]:
    """Return the files, and for each directory the files of that kind in it, sorted by name.

    Raises `UserError` if a path does not exist, or if a directory has no such file.
    """
    files: list[Path] = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        found = sorted(file for file in path.iterdir() if file.suffix.lower() in kind.suffixes and file.is_file())
        if not found:
            raise UserError(
                f"the directory {path} has no {kind.singular} ({', '.join(kind.suffixes)}): name another directory, or "
                "files"
            )
        files += found
    missing = [file for file in files if not file.exists()]
    if missing:
        raise UserError(f"{missing[0]} does not exist: name {kind.plural}, or directories of them")
    return files


def read_pictures(path: Path) -> PictureFile:
    """Open a picture, a video or a record (`client.mcap` of a run); raise `UserError` for any other file."""
    if not path.is_file():
        raise UserError(f"{path} does not exist: name a picture, a video or a record")
    if path.suffix == ".mcap":
        return PictureFile(_read_record(path), is_video=True)
    # Silence OpenCV's log: the messages below describe each error in one sentence.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        data = np.fromfile(path, dtype=np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): name another file") from error
    except cv2.error:
        picture = None
    if picture is not None:
        return PictureFile(iter([np.asarray(picture, dtype=np.uint8)]), is_video=False)
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise UserError(f"{path} is not a readable picture or video: give PNG, JPEG, MP4, MKV or MCAP")
    rate_hz = video.get(cv2.CAP_PROP_FPS)
    if not 1 <= rate_hz <= 240:
        rate_hz = DEFAULT_RATE_HZ
    return PictureFile(_read_video(path, video), is_video=True, rate_hz=rate_hz)


def _read_video(path: Path, video: cv2.VideoCapture) -> Iterator[Picture]:
    is_read, picture = video.read()
    if not is_read:
        raise UserError(f"{path} has no readable picture: give PNG, JPEG, MP4, MKV or MCAP")
    while is_read:
        yield np.asarray(picture, dtype=np.uint8)
        is_read, picture = video.read()


def _read_record(path: Path) -> Iterator[Picture]:
    decoder, has_picture = Decoder(), False
    for _, unit in read_record(path, channels=()).video():
        decoded = decoder.decode(unit)
        if decoded is not None:
            has_picture = True
            yield decoded.picture
    if not has_picture:
        raise UserError(
            f"{path} has no picture: name the complete client.mcap or server.mcap of a run with record.video"
        )


def check_output(out: Path, *, source: Path, is_video: bool, option: str = "--out") -> None:
    """Raise `UserError` if `out` has an unknown suffix, is in a missing directory, or is the source.

    The message names the `option` of the command that chooses another output.
    """
    suffixes = tuple(VIDEO_CODECS) if is_video else PICTURE_SUFFIXES
    if out.suffix.lower() not in suffixes:
        kind = "video" if is_video else "picture"
        raise UserError(f"{out} cannot be written: the name of a {kind} ends with {' or '.join(suffixes)}")
    if not out.parent.is_dir():
        raise UserError(f"{out.parent} is not a directory: create it, or name another with {option}")
    if out.exists() and out.samefile(source):
        raise UserError(f"{out} is the input and would be overwritten: name another file with {option}")


def write_picture(out: Path, picture: Picture) -> None:
    """Write one picture."""
    if not cv2.imwrite(str(out), picture):
        raise WorkError(f"{out} could not be written: is there space on the disk?")
