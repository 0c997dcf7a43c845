"""The prediction of the car's pose from delayed pictures: where the car will be, and where it can stop.

A person's page shows it, and the controllers of `lavt.control.compensation` steer from it.

The model is the kinematic single-track model at the rear axle, without slip (R. Rajamani, *Vehicle Dynamics and
Control*, 2nd ed., 2012, section 2.2): curvature tan(steering) / wheelbase. The speed stays as last reported, because a
client does not know how strongly the vehicle's pedals act. The wheels follow the commanded angle with a first-order lag
and at a limited rate.

All times are on the vehicle's clock. Nothing here reads a clock.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from lavt.domain import MAX_REPORTED_MPS, MAX_ROAD_WHEEL_RAD, NS_PER_MS, NS_PER_S

STEP_NS: Final = 5 * NS_PER_MS
STOP_STEP_S: Final = 0.05
MAX_GAP_NS: Final = 300 * NS_PER_MS
"""How far the reported motions may be from the picture's time; the vehicle reports one every 20 ms."""
MAX_LOOP_NS: Final = 4 * NS_PER_S
"""The longest loop delay for which there is a prediction: twice the largest age of a picture that a config allows."""


@dataclass(frozen=True, slots=True)
class CarModel:
    """What the prediction knows of the car."""

    wheelbase_m: float
    steering_rate_radps: float
    """The largest rate of the road wheels' angle."""
    steering_lag_s: float
    """The time constant with which the wheels follow; 0: at the largest rate."""
    stop_deceleration_mps2: float = 4.0
    """The deceleration with which the car stops at the stopping line."""


class Motion(NamedTuple):
    """A motion that the vehicle has reported."""

    at_ns: int
    speed_mps: float
    steering_rad: float


class SteeringCommand(NamedTuple):
    """A commanded angle of the road wheels, and when it takes effect."""

    at_ns: int
    steering_rad: float


class RelativePose(NamedTuple):
    """A pose of the rear axle relative to that in the picture: x ahead, y left."""

    x_m: float
    y_m: float
    heading_rad: float


@dataclass(frozen=True, slots=True)
class Prediction:
    """The poses since the picture, and those of a stop that begins now."""

    path: tuple[RelativePose, ...]
    """From the pose in the picture, which is the origin, to the pose at which a command that is sent now takes
    effect."""
    stop: tuple[RelativePose, ...]
    """From there to the standstill."""

    @property
    def ghost(self) -> RelativePose:
        """The pose at which a command that is sent now takes effect."""
        return self.path[-1]

    @property
    def standstill(self) -> RelativePose:
        """The pose in which the car stands, if that command brakes."""
        return self.stop[-1]


class PredictedPath(NamedTuple):
    """The path from the pose in a picture, which is the origin, and the angle of the wheels at its end."""

    path: tuple[RelativePose, ...]
    steering_rad: float


def predict(
    model: CarModel,
    motions: Sequence[Motion],
    commands: Sequence[SteeringCommand],
    picture_ns: int,
    effect_ns: int,
) -> Prediction | None:
    """Predict the path, as `predict_path` does, and a stop at its end."""
    predicted = predict_path(model, motions, commands, picture_ns, effect_ns)
    if predicted is None:
        return None
    target_rad = commands[-1].steering_rad if commands else predicted.steering_rad
    stop = _stop(model, predicted.path[-1], motions[-1].speed_mps, predicted.steering_rad, target_rad)
    return Prediction(predicted.path, stop)


def predict_path(
    model: CarModel,
    motions: Sequence[Motion],
    commands: Sequence[SteeringCommand],
    picture_ns: int,
    effect_ns: int,
) -> PredictedPath | None:
    """Predict from the picture of `picture_ns` to `effect_ns`, when a command that is sent now takes effect.

    Both sequences have the oldest first. Until the newest of `motions`, the car moves as reported; after it, it follows
    `commands`. None: the times or the motions do not suffice, a value is not finite or not possible, or the car rolls
    backwards, of which the camera shows nothing.
    """
    if not 0 <= effect_ns - picture_ns <= MAX_LOOP_NS or not motions:
        return None
    if motions[0].at_ns > picture_ns + MAX_GAP_NS or motions[-1].at_ns < picture_ns - MAX_GAP_NS:
        return None
    if not all(map(_is_possible, motions)) or not all(math.isfinite(command.steering_rad) for command in commands):
        return None
    newest = motions[-1]
    path = [RelativePose(0.0, 0.0, 0.0)]
    for duration_s, speed_mps, steering_rad in _reported(motions, picture_ns, min(newest.at_ns, effect_ns)):
        path.append(_move(path[-1], speed_mps * duration_s, steering_rad, model.wheelbase_m))
    steering_rad, at_ns = newest.steering_rad, newest.at_ns
    target_rad, following = steering_rad, 0
    while at_ns < effect_ns:
        while following < len(commands) and commands[following].at_ns <= at_ns:
            target_rad, following = commands[following].steering_rad, following + 1
        until_ns = min(at_ns + STEP_NS, effect_ns, picture_ns if at_ns < picture_ns else effect_ns)
        duration_s = (until_ns - at_ns) / NS_PER_S
        next_rad = _turn_wheels(model, steering_rad, target_rad, duration_s)
        if at_ns >= picture_ns:
            mean_rad = (steering_rad + next_rad) / 2
            path.append(_move(path[-1], newest.speed_mps * duration_s, mean_rad, model.wheelbase_m))
        steering_rad, at_ns = next_rad, until_ns
    return PredictedPath(tuple(path), steering_rad)


def _is_possible(motion: Motion) -> bool:
    """Return whether a motion is forwards, or standstill, and not beyond any vehicle's; false for NaN."""
    return 0 <= motion.speed_mps < MAX_REPORTED_MPS and -MAX_ROAD_WHEEL_RAD < motion.steering_rad < MAX_ROAD_WHEEL_RAD


def _reported(motions: Sequence[Motion], since_ns: int, until_ns: int) -> Iterator[tuple[float, float, float]]:
    """Yield duration (s), mean speed (m/s) and mean steering (rad) of each interval between reports."""
    inner = [motion for motion in motions if since_ns < motion.at_ns < until_ns]
    if since_ns >= until_ns:
        return
    before = _motion_at(motions, since_ns)
    for after in (*inner, _motion_at(motions, until_ns)):
        yield (
            (after.at_ns - before.at_ns) / NS_PER_S,
            (before.speed_mps + after.speed_mps) / 2,
            (before.steering_rad + after.steering_rad) / 2,
        )
        before = after


def _motion_at(motions: Sequence[Motion], at_ns: int) -> Motion:
    """Interpolate between motions; before the first and after the last, it is theirs."""
    before = next((motion for motion in reversed(motions) if motion.at_ns <= at_ns), motions[0])
    after = next((motion for motion in motions if motion.at_ns > at_ns), motions[-1])
    span_ns = after.at_ns - before.at_ns
    share = (at_ns - before.at_ns) / span_ns if span_ns > 0 else 0.0
    return Motion(
        at_ns,
        before.speed_mps + share * (after.speed_mps - before.speed_mps),
        before.steering_rad + share * (after.steering_rad - before.steering_rad),
    )


def _turn_wheels(model: CarModel, steering_rad: float, target_rad: float, duration_s: float) -> float:
    share = 1.0 - math.exp(-duration_s / model.steering_lag_s) if model.steering_lag_s > 0 else 1.0
    most_rad = model.steering_rate_radps * duration_s
    return steering_rad + min(max(share * (target_rad - steering_rad), -most_rad), most_rad)


def _stop(
    model: CarModel, pose: RelativePose, speed_mps: float, steering_rad: float, target_rad: float
) -> tuple[RelativePose, ...]:
    """Return the poses of a stop with constant deceleration; its length is v^2 / (2 a)."""
    deceleration_mps2 = model.stop_deceleration_mps2
    poses = [pose]
    while speed_mps > 0:
        duration_s = min(STOP_STEP_S, speed_mps / deceleration_mps2)
        next_mps = speed_mps - deceleration_mps2 * duration_s if duration_s == STOP_STEP_S else 0.0
        next_rad = _turn_wheels(model, steering_rad, target_rad, duration_s)
        distance_m = (speed_mps + next_mps) / 2 * duration_s
        poses.append(_move(poses[-1], distance_m, (steering_rad + next_rad) / 2, model.wheelbase_m))
        speed_mps, steering_rad = next_mps, next_rad
    return tuple(poses)


def _move(pose: RelativePose, distance_m: float, steering_rad: float, wheelbase_m: float) -> RelativePose:
    """Return the pose at the end of an arc of this length."""
    half_turn_rad = distance_m * math.tan(steering_rad) / wheelbase_m / 2
    chord_m = distance_m * (math.sin(half_turn_rad) / half_turn_rad if half_turn_rad else 1.0)
    direction_rad = pose.heading_rad + half_turn_rad
    return RelativePose(
        pose.x_m + chord_m * math.cos(direction_rad),
        pose.y_m + chord_m * math.sin(direction_rad),
        pose.heading_rad + 2 * half_turn_rad,
    )
