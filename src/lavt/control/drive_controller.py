"""Drive controllers: from a lane and a speed to steering and pedals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Protocol

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.control.pure_pursuit import (
    ORIGIN,
    clamp,
    curvature_per_m,
    lookahead_m,
    move_along_arc,
    pursuit_curvature_per_m,
    pursuit_path_per_m,
    steering_rad,
)
from lavt.domain import NS_PER_S, Decision, Lane
from lavt.errors import UserError

WHEEL_LIMIT_RAD = 0.5
"""Largest road wheel angle of a car."""
MAX_ACCELERATION_MPS2 = 2.0
"""Acceleration of the simulator's car at full throttle."""
MAX_BRAKING_MPS2 = 6.0
"""Deceleration of the simulator's car at full brake."""

PROPORTIONAL_PER_S = 0.8
"""Acceleration in m/s2 for each m/s of speed error. The loop's time constant, 1.3 s, is long compared with pedal lag
plus network delay."""
INTEGRAL_PER_S2 = 0.1
"""Change of the integral term in m/s2 per second, for each m/s of error. The term compensates drag and slope within
about 8 s."""
GENTLE_BRAKING_MPS2 = 1.5
"""Largest deceleration that speed control requests, so that a few pictures with a badly visible lane cause no jolt."""
INTEGRATION_ERROR_LIMIT_MPS = 0.5
"""A larger error is not integrated: it is a transient, not an offset."""
MAX_INTEGRAL_MPS2 = 0.5
"""Largest integral term; drag and a slope of 5 % need no more."""
FULL_SPEED_CONFIDENCE = 0.5
"""From this confidence on, the car drives at full speed. One line that is visible over the whole length gives this
confidence, and so do two lines that are visible over half of the length."""
MIN_SPEED_SHARE = 0.4
"""Share of the full speed at low confidence: 12 km/h instead of 30, fast enough to reach the next marks."""
MAX_STEP_S = 0.1
"""The longest step that the integral term takes for one decision."""


class DriveController(Protocol):
    """A controller that drives along the detected lane. It reads no clock."""

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return steering, pedals and path for the newest lane and reported speed, at `now_ns` (monotonic)."""
        ...


@dataclass(frozen=True, slots=True)
class Preset:
    """A named set of lane keeper settings."""

    name: str
    lookahead_s: float
    lateral_limit_mps2: float = math.inf
    steering_limit_rad: float = WHEEL_LIMIT_RAD
    speed_mps: float = 30 / 3.6


DESIGNED = Preset("designed", lookahead_s=1.01, lateral_limit_mps2=3.0)
"""The default preset, designed from a model and not tuned under delay.

The lookahead is the smallest one with 30 degrees of phase margin at 30 km/h, rounded up. The margin is computed by the
sampled-data model of `lavt.experiment.boundary.delay_margin`, for 81 ms from exposure to wheel command: 62 + 9 ms of
the network `paper_wifi5`, and 10 ms of processing. `benchmarks/find_designed_preset.py` prints the lookahead. 3 m/s2 is
the lateral acceleration that a vehicle allows by default. The preset is valid for the simulator's default car (steering
lag 0.12 s, no dead time).
"""

PAPER_CALIBRATED = Preset("paper_calibrated", lookahead_s=0.74, steering_limit_rad=0.21)
"""The preset that reproduces the paper, which publishes no gains.

Lookahead and steering limit (5.2 m/s2 at 30 km/h) were chosen so that the completion rate collapses between the
conditions L2 and L3, as in the paper; nothing else was fitted. The lookahead leaves a phase margin of 19 degrees at L0,
too little for a designed controller. The preset is valid for the simulator's default car.
"""

PRESETS = {preset.name: preset for preset in (DESIGNED, PAPER_CALIBRATED)}


class SpeedPiController:
    """A PI speed controller; its only state is the integral term."""

    def __init__(self) -> None:
        self._integral_mps2 = 0.0

    def acceleration_mps2(self, target_mps: float, speed_mps: float, step_s: float) -> float:
        """Return the acceleration to command now, `step_s` after the last call.

        The result is between -`GENTLE_BRAKING_MPS2` and `MAX_ACCELERATION_MPS2`.
        """
        error_mps = target_mps - speed_mps
        if abs(error_mps) < INTEGRATION_ERROR_LIMIT_MPS:
            integral_mps2 = self._integral_mps2 + INTEGRAL_PER_S2 * error_mps * min(step_s, MAX_STEP_S)
            self._integral_mps2 = min(max(integral_mps2, -MAX_INTEGRAL_MPS2), MAX_INTEGRAL_MPS2)
        unlimited_mps2 = PROPORTIONAL_PER_S * error_mps + self._integral_mps2
        return min(max(unlimited_mps2, -GENTLE_BRAKING_MPS2), MAX_ACCELERATION_MPS2)


def pedals(acceleration_mps2: float) -> tuple[float, float]:
    """Return throttle and brake for an acceleration, each in [0, 1] and at least one of them 0."""
    if acceleration_mps2 >= 0:
        return min(acceleration_mps2 / MAX_ACCELERATION_MPS2, 1.0), 0.0
    return 0.0, min(-acceleration_mps2 / MAX_BRAKING_MPS2, 1.0)


def speed_for_confidence_mps(speed_mps: float, confidence: float) -> float:
    """Return the speed to drive at: `speed_mps` times a share that depends on the confidence.

    The share rises in proportion to the confidence, from `MIN_SPEED_SHARE` to 1 at `FULL_SPEED_CONFIDENCE`.
    """
    return speed_mps * min(max(confidence / FULL_SPEED_CONFIDENCE, MIN_SPEED_SHARE), 1.0)


class LaneKeeper:
    """A lane keeper: pure pursuit steering and PI speed control.

    Without a lane it follows the last lane and uses no pedal. For every controller, the driver node decides when a car
    without a lane brakes and stops.

    As in the paper there is no delay compensation: the lane in the picture is used as if it were the present one.
    """

    def __init__(self, preset: Preset, *, wheelbase_m: float) -> None:
        self._preset = preset
        self._wheelbase_m = wheelbase_m
        self._speed_controller = SpeedPiController()
        self._lane = Lane((0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0)
        self._pose = ORIGIN
        self._curvature_per_m = 0.0
        self._decided_ns: int | None = None

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return steering along the lane, or along the last lane detected, with the pedals that keep the speed."""
        step_s = 0.0 if self._decided_ns is None else (now_ns - self._decided_ns) / NS_PER_S
        self._decided_ns = now_ns
        if lane.confidence >= LANE_CONFIDENCE:
            self._lane, self._pose = lane, ORIGIN
        else:
            # Dead reckoning relative to the last lane, from the speed and the commanded curvature.
            self._pose = move_along_arc(self._pose, speed_mps * step_s, self._curvature_per_m)
        limit_per_m = self._curvature_limit_per_m(speed_mps)
        distance_m = lookahead_m(self._preset.lookahead_s, speed_mps)
        self._curvature_per_m = clamp(pursuit_curvature_per_m(self._lane, distance_m, self._pose), limit_per_m)
        throttle, brake = pedals(self._acceleration_mps2(lane.confidence, speed_mps, step_s))
        return Decision(
            steering_rad=steering_rad(self._curvature_per_m, self._wheelbase_m),
            throttle=throttle,
            brake=brake,
            path_curvature_per_m=pursuit_path_per_m(self._lane, distance_m, limit_per_m, self._pose),
        )

    def _acceleration_mps2(self, confidence: float, speed_mps: float, step_s: float) -> float:
        if confidence < LANE_CONFIDENCE:
            return 0.0  # no throttle without a lane; no brake either, or the car would jolt at each failed picture
        target_mps = speed_for_confidence_mps(self._preset.speed_mps, confidence)
        return self._speed_controller.acceleration_mps2(target_mps, speed_mps, step_s)

    def _curvature_limit_per_m(self, speed_mps: float) -> float:
        """Return the smaller of the steering limit and the lateral acceleration limit at this speed, as a curvature."""
        steering_limit_per_m = curvature_per_m(self._preset.steering_limit_rad, self._wheelbase_m)
        return min(steering_limit_per_m, self._preset.lateral_limit_mps2 / max(speed_mps, 1.0) ** 2)


class ControllerFactory(Protocol):
    """A function that makes a controller from a preset and the wheelbase of the car."""

    def __call__(self, preset: Preset, *, wheelbase_m: float) -> DriveController:
        """Return a controller."""
        ...


CONTROLLERS: dict[str, ControllerFactory] = {"lane_keeper": LaneKeeper}

ENTRY_POINTS = "lavt.controllers"
"""Entry point group under which a package registers a `ControllerFactory`."""


def make_controller(kind: str, preset: Preset, wheelbase_m: float) -> DriveController:
    """Return the controller named `kind` with the settings `preset`; raise `UserError` for an unknown name."""
    return _factory(kind)(preset, wheelbase_m=wheelbase_m)


def find_preset(name: str) -> Preset:
    """Return the preset of that name; raise `UserError` for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"there is no preset {name!r}; choose one of {', '.join(sorted(PRESETS))}")
    return PRESETS[name]


def _factory(kind: str) -> ControllerFactory:
    if kind in CONTROLLERS:
        return CONTROLLERS[kind]
    registered = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    if kind not in registered:
        known = ", ".join(sorted({*CONTROLLERS, *registered}))
        raise UserError(f"there is no controller {kind!r}; choose one of {known}")
    factory: ControllerFactory = registered[kind].load()
    return factory
