"""The pictures that both programs send: a seamless loop of the simulator's pictures, in a file mapped into memory."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import CameraModel, Picture, Pose
from lavt.transport.video.stamp import STAMP_PX
from lavt.vehicle.sim.rendering.renderer import Renderer
from lavt.vehicle.sim.road.road import load_road

LOOP_FRAMES = 300
METRES_PER_FRAME = 8.33 / 30
START_STATION_M = 175.0
ROUTE = "b"

Planes = NDArray[np.uint8]
"""A picture in I420, (height * 3 / 2, width)."""


def render_pictures(stem: Path, width_px: int, height_px: int) -> None:
    """Write the pictures of a drive at 30 km/h to the file `stem`.npy.

    The car drives forward and then back. The noise of each picture is different.
    """
    road = load_road(ROUTE)
    renderer = Renderer(road, CameraModel(width_px, height_px), seed=1, scenery="full")
    shape = (LOOP_FRAMES, height_px * 3 // 2, width_px)
    planes = np.lib.format.open_memmap(stem.with_suffix(".npy"), "w+", np.uint8, shape)
    for number in range(LOOP_FRAMES):
        step = min(number, LOOP_FRAMES - number)
        x_m, y_m, heading_rad, _ = (float(value) for value in road.centre_at(START_STATION_M + step * METRES_PER_FRAME))
        picture = renderer.render(Pose(0, x_m, y_m, heading_rad), number)
        cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420, dst=planes[number])


def memory_map_pictures(stem: Path) -> NDArray[np.uint8]:
    """Map the pictures, in I420, into memory as an array (n, height * 3 / 2, width); changes of it are not saved."""
    pictures: NDArray[np.uint8] = np.load(stem.with_suffix(".npy"), mmap_mode="c")
    pictures.reshape(-1)[::4096].sum()  # maps all pages now, so that no frame is delayed by it
    return pictures


def squared_error(luma: NDArray[np.uint8], source: Planes) -> float:
    """Return the mean squared error of a luma plane, (height, width), to the source picture, outside of the stamp."""
    height_px, width_px = luma.shape
    below = cv2.norm(luma[STAMP_PX:], source[STAMP_PX:height_px], cv2.NORM_L2SQR)
    right = cv2.norm(luma[:STAMP_PX, STAMP_PX:], source[:STAMP_PX, STAMP_PX:], cv2.NORM_L2SQR)
    error: float = (below + right) / (height_px * width_px - STAMP_PX**2)
    return error


def picture_of(pictures: NDArray[np.uint8], number: int) -> Picture:
    """Return the picture of a frame; after the last picture, the first one is used again."""
    picture: Picture = pictures[number % LOOP_FRAMES]
    return picture
