"""Lane-mark pixels: white or yellow, brighter than the surrounding road, and near vertical edges.

All thresholds are for 8-bit values. No threshold is an absolute brightness, which depends on light and exposure. The
thresholds were chosen on rendered daylight pictures before any drive under delay.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import Picture

Mask = NDArray[np.uint8]
"""0 or 255 for each pixel of a picture or crop."""

WHITE_ABOVE_ROAD = 28
"""White paint is this much brighter than the mean around it. Shadows and exposure change both in the same way."""
WHITE_TO_ROAD_RATIO = 1.3
"""White paint is also this many times as bright as the mean around it, because in bright light the grain of asphalt
exceeds any fixed difference."""
YELLOW_RED_MINUS_BLUE = 55
"""Yellow paint has this much less blue than red."""
MIN_EDGE_GRADIENT = 48
"""Minimum 3 x 3 Sobel gradient along a row: 12 grey levels between pixels two columns apart."""
SURROUNDINGS_PX = (65, 5)
"""Width and height of the surroundings at a focal length of 320 px: three times as wide as the nearest mark (20 px at 2
m)."""
MARK_PX = 21
"""Width of the area around an edge that can belong to the same mark, at a focal length of 320 px."""


def lane_pixels(region: Picture, scale: float = 1.0) -> Mask:
    """Return a mask of the pixels of `region`, (height, width, 3), that can belong to a lane's marks.

    `scale` is the camera's focal length divided by 320 px; marks are wider by this factor.
    """
    grey = grey_of(region)
    paint = cv2.bitwise_or(white_pixels(grey, scale), yellow_pixels(region))
    return np.asarray(cv2.bitwise_and(paint, edge_pixels(grey, scale)), dtype=np.uint8)


def grey_of(region: Picture) -> NDArray[np.uint8]:
    """Return the brightness of a picture, (height, width)."""
    return np.asarray(cv2.cvtColor(region, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def white_pixels(grey: NDArray[np.uint8], scale: float = 1.0) -> Mask:
    """Return a mask of pixels brighter than their surroundings, both by difference and by ratio."""
    width, height = SURROUNDINGS_PX
    around = cv2.blur(grey, (_odd(width * scale), height))
    by_difference = cv2.threshold(cv2.subtract(grey, around), WHITE_ABOVE_ROAD, 255, cv2.THRESH_BINARY)[1]
    excess = cv2.addWeighted(grey, 1.0, around, -WHITE_TO_ROAD_RATIO, 0.0)
    by_ratio = cv2.threshold(excess, 0, 255, cv2.THRESH_BINARY)[1]
    return np.asarray(cv2.bitwise_and(by_difference, by_ratio), dtype=np.uint8)


def yellow_pixels(region: Picture) -> Mask:
    """Return a mask of pixels with much more red than blue, which yellow has and grey has not."""
    difference = cv2.subtract(cv2.extractChannel(region, 2), cv2.extractChannel(region, 0))
    return np.asarray(cv2.threshold(difference, YELLOW_RED_MINUS_BLUE, 255, cv2.THRESH_BINARY)[1], dtype=np.uint8)


def edge_pixels(grey: NDArray[np.uint8], scale: float = 1.0) -> Mask:
    """Return a mask of pixels near a sharp edge along the row; patches of light and grass have softer edges."""
    gradient = cv2.convertScaleAbs(cv2.Sobel(grey, cv2.CV_16S, 1, 0, ksize=3))  # saturates at 255
    sharp = cv2.threshold(gradient, MIN_EDGE_GRADIENT, 255, cv2.THRESH_BINARY)[1]
    near = np.ones((1, _odd(MARK_PX * scale)), dtype=np.uint8)
    return np.asarray(cv2.dilate(sharp, near), dtype=np.uint8)


def _odd(width_px: float) -> int:
    """Return an odd integer width, which has a middle pixel."""
    return int(width_px) | 1
