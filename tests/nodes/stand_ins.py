"""Small stand-ins for what is slow or moves by itself, and how to walk a message through a node."""

# ruff: noqa: D102 (stand-ins do what their protocols say)

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import repeat
from typing import Any

import numpy as np

from lavt.domain import NS_PER_S, Actuation, CameraModel, GroundTruth, Now, Picture, Pose, VehicleEvent, VehicleState
from lavt.node import Message, Node, Send
from lavt.runtime.pipeline import walk
from lavt.vehicle.camera import CapturedFrame
from lavt.vehicle.vehicle import Capabilities, ReachedCommand

MONO_NS = 1_000 * NS_PER_S
WALL_NS = 1_790_000_000 * NS_PER_S
SMALL = CameraModel(width_px=128, height_px=96)
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
    """Give a reading `mono_ns` after the begin; the wall clock goes with it unless told."""
    return Now(MONO_NS + mono_ns, WALL_NS + (mono_ns if wall_ns is None else wall_ns))


def give(
    node: Node, channel: str, payload: Any, now: Now, peer: Any = None, *, arrived: Now | None = None
) -> list[Send]:
    """Walk one message through a node whose hops take no time."""
    message = Message(channel, payload, arrived or now, peer)
    return walk(node.name, node.chains[channel], message, now, repeat(now)).sends


def of(sends: list[Send], channel: str) -> list[Any]:
    """Give the payloads on one channel."""
    return [send.payload for send in sends if send.channel == channel]


def noise(number: int, model: CameraModel = SMALL) -> Picture:
    generator = np.random.default_rng(number)
    return generator.integers(0, 256, (model.height_px, model.width_px, 3), dtype=np.uint8)


@dataclass
class NoiseCamera:
    """A `Camera` whose pictures are small and all different; it remembers what it was asked."""

    model: CameraModel = SMALL
    rate_hz: float = 30.0
    phase_ns: int = 0
    broken: bool = False
    stuck: Picture | None = None
    """The same buffer each time."""
    requested: list[tuple[int, int, Pose | None]] = field(default_factory=list)

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame | None:
        self.requested.append((number, at_ns, pose))
        if self.broken:
            return None
        return CapturedFrame(number, at_ns, noise(number, self.model) if self.stuck is None else self.stuck)


@dataclass
class StandingVehicle:
    """A `Vehicle` that is wherever the test puts it and remembers what it was asked to do."""

    speed_mps: float = 0.0
    now_ns: int = MONO_NS
    happens: list[VehicleEvent] = field(default_factory=list)
    accepted: list[Actuation] = field(default_factory=list)
    wanted: bool = False
    reached: list[ReachedCommand] = field(default_factory=list)

    @property
    def capabilities(self) -> Capabilities:
        return CAPABILITIES

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        self.now_ns = max(self.now_ns, to_ns)
        happened, self.happens = self.happens, []
        return happened

    def apply(self, actuation: Actuation, now_ns: int) -> None:  # noqa: ARG002 (the protocol's)
        self.accepted.append(actuation)

    def engage(self, wanted: bool, now_ns: int) -> None:  # noqa: ARG002 (the protocol's)
        self.wanted = wanted

    def take_reached(self) -> list[ReachedCommand]:
        reached, self.reached = self.reached, []
        return reached

    def state(self) -> VehicleState:
        return VehicleState(self.now_ns, self.speed_mps, 0.0, "drive")

    def ground_truth(self) -> GroundTruth | None:
        return None

    def next_wake_ns(self) -> int:
        return self.now_ns + NS_PER_S // 240
