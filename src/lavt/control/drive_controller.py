"""Drive controllers: from a lane and a speed to steering and pedals."""

from __future__ import annotations

from functools import partial
from importlib.metadata import entry_points
from typing import Protocol, runtime_checkable

from lavt.control.compensation import VARIANTS, CompensatingController
from lavt.control.loop_history import LoopHistory
from lavt.control.preset import Preset
from lavt.control.pure_pursuit import (
    RememberedLane,
    clamp,
    lookahead_m,
    pursuit_curvature_per_m,
    pursuit_path_per_m,
    steering_rad,
)
from lavt.control.speed_control import SpeedKeeper
from lavt.control.two_point import TWO_POINT, TwoPointDriver
from lavt.domain import NS_PER_S, Decision, Lane
from lavt.errors import UserError


class DriveController(Protocol):
    """A controller that drives along the detected lane. It reads no clock."""

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return steering, pedals and path for the newest lane and reported speed, at `now_ns` (monotonic)."""
        ...


@runtime_checkable
class StampReader(Protocol):
    """A controller that also uses the stamps of the pictures, which show how much time passed between two pictures."""

    def note_stamp(self, stamp_ns: int) -> None:
        """Note the stamp of the picture whose lane the next call of `decide` gets."""
        ...


@runtime_checkable
class LoopReader(Protocol):
    """A controller that also uses the states of the vehicle and the commands sent, which the driver node notes here."""

    history: LoopHistory


class LaneKeeper:
    """A lane keeper: pure pursuit steering and PI speed control.

    Without a lane it follows the last lane and uses no pedal. For every controller, the driver node decides when a car
    without a lane brakes and stops.

    As in the paper there is no delay compensation: the lane in the picture is used as if it were the present one.
    """

    def __init__(self, preset: Preset, *, wheelbase_m: float) -> None:
        self._preset = preset
        self._wheelbase_m = wheelbase_m
        self._speed_keeper = SpeedKeeper(preset.speed_mps, preset.lane_confidence)
        self._remembered = RememberedLane(preset.lane_confidence)
        self._curvature_per_m = 0.0
        self._decided_ns: int | None = None

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return steering along the lane, or along the last lane detected, with the pedals that keep the speed."""
        step_s = 0.0 if self._decided_ns is None else (now_ns - self._decided_ns) / NS_PER_S
        self._decided_ns = now_ns
        self._remembered.update(lane, speed_mps * step_s, self._curvature_per_m)
        followed, pose = self._remembered.lane, self._remembered.pose
        limit_per_m = self._preset.curvature_limit_per_m(speed_mps, self._wheelbase_m)
        distance_m = lookahead_m(self._preset.lookahead_s, speed_mps)
        self._curvature_per_m = clamp(pursuit_curvature_per_m(followed, distance_m, pose), limit_per_m)
        throttle, brake = self._speed_keeper.pedals(lane.confidence, speed_mps, step_s)
        return Decision(
            steering_rad=steering_rad(self._curvature_per_m, self._wheelbase_m),
            throttle=throttle,
            brake=brake,
            path_curvature_per_m=pursuit_path_per_m(followed, distance_m, limit_per_m, pose),
        )


class ControllerFactory(Protocol):
    """A function that makes a controller from a preset and the wheelbase of the car."""

    def __call__(self, preset: Preset, *, wheelbase_m: float) -> DriveController:
        """Return a controller."""
        ...


CONTROLLERS: dict[str, ControllerFactory] = {
    "lane_keeper": LaneKeeper,
    TWO_POINT: TwoPointDriver,
    **{kind: partial(CompensatingController, variant) for kind, variant in VARIANTS.items()},
}

ENTRY_POINTS = "lavt.controllers"
"""Entry point group under which a package registers a `ControllerFactory`."""


def make_controller(kind: str, preset: Preset, wheelbase_m: float) -> DriveController:
    """Return the controller named `kind` with the settings `preset`; raise `UserError` for an unknown name."""
    return _factory(kind)(preset, wheelbase_m=wheelbase_m)


def _factory(kind: str) -> ControllerFactory:
    if kind in CONTROLLERS:
        return CONTROLLERS[kind]
    registered = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    if kind not in registered:
        known = ", ".join(sorted({*CONTROLLERS, *registered}))
        raise UserError(f"there is no controller {kind!r}; choose one of {known}")
    factory: ControllerFactory = registered[kind].load()
    return factory
