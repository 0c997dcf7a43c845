"""The predictive display of the page from which a person drives: what is predicted for each picture (docs/drive.md).

All times of a prediction are on the vehicle's wall clock, which stamps both the pictures and the states. When a command
takes effect on it follows from the states, too, so no clocks of two machines are compared. This module reads what the
driver node sends and receives, and returns what to draw. It changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lavt.control.loop_history import LoopHistory
from lavt.control.prediction import CarModel, Prediction, RelativePose, predict
from lavt.domain import Now
from lavt.perception.calibration import CalibratedCamera, picture_points
from lavt.transport.console.page_messages import PagePrediction
from lavt.transport.video.stamp import stamp_near

PATH_POINTS: Final = 12
"""Points of each line of the path."""
SIDE_POINTS: Final = 16
"""Points of each side of the outline: the part of a side that the camera sees begins at one of them."""


@dataclass(frozen=True, slots=True)
class Outline:
    """The outline of the car: distances from the rear axle to front and rear, and the width."""

    front_m: float
    rear_m: float
    width_m: float


class PagePredictor:
    """The predictions for the pictures of a driver node, in picture coordinates of `camera`."""

    def __init__(self, model: CarModel, outline: Outline, camera: CalibratedCamera) -> None:
        self.history = LoopHistory()
        """What the driver node sends and receives; the node notes it here."""
        self._model = model
        self._outline = outline
        self._camera = camera
        self._stamp_ns: int | None = None
        """The stamp of the newest decoded picture."""

    def note_picture(self, stamp_ns: int) -> None:
        """Note the stamp of a decoded picture."""
        self._stamp_ns = stamp_ns

    def predict_since(self, picture_ns: int, now_ns: int) -> Prediction | None:
        """Predict from the picture with this stamp to the effect of a command that is sent now.

        None: the vehicle does not drive, the newest state is older than `STATE_AGE_NS`, the loop delay is unknown, or
        the vehicle's clock was set since the picture.
        """
        history = self.history
        if not history.is_comparable(picture_ns, now_ns):
            return None
        delay_ns, state = history.delay.at_ns(now_ns), history.current_state(now_ns)
        if delay_ns is None or state is None or state.safety != "driving":
            return None
        motions = history.motions(picture_ns)
        commands = history.commands(delay_ns, min(picture_ns, state.sent_wall_ns))
        return predict(self._model, motions, commands, picture_ns, now_ns + delay_ns)

    def message(self, unit: int, now: Now) -> PagePrediction | None:
        """Return what to draw over the picture with this RTP timestamp; None: nothing."""
        if self._stamp_ns is None:
            return None
        stamp_ns = stamp_near(unit, self._stamp_ns)
        prediction = self.predict_since(stamp_ns, now.mono_ns)
        return None if prediction is None else draw(self._camera, self._outline, prediction, unit, stamp_ns)


Line = tuple[tuple[float, float], ...]


def draw(
    camera: CalibratedCamera, outline: Outline, prediction: Prediction, unit: int, stamp_ns: int
) -> PagePrediction:
    """Return a prediction in picture coordinates."""
    half_m, front_m = outline.width_m / 2, outline.front_m
    along_m = np.linspace(-outline.rear_m, front_m, SIDE_POINTS)
    around = [*((x_m, half_m) for x_m in along_m), *((x_m, -half_m) for x_m in along_m[::-1])]
    chosen = np.unique(np.linspace(0, len(prediction.path) - 1, PATH_POINTS).round().astype(int))
    path = [prediction.path[index] for index in chosen]
    corners = [(front_m, half_m), (front_m, -half_m)]
    return PagePrediction(
        unit=unit,
        stamp=str(stamp_ns),
        left=_line(camera, [_place(pose, [corners[0]])[0] for pose in path]),
        right=_line(camera, [_place(pose, [corners[1]])[0] for pose in path]),
        ghost=_line(camera, _place(prediction.ghost, around)),
        stop=_line(camera, _place(prediction.standstill, corners)),
    )


def _place(pose: RelativePose, points_m: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return points (ahead, left) of a car in this pose, relative to the pose of the picture."""
    cosine, sine = float(np.cos(pose.heading_rad)), float(np.sin(pose.heading_rad))
    return [
        (pose.x_m + ahead_m * cosine - left_m * sine, pose.y_m + ahead_m * sine + left_m * cosine)
        for ahead_m, left_m in points_m
    ]


def _line(camera: CalibratedCamera, ground_m: Sequence[tuple[float, float]]) -> Line:
    """Return the points in the picture, without those that the camera cannot see or that are far outside."""
    points = picture_points(camera, np.array(ground_m))
    size = np.array([camera.width_px, camera.height_px])
    is_near = (np.abs(points - size / 2) < 2 * size).all(axis=1)  # false for NaN
    return tuple((float(column), float(row)) for column, row in points[is_near].round(1))
