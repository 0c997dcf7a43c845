"""Paint in the view from above: stripes as narrow as a marking, brighter or yellower than the road on both sides.

A surface beside a dark wall or in the sun beside a shadow is brighter than one of its sides, but not than both. Yellow
paint on light concrete has hardly any contrast in brightness, so yellow is looked for in a channel of its own. No
threshold is an absolute brightness, which depends on light and exposure.

All thresholds are for 8-bit values. They were chosen on rendered pictures (`benchmarks/degraded.py`) and on the seen
part of the real ones (`benchmarks/real_roads.py`), and not on drives under delay.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lavt.domain import Picture
from lavt.perception.bird_eye import GroundGrid

Mask = NDArray[np.uint8]
"""0 or 255 for each cell of the view from above."""
Channel = NDArray[np.uint8]
"""One value for each cell of the view from above."""

BESIDE_M = 0.40
"""Distance from a cell to the middle of the road beside it. From the middle of a mark of up to half a metre, which
includes double lines, this is beyond the mark."""
BESIDE_WIDTH_M = 0.25
"""Width of the road beside a cell whose mean is compared."""
ALONG_M = 0.3
"""Length along the road over which values are averaged, because paint is long and noise is not."""
DESPECKLE_CELLS = 3
"""Side of the square whose median replaces each value: single white or black pixels vanish."""
WHITE_ABOVE_ROAD = 12
"""White paint is this much brighter than the brighter side."""
WHITE_TO_ROAD_RATIO = 1.1
"""White paint is also this many times as bright as the brighter side, because in bright light the grain of asphalt and
concrete exceeds any fixed difference."""
YELLOW_ABOVE_ROAD = 22
"""The smaller one of red and green exceeds blue by this much more in yellow paint than on either side."""
PATCH_CELLS = (3, 5)
"""Width and length of the area around a cell that must contain paint."""
MIN_PAINTED_SHARE = 0.33
"""Share of this area that must be paint: a line one cell wide along the road, straight or slanted."""


def lane_paint(view: Picture, grid: GroundGrid) -> Mask:
    """Return a mask of the cells of a view from above, (rows, columns, 3), that can be paint of a lane's marks."""
    return without_specks(np.asarray(cv2.bitwise_or(white_paint(view, grid), yellow_paint(view, grid)), dtype=np.uint8))


def brightness_of(view: Picture) -> Channel:
    """Return the brightness of a view, (rows, columns)."""
    return np.asarray(cv2.cvtColor(view, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def yellowness_of(view: Picture) -> Channel:
    """Return by how much red and green both exceed blue in a view, (rows, columns); 0 for grey, red and green."""
    blue, green, red = cv2.split(view)
    return np.asarray(cv2.subtract(cv2.min(green, red), blue), dtype=np.uint8)


def white_paint(view: Picture, grid: GroundGrid) -> Mask:
    """Return a mask of narrow stripes that are brighter than both sides, by difference and by ratio."""
    return _stripes(brightness_of(view), grid, WHITE_ABOVE_ROAD, WHITE_TO_ROAD_RATIO)


def yellow_paint(view: Picture, grid: GroundGrid) -> Mask:
    """Return a mask of narrow stripes that are yellower than both sides."""
    return _stripes(yellowness_of(view), grid, YELLOW_ABOVE_ROAD)


def without_specks(paint: Mask) -> Mask:
    """Return paint without the cells that have too little paint around them along the road."""
    filled = cv2.threshold(cv2.blur(paint, PATCH_CELLS), 255 * MIN_PAINTED_SHARE, 255, cv2.THRESH_BINARY)[1]
    return np.asarray(cv2.bitwise_and(paint, filled), dtype=np.uint8)


def _stripes(channel: Channel, grid: GroundGrid, above: int, ratio: float | None = None) -> Mask:
    """Return a mask of the cells whose value exceeds the larger one of both sides by a difference and by a ratio."""
    clean = cv2.medianBlur(channel, DESPECKLE_CELLS)
    rows, reach = round(ALONG_M / grid.step_x_m), round(BESIDE_M / grid.step_y_m)
    # A mean along the road alone: cv2.blur would take nearly twice the time.
    own = cv2.sepFilter2D(clean, -1, np.ones(1), np.full(rows, 1 / rows))[:, reach:-reach]
    beside = cv2.blur(clean, (round(BESIDE_WIDTH_M / grid.step_y_m), rows))
    larger = cv2.max(beside[:, : -2 * reach], beside[:, 2 * reach :])
    stripes = cv2.threshold(cv2.subtract(own, larger), above, 255, cv2.THRESH_BINARY)[1]
    if ratio is not None:
        exceeds = cv2.threshold(cv2.addWeighted(own, 1.0, larger, -ratio, 0.0), 0, 255, cv2.THRESH_BINARY)[1]
        stripes = cv2.bitwise_and(stripes, exceeds)
    mask = np.zeros_like(channel)  # a cell at the rim has no second side
    mask[:, reach:-reach] = stripes
    return mask
