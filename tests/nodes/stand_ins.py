"""Fakes of cameras and vehicles, and helpers that send a message through a node."""

# ruff: noqa: D102 (the protocols document these methods)

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import repeat
from typing import Any

import numpy as np

from lavt.domain import NS_PER_S, Actuation, CameraModel, GroundTruth, Now, Picture, Pose, VehicleEvent, VehicleState
from lavt.node import Message, Node, Send
from lavt.runtime.pipeline import run_stages
from lavt.vehicle.camera import CapturedFrame
from lavt.vehicle.vehicle import Capabilities, ReachedCommand

MONO_NS = 1_000 * NS_PER_S
WALL_NS = 1_790_000_000 * NS_PER_S
SMALL_CAMERA = CameraModel(width_px=128, height_px=96)
CAPABILITIES = Capabilities(
    simulated=True,
    virtual_time=True,
    ground_truth=False,
    reset=False,
    wheelbase_m=2.8448,
    max_steering_rad=0.513,
    max_steering_rate_radps=0.534,
    max_acceleration_mps2=2.0,
    max_braking_mps2=6.0,
)


def at(mono_ns: int, wall_ns: int | None = None) -> Now:
    """Return a clock reading `mono_ns` after the start; the wall clock has advanced as much, or by `wall_ns`."""
    return Now(MONO_NS + mono_ns, WALL_NS + (mono_ns if wall_ns is None else wall_ns))


def deliver(
    node: Node, channel: str, payload: Any, now: Now, peer: Any = None, *, arrived: Now | None = None
) -> list[Send]:
    """Deliver one message to a node whose stages take no time, and return the messages that the node sends."""
    message = Message(channel, payload, arrived or now, peer)
    return run_stages(node.name, node.pipelines[channel], message, now, repeat(now)).sends


def payloads(sends: list[Send], channel: str) -> list[Any]:
    """Return the payloads on one channel."""
    return [send.payload for send in sends if send.channel == channel]


def noise(number: int, model: CameraModel = SMALL_CAMERA) -> Picture:
    generator = np.random.default_rng(number)
    return generator.integers(0, 256, (model.height_px, model.width_px, 3), dtype=np.uint8)


@dataclass
class NoiseCamera:
    """A `Camera` with small pictures that are all different; it stores the arguments of each call."""

    model: CameraModel = SMALL_CAMERA
    rate_hz: float = 30.0
    phase_ns: int = 0
    broken: bool = False
    stuck: Picture | None = None
    """The picture to return each time."""
    captures: list[tuple[int, int, Pose | None]] = field(default_factory=list)

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:
        self.captures.append((number, at_ns, pose))
        if self.broken:
            return None
        return CapturedFrame(number, at_ns, noise(number, self.model) if self.stuck is None else self.stuck)


@dataclass
class FakeVehicle:
    """A `Vehicle` whose state the test sets; it stores the actuations and engagement that it gets."""

    speed_mps: float = 0.0
    now_ns: int = MONO_NS
    next_events: list[VehicleEvent] = field(default_factory=list)
    applied: list[Actuation] = field(default_factory=list)
    is_engage_requested: bool = False
    reached: list[ReachedCommand] = field(default_factory=list)
    inhibit_reason: str = ""
    steering_rad: float = 0.0

    @property
    def capabilities(self) -> Capabilities:
        return CAPABILITIES

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        self.now_ns = max(self.now_ns, to_ns)
        events, self.next_events = self.next_events, []
        return events

    def apply(self, actuation: Actuation, now_ns: int) -> None:  # noqa: ARG002 (the protocol's)
        self.applied.append(actuation)

    def engage(self, wanted: bool, now_ns: int) -> None:  # noqa: ARG002 (the protocol's)
        self.is_engage_requested = wanted

    def take_reached(self) -> list[ReachedCommand]:
        reached, self.reached = self.reached, []
        return reached

    def state(self) -> VehicleState:
        return VehicleState(self.now_ns, self.speed_mps, self.steering_rad, "drive", self.inhibit_reason)

    def ground_truth(self) -> GroundTruth | None:
        return None

    def next_wake_ns(self) -> int:
        return self.now_ns + NS_PER_S // 240
