"""Real video files with a moving bar, whose position encodes the picture's number."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from lavt.domain import CameraModel, Picture

MODEL = CameraModel(width_px=320, height_px=240)
BAR_PX = 10
PICTURE_COUNT = MODEL.width_px // BAR_PX
"""The number of positions of the bar, and so of different pictures."""


def write_video(path: Path, *, rate_hz: float, pictures: int = PICTURE_COUNT, model: CameraModel = MODEL) -> Path:
    """Write pictures 0, 1, ..., with the bar further to the right in each."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate_hz, (model.width_px, model.height_px))
    assert writer.isOpened()
    for number in range(pictures):
        picture = np.zeros((model.height_px, model.width_px, 3), np.uint8)
        picture[:, number * BAR_PX : (number + 1) * BAR_PX] = 255
        writer.write(picture)
    writer.release()
    return path


def number_of(picture: Picture) -> int:
    """Return the picture's number in the file."""
    return int(np.argmax(picture[120, :, 1] > 127)) // BAR_PX
