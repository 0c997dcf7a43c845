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
from lavt.control.speed_pi import SpeedPi, confident_speed_mps
from lavt.domain import NS_PER_S, Decision, Lane
from lavt.errors import UserError

WHEEL_LIMIT_RAD = 0.5
"""Largest road wheel angle of a car."""


class DriveController(Protocol):
    """A controller that drives by the detected lane and has no clock of its own."""

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

The lookahead is the smallest one with 30 degrees of phase margin in the sampled-data model of
`lavt.experiment.boundary.delay_margin`, at 30 km/h and 81 ms from exposure to wheel command (`paper_wifi5`: 62 + 9 ms,
and 10 ms of processing), rounded up: `benchmarks/find_designed_preset.py` prints it. 3 m/s2 is the lateral acceleration
that a vehicle allows by default. Valid for the simulator's default car (steering lag 0.12 s, no dead time).
"""

PAPER_CALIBRATED = Preset("paper_calibrated", lookahead_s=0.74, steering_limit_rad=0.21)
"""The preset that reproduces the paper, which gives no gains; fitted only to where the paper's completion rate falls.

Lookahead and steering limit (5.2 m/s2 at 30 km/h) put the collapse between L2 and L3; every other figure follows from
them. They leave a phase margin of 19 degrees at L0, too little for a designed controller. Valid for the simulator's
default car.
"""

PRESETS = {preset.name: preset for preset in (DESIGNED, PAPER_CALIBRATED)}


class LaneKeeper:
    """A lane keeper: pure pursuit steering and PI speed control. Without a lane it follows the last one, unpowered.

    The driver node decides, for every controller alike, when to brake and to stop without a lane.

    As in the paper there is no delay compensation: the lane in the picture is taken as the present one.
    """

    def __init__(
        self, preset: Preset, *, wheelbase_m: float, max_acceleration_mps2: float, max_braking_mps2: float
    ) -> None:
        self._preset = preset
        self._wheelbase_m = wheelbase_m
        self._speed_pi = SpeedPi(max_acceleration_mps2, max_braking_mps2)
        self._lane = Lane((0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0)
        self._pose = ORIGIN
        self._curvature_per_m = 0.0
        self._decided_ns: int | None = None

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return steering along the lane, or along the last one seen, with the pedals that keep the speed."""
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
        throttle, brake = self._speed_pi.pedals(self._acceleration_mps2(lane.confidence, speed_mps, step_s))
        return Decision(
            steering_rad=steering_rad(self._curvature_per_m, self._wheelbase_m),
            throttle=throttle,
            brake=brake,
            path_curvature_per_m=pursuit_path_per_m(self._lane, distance_m, limit_per_m, self._pose),
        )

    def _acceleration_mps2(self, confidence: float, speed_mps: float, step_s: float) -> float:
        if confidence < LANE_CONFIDENCE:
            return 0.0  # no acceleration without a lane, and no jolt for each failed picture
        target_mps = confident_speed_mps(self._preset.speed_mps, confidence)
        return self._speed_pi.acceleration_mps2(target_mps, speed_mps, step_s)

    def _curvature_limit_per_m(self, speed_mps: float) -> float:
        """Return the smaller of the steering limit and the lateral acceleration limit at this speed, as a curvature."""
        by_wheel = curvature_per_m(self._preset.steering_limit_rad, self._wheelbase_m)
        return min(by_wheel, self._preset.lateral_limit_mps2 / max(speed_mps, 1.0) ** 2)


class ControllerFactory(Protocol):
    """A function that makes a controller from a preset and properties of the car."""

    def __call__(
        self, preset: Preset, *, wheelbase_m: float, max_acceleration_mps2: float, max_braking_mps2: float
    ) -> DriveController:
        """Return a controller; the accelerations are those of full throttle and of full brake, both positive."""
        ...


CONTROLLERS: dict[str, ControllerFactory] = {"lane_keeper": LaneKeeper}

ENTRY_POINTS = "lavt.controllers"
"""Entry point group under which a package registers a `ControllerFactory`."""


def make_controller(
    kind: str, preset: Preset, wheelbase_m: float, max_acceleration_mps2: float = 2.0, max_braking_mps2: float = 6.0
) -> DriveController:
    """Return the controller named `kind` with the settings `preset`; raise `UserError` for an unknown name.

    The accelerations are the car's at full throttle and full brake, both positive; the defaults are the simulator's.
    """
    return _factory(kind)(
        preset,
        wheelbase_m=wheelbase_m,
        max_acceleration_mps2=max_acceleration_mps2,
        max_braking_mps2=max_braking_mps2,
    )


def find_preset(name: str) -> Preset:
    """Return the preset of that name; raise `UserError` for an unknown name."""
    if name not in PRESETS:
        raise UserError(f"there is no preset {name!r}; choose one of {', '.join(sorted(PRESETS))}")
    return PRESETS[name]


def _factory(kind: str) -> ControllerFactory:
    if kind in CONTROLLERS:
        return CONTROLLERS[kind]
    added = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    if kind not in added:
        known = ", ".join(sorted({*CONTROLLERS, *added}))
        raise UserError(f"there is no controller {kind!r}; choose one of {known}")
    factory: ControllerFactory = added[kind].load()
    return factory
