"""Safe stops whose last command arrives at each metre of a route's curves.

A route is driven once in virtual time at L0. The car starts at 30 km/h, because the curves of the key routes come
before it could reach that speed. Pictures are rendered and the lane is detected in them (`fidelity: pixels`), so that
the paths in the commands have realistic errors; leaving out the codec halves the time. At each metre the actuator node
and its car are copied. The copy continues without commands until the car is stationary. A station is a distance along
the route, in metres.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, repeat
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from unittest.mock import patch

import numpy as np

from lavt.config import RunConfig
from lavt.config_file import parse_config
from lavt.control import speed_control
from lavt.domain import NS_PER_S, Now
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import VirtualLoop, build_loop
from lavt.node import WAKE, Message
from lavt.nodes.actuator import ActuatorNode
from lavt.runtime.pipeline import run_stages
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.simulator import Simulator

ROUTES = ("a", "a_key", "b", "b_key", "c", "c_key")
SPEED_MPS = 30 / 3.6
LEAD_M = 16.0
"""The first stop of a curve begins this far before the curve. The car covers 14 m after its last command, so that this
stop ends near the curve's beginning."""
FIRST_STOP_M = 5.0
"""No stop begins before this station. A drive begins up to 2 m into its route, and the first command from a picture
that was taken at 30 km/h is accepted 3 m later."""
ALLOWED_BEYOND_M = 0.3
"""Allowed distance of a corner of the body beyond the lane's edge."""


@dataclass(frozen=True, slots=True)
class Curve:
    """A piece of a route that bends to one side only."""

    route: str
    from_m: float
    to_m: float
    radius_m: float
    """The smallest radius; left positive."""
    first_m: float
    """Station of the first stop: `LEAD_M` before the curve, but not in the previous curve."""


@dataclass(frozen=True, slots=True)
class Stop:
    """The course of the car after its last command."""

    at_m: float
    """Station of the rear axle when the last command was accepted."""
    speed_mps: float
    """Speed at that station."""
    beyond_m: float
    """Largest distance of a corner of the body beyond the lane's edge; negative inside the lane."""
    covered_m: float
    final_state: str
    """Safety state at standstill."""


class StopPair(NamedTuple):
    """Two stops after the same last command."""

    curve: Curve
    followed: Stop
    """With path following."""
    held: Stop
    """Without path following: the wheel keeps its angle."""


def curves(route: str, road: Road) -> list[Curve]:
    """Return the curves of a route: its segments that are not straight, joined if they bend to the same side."""
    found: list[Curve] = []
    station_m, first_allowed_m = road.first_m, FIRST_STOP_M
    for bend, pieces in groupby(
        road.segments, key=lambda segment: (segment.curvature_per_m > 0) - (segment.curvature_per_m < 0)
    ):
        segments = list(pieces)
        end_m = station_m + sum(segment.length_m for segment in segments)
        if bend and station_m < road.route_length_m and end_m > 0:
            tightest = max((segment.curvature_per_m for segment in segments), key=abs)
            end_m = min(end_m, road.route_length_m)
            found.append(
                Curve(route, max(station_m, 0.0), end_m, 1 / tightest, max(station_m - LEAD_M, first_allowed_m))
            )
            first_allowed_m = end_m
        station_m = end_m
    return found


def metres(curve: Curve) -> range:
    """Return the stations of the last command, a metre apart."""
    return range(math.ceil(curve.first_m), math.floor(curve.to_m) + 1)


def stops(route: str, condition: str = "L0") -> Iterator[StopPair]:
    """Drive a route, and yield the stops from each metre of each curve, with and without path following."""
    config = {
        "vehicle": {"route": route, "scenery": "none"},
        "network": {"inherent": "paper_wifi5", "condition": condition},
        "record": {"video": False},
        "fidelity": "pixels",
    }
    with TemporaryDirectory() as directory:
        loop = build_loop(plan_run(parse_config(RunConfig, config, "the stops")), Path(directory) / "run")
        car = actuator_of(loop).vehicle
        assert isinstance(car, Simulator)
        gate = actuator_of(loop).gate
        assert loop.runtime.run(10 * NS_PER_S, lambda: gate.state == "driving" and gate.epoch.command is not None)
        car._car.motion.speed_mps, car._car.motion.brake = SPEED_MPS, 0.0
        for curve in curves(route, car._route_monitor._road):
            for metre in metres(curve):
                _drive_to(loop, car, metre)
                node = _copy(actuator_of(loop))
                node_without_path = _copy(node)
                node_without_path.gate.watchdog._path.clear_path()  # disables path following
                yield StopPair(curve, _stop(node), _stop(node_without_path))
        for writer in loop.writers:
            writer.close()


@dataclass(frozen=True, slots=True)
class FullThrottleStop:
    """A safe stop after a last command with full throttle."""

    stop: Stop
    throttle: float
    """Throttle of the car, which follows the pedal with a lag, at the last command."""
    since_picture_m: float
    """Distance from the place where the last command's picture was taken to standstill."""


def full_throttle_stops(delay_ms: float, start_mps: float, duration_s: float = 5.0) -> Iterator[FullThrottleStop]:
    """Drive a straight road with full throttle in every command, and yield a safe stop after every third command.

    The car starts at `start_mps`. `delay_ms` is added to the video.
    """
    config = {
        "vehicle": {"route": "straight"},
        "network": {"inherent": "paper_wifi5", "condition": "L0", "video": {"delay_ms": delay_ms}},
        "controller": {"lookahead_s": 2.4},  # stable at any of the delays
        "safety": {"picture_age_limit_ms": 2000.0},
        "fidelity": "geometry",
    }
    with TemporaryDirectory() as directory, patch.object(speed_control, "pedals", lambda *_: (1.0, 0.0)):
        loop = build_loop(plan_run(parse_config(RunConfig, config, "the stops")), Path(directory) / "run")
        node, car = actuator_of(loop), actuator_of(loop).vehicle
        gate, watchdog = node.gate, node.gate.watchdog
        assert isinstance(car, Simulator)
        motion = car._car.motion
        assert loop.runtime.run(10 * NS_PER_S, lambda: gate.state == "driving" and gate.epoch.command is not None)
        motion.speed_mps, motion.brake = start_mps, 0.0
        end_ns, captured_ns, passed = loop.runtime.true_ns + round(duration_s * NS_PER_S), watchdog._captured_ns, []

        def has_new_command() -> bool:
            nonlocal captured_ns
            passed.append((car.ground_truth().mono_ns, motion.x_m))
            before_ns, captured_ns = captured_ns, watchdog._captured_ns
            return captured_ns != before_ns

        while all(loop.runtime.run(end_ns, has_new_command) for _ in range(3)):
            since_picture_m = motion.x_m - np.interp(captured_ns, *np.transpose(passed))
            throttle, stop = motion.throttle, _stop(_copy(node))
            yield FullThrottleStop(stop, throttle, since_picture_m + stop.covered_m)
        for writer in loop.writers:
            writer.close()


def actuator_of(loop: VirtualLoop) -> ActuatorNode:
    """Return the actuator node, which is in the same process in virtual time."""
    assert loop.server.actuator is not None
    return loop.server.actuator


def _drive_to(loop: VirtualLoop, car: Simulator, metre: int) -> None:
    """Drive on to the first accepted command beyond a metre."""
    gate = actuator_of(loop).gate
    before = gate.epoch.sequence

    def accepted_there() -> bool:
        return gate.epoch.sequence != before and car.ground_truth().progress_m >= metre

    assert loop.runtime.run(loop.runtime.true_ns + 20 * NS_PER_S, accepted_there)


def _copy(node: ActuatorNode) -> ActuatorNode:
    """Return a copy of a node with its gate, odometry and car; the road, which never changes, is shared."""
    assert isinstance(node.vehicle, Simulator)
    road, fixes = node.vehicle._route_monitor._road, node.gate.watchdog._path._odometry._fixes
    node_copy = copy.deepcopy(node, {id(road): road, id(fixes): fixes.copy()})
    node_copy._endings = {}  # the end of the route does not end the drive
    return node_copy


def _stop(node: ActuatorNode) -> Stop:
    """Run an actuator node until its car is stationary; it gets the wakes that it requests, and no messages."""
    car = node.vehicle
    assert isinstance(car, Simulator)
    monitor, motion = car._route_monitor, car._car.motion
    begin, half_lane_m = car.ground_truth(), monitor._road.lanes.widths_m[monitor._road.lanes.driven] / 2
    beyond_m, covered_m = -math.inf, 0.0
    while motion.speed_mps > 0:
        now = Now(node.next_wake_ns(), 0)
        before = (motion.x_m, motion.y_m)
        run_stages(node.name, node.pipelines[WAKE], Message(WAKE, None, now), now, repeat(now))
        covered_m += math.dist(before, (motion.x_m, motion.y_m))
        beyond_m = max(
            beyond_m,
            *(abs(offset_m) - half_lane_m for _, offset_m, _ in monitor._project_points(motion, monitor._corners)),
        )
    return Stop(begin.progress_m, begin.speed_mps, beyond_m, covered_m, node.gate.state)
