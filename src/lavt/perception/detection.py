"""What a lane detector is: a detector of lanes, or a finder of paint before LAVT's own fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lavt.domain import Lane, Picture
from lavt.perception.calibration import CalibratedCamera

LANE_WIDTH_M = 3.5
"""The lane's width until it has been measured."""
TRACK_CONFIDENCE = 0.2
"""By default a lane with less confidence is not tracked. One line that is visible over 40 % of the length gives 0.2."""


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """The settings that every detector gets."""

    stamped: bool = True
    """Whether the pictures have the time stamp in the top left corner."""
    lane_width_m: float = LANE_WIDTH_M
    """The lane's width until it has been measured."""
    track_confidence: float = TRACK_CONFIDENCE
    """The lowest confidence of a lane that is tracked."""
    file: str = ""
    """The file with the detector's own settings; empty: none was named."""


@runtime_checkable
class PictureDetector(Protocol):
    """A detector of lanes in a sequence of pictures."""

    def forget(self) -> None:
        """Drop the memory of earlier pictures: the next picture can be of another place."""
        ...

    def detect(self, picture_bgr: Picture, /) -> Lane:
        """Return the lane in the next picture, (h, w, 3); without a lane its confidence is 0."""
        ...


@runtime_checkable
class PaintFinder(Protocol):
    """A finder of the paint of a lane's marks in a picture, for LAVT's own fit."""

    def find_paint(self, picture_bgr: Picture, /) -> NDArray[np.uint8]:
        """Return a mask, (h, w), of a picture, (h, w, 3): 255 where the road is painted, 0 elsewhere."""
        ...


class DetectorFactory(Protocol):
    """A function that makes a detector, which a package registers in the entry point group `lavt.detectors`."""

    def __call__(self, camera: CalibratedCamera, settings: DetectorSettings, /) -> PictureDetector | PaintFinder:
        """Return a detector for the pictures of a camera; raise `UserError` for settings that cannot be used."""
        ...
