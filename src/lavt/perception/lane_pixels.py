"""Which pixels may be paint: white or yellow, brighter than the road around, and between edges that stand upright.

All thresholds are on 8-bit values, none on brightness itself, which light and exposure decide. They were chosen on
rendered daylight pictures before any drive under delay.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import Picture

Mask = NDArray[np.uint8]
"""0 or 255 for each pixel of a picture or cut-out."""

WHITE_ABOVE_ROAD = 28
"""White paint is this much brighter than the mean around it, which shadows and exposure move as well."""
WHITE_OVER_ROAD = 1.3
"""And so many times as bright: in bright light the grain of asphalt alone exceeds any fixed difference."""
YELLOW_RED_OVER_BLUE = 55
"""Yellow paint has this much less blue than red."""
EDGE_AT_LEAST = 48
"""Of the 3 x 3 Sobel gradient along a row: 12 grey levels from one pixel to the one after the next."""
AROUND_PX = (65, 5)
"""Width and height of "around" at a focal length of 320 px: three times as wide as the nearest mark (20 px at 2 m)."""
MARK_PX = 21
"""Width for a focal length of 320 px within which an edge speaks for the inside of a mark."""


def lane_pixels(region: Picture, scale: float = 1.0) -> Mask:
    """Find the pixels of `region`, (height, width, 3), that may belong to a lane's marks.

    `scale` is the camera's focal length over 320 px: by that much a mark is wider.
    """
    grey = grey_of(region)
    paint = cv2.bitwise_or(white_pixels(grey, scale), yellow_pixels(region))
    return np.asarray(cv2.bitwise_and(paint, edge_pixels(grey, scale)), dtype=np.uint8)


def grey_of(region: Picture) -> NDArray[np.uint8]:
    """Give the brightness of a picture, (height, width)."""
    return np.asarray(cv2.cvtColor(region, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def white_pixels(grey: NDArray[np.uint8], scale: float = 1.0) -> Mask:
    """Find what is brighter than its surroundings, by difference and by ratio; how bright it is does not matter."""
    width, height = AROUND_PX
    around = cv2.blur(grey, (_odd(width * scale), height))
    above = cv2.threshold(cv2.subtract(grey, around), WHITE_ABOVE_ROAD, 255, cv2.THRESH_BINARY)[1]
    over = cv2.threshold(cv2.addWeighted(grey, 1.0, around, -WHITE_OVER_ROAD, 0.0), 0, 255, cv2.THRESH_BINARY)[1]
    return np.asarray(cv2.bitwise_and(above, over), dtype=np.uint8)


def yellow_pixels(region: Picture) -> Mask:
    """Find what is more red than blue by far, as yellow is and grey is not."""
    difference = cv2.subtract(cv2.extractChannel(region, 2), cv2.extractChannel(region, 0))
    return np.asarray(cv2.threshold(difference, YELLOW_RED_OVER_BLUE, 255, cv2.THRESH_BINARY)[1], dtype=np.uint8)


def edge_pixels(grey: NDArray[np.uint8], scale: float = 1.0) -> Mask:
    """Find what is near a change of brightness along the row; patches of light and grass have none so sharp."""
    gradient = cv2.convertScaleAbs(cv2.Sobel(grey, cv2.CV_16S, 1, 0, ksize=3))  # saturates at 255
    sharp = cv2.threshold(gradient, EDGE_AT_LEAST, 255, cv2.THRESH_BINARY)[1]
    near = np.ones((1, _odd(MARK_PX * scale)), dtype=np.uint8)
    return np.asarray(cv2.dilate(sharp, near), dtype=np.uint8)


def _odd(width_px: float) -> int:
    """Round a width to an odd number, which has a middle."""
    return int(width_px) | 1
