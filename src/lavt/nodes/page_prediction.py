"""The predictive display of the page from which a person drives: what is predicted for each picture (docs/drive.md).

All times of a prediction are on the vehicle's wall clock, which stamps both the pictures and the states. When a command
takes effect on it follows from the states, too, so no clocks of two machines are compared. This module reads what the
driver node sends and receives, and returns what to draw. It changes nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lavt.control.prediction import CarModel, Motion, Prediction, RelativePose, SteeringCommand, predict
from lavt.domain import NS_PER_MS, NS_PER_S, Now, State
from lavt.perception.calibration import CalibratedCamera, picture_points
from lavt.transport.console.page_messages import PagePrediction
from lavt.transport.video.stamp import stamp_near

MAX_STATES: Final = 256
"""How many states are remembered: five seconds, which is longer than any loop delay with a prediction."""
MAX_COMMANDS: Final = 512
STATE_AGE_NS: Final = 300 * NS_PER_MS
"""Nothing is predicted from an older state."""
STATE_GAP_NS: Final = 100 * NS_PER_MS
"""Two states that are further apart do not tell when a command between them was applied."""
DELAY_WINDOW_NS: Final = NS_PER_S // 2
"""The delay of the commands is measured from the states of this time."""
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


class EffectDelay:
    """When a command takes effect: the vehicle's wall clock at that time minus this machine's clock at its sending.

    A command was applied between the last state that does not report it and the first state that does. The delay lies
    between the largest lower and the smallest upper bound of the last `DELAY_WINDOW_NS`.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, int]] = deque(maxlen=MAX_COMMANDS)
        """Sequence numbers and send times of commands that the vehicle has not applied yet."""
        self._newest: State | None = None
        self._bounds: deque[tuple[int, int, int]] = deque(maxlen=MAX_STATES)
        """Arrival of a state, lower and upper bound."""

    def note_command(self, sequence: int, now_ns: int) -> None:
        """Note a command that is sent now."""
        self._sent.append((sequence, now_ns))

    def note_state(self, state: State, now_ns: int) -> None:
        """Note a state that arrived now."""
        before, self._newest = self._newest, state
        sent_ns = None
        while self._sent and self._sent[0][0] <= state.applied_sequence:
            sequence, at_ns = self._sent.popleft()
            sent_ns = at_ns if sequence == state.applied_sequence else None
        if sent_ns is None or before is None or before.instance != state.instance:
            return
        if state.sent_wall_ns <= before.sent_wall_ns:  # the vehicle's clock was set back
            self._bounds.clear()
        if 0 < state.sent_wall_ns - before.sent_wall_ns <= STATE_GAP_NS:
            self._bounds.append((now_ns, before.sent_wall_ns - sent_ns, state.sent_wall_ns - sent_ns))

    def at_ns(self, now_ns: int) -> int | None:
        """Return the delay; None: the vehicle has reported no newly applied command lately."""
        while self._bounds and self._bounds[0][0] < now_ns - DELAY_WINDOW_NS:
            self._bounds.popleft()
        if not self._bounds:
            return None
        return (max(low for _, low, _ in self._bounds) + min(high for _, _, high in self._bounds)) // 2


class PagePredictor:
    """The predictions for the pictures of a driver node, in picture coordinates of `camera`."""

    def __init__(self, model: CarModel, outline: Outline, camera: CalibratedCamera) -> None:
        self._model = model
        self._outline = outline
        self._camera = camera
        self._delay = EffectDelay()
        self._states: deque[State] = deque(maxlen=MAX_STATES)
        self._state_ns = 0
        """When the newest state arrived."""
        self._commands: deque[tuple[int, float]] = deque(maxlen=MAX_COMMANDS)
        """Send times and steering angles of commands."""
        self._stamp_ns: int | None = None
        """The stamp of the newest decoded picture."""

    def note_command(self, sequence: int, steering_rad: float, now_ns: int) -> None:
        """Note a command that is sent now."""
        self._delay.note_command(sequence, now_ns)
        self._commands.append((now_ns, steering_rad))

    def note_state(self, state: State, now_ns: int) -> None:
        """Note a newer state of a vehicle that this client has control of."""
        if self._states and self._states[-1].instance != state.instance:
            self.forget()
        self._delay.note_state(state, now_ns)
        self._states.append(state)
        self._state_ns = now_ns

    def forget(self) -> None:
        """Note that this client has no control, or that the vehicle's server is another process."""
        self._delay = EffectDelay()
        self._states.clear()
        self._commands.clear()

    def note_picture(self, stamp_ns: int) -> None:
        """Note the stamp of a decoded picture."""
        self._stamp_ns = stamp_ns

    def predict_since(self, picture_ns: int, now_ns: int) -> Prediction | None:
        """Predict from the picture with this stamp to the effect of a command that is sent now.

        None: the vehicle does not drive, the newest state is older than `STATE_AGE_NS`, or the loop delay is unknown.
        """
        delay_ns = self._delay.at_ns(now_ns)
        is_driving = self._states and self._states[-1].safety == "driving" and now_ns - self._state_ns < STATE_AGE_NS
        if delay_ns is None or not is_driving:
            return None
        motions, commands = self._motions(picture_ns), self._effects(delay_ns, picture_ns)
        return predict(self._model, motions, commands, picture_ns, now_ns + delay_ns)

    def _motions(self, since_ns: int) -> list[Motion]:
        """Return the reported motions, the oldest first, beginning with the last one before a time."""
        motions: list[Motion] = []
        for state in reversed(self._states):
            motions.append(Motion(state.sent_wall_ns, state.speed_mps, state.steering_rad))
            if state.sent_wall_ns <= since_ns:
                break
        return motions[::-1]

    def _effects(self, delay_ns: int, picture_ns: int) -> list[SteeringCommand]:
        """Return the commands that count, the oldest first: none that a later one replaces before the newest state."""
        since_ns = min(picture_ns, self._states[-1].sent_wall_ns)
        commands: list[SteeringCommand] = []
        for at_ns, steering_rad in reversed(self._commands):
            commands.append(SteeringCommand(at_ns + delay_ns, steering_rad))
            if commands[-1].at_ns <= since_ns:
                break
        return commands[::-1]

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
