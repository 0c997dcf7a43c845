"""The bytes of CARLA's protocol 0.9.16 that the stand-in server speaks: msgpack-rpc values and sensor data.

The layouts are those of the debug information in the wheel `carla` 0.9.16. No real server was used.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

VERSION = "0.9.16"
WORLD_STREAM = 1
COLLISION_SENSOR, CAMERA_SENSOR, WORLD_SENSOR = 0, 13, 17
"""The types of sensors in the header of sensor data."""
APPLY_VEHICLE_CONTROL = 2
"""The number of a command in a batch."""
BOOL, INT, FLOAT, STRING = 1, 2, 3, 4
"""The types of attributes."""
VEHICLE, CAMERA = "vehicle.lincoln.mkz_2020", "sensor.camera.rgb"
COLLISION, LANE_INVASION = "sensor.other.collision", "sensor.other.lane_invasion"

BOX = [[0.0, 0.0, 0.7], [2.4665, 0.93, 0.75], [0.0, 0.0, 0.0], 0]
"""The body: its middle relative to the actor's origin, its half sizes in m, its rotation, and its number."""

WEATHER = [5.0, 0.0, 0.0, 10.0, -1.0, 45.0, 2.0, 0.75, 0.1, 0.0, 1.0, 0.03, 0.0331, 0.0]
"""The 14 numbers of the default weather."""

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class WirePose:
    """A transform: location in m, and pitch, yaw and roll in degrees, left-handed."""

    location: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)

    def packed(self) -> list[list[float]]:
        """Return the value in the protocol."""
        return [list(self.location), list(self.rotation)]


def pose_of(value: Sequence[Sequence[float]]) -> WirePose:
    location, rotation = value
    return WirePose((location[0], location[1], location[2]), (rotation[0], rotation[1], rotation[2]))


@dataclass
class WireActor:
    """An actor as the protocol describes it."""

    number: int
    parent: int
    kind: str
    attributes: dict[str, tuple[int, str]]
    pose: WirePose
    """In the world; relative to the parent for a sensor."""
    stream: int = 0
    velocity: Vector = (0.0, 0.0, 0.0)
    angular_degps: Vector = (0.0, 0.0, 0.0)
    control: list[Any] = field(default_factory=lambda: [0.0, 0.0, 0.0, False, False, False, 0])

    def packed(self, port: int) -> list[Any]:
        """Return the actor in the protocol."""
        attributes = [[name, kind, value] for name, (kind, value) in self.attributes.items()]
        tags = b"\x0e" if self.kind == VEHICLE else b""
        return [
            self.number,
            self.parent,
            [DEFINITION_NUMBERS[self.kind], self.kind, attributes],
            BOX,
            tags,
            token(self.stream, port),
        ]


def token(stream: int, port: int) -> bytes:
    """Return the token of a stream; empty for a sensor that the client computes itself."""
    return struct.pack("<IHBB16x", stream, port, 1, 0) if stream else b""


def value(result: Any) -> list[Any]:
    return [[1, result]]


def failure(text: str) -> list[Any]:
    return [[0, [text]]]


def done() -> list[Any]:
    return [[False]]


def not_done(text: str) -> list[Any]:
    return [[True, [text]]]


def _attribute(name: str, kind: int, default: str, *, modifiable: bool = True) -> list[Any]:
    return [name, kind, default, [], modifiable, False]


_CAMERA_ATTRIBUTES = [
    _attribute("image_size_x", INT, "800"),
    _attribute("image_size_y", INT, "600"),
    _attribute("fov", FLOAT, "90.0"),
    _attribute("motion_blur_intensity", FLOAT, "0.45"),
    _attribute("sensor_tick", FLOAT, "0.0"),
    _attribute("role_name", STRING, "front"),
]
DEFINITIONS: list[list[Any]] = [
    [
        1,
        VEHICLE,
        "vehicle,lincoln,mkz_2020",
        [
            _attribute("role_name", STRING, "autopilot"),
            _attribute("sticky_control", BOOL, "true"),
            _attribute("number_of_wheels", INT, "4", modifiable=False),
        ],
    ],
    [2, CAMERA, "sensor,camera,rgb", _CAMERA_ATTRIBUTES],
    [3, COLLISION, "sensor,other,collision", [_attribute("role_name", STRING, "front")]],
    [4, LANE_INVASION, "sensor,other,lane_invasion", [_attribute("role_name", STRING, "front")]],
]
DEFINITION_NUMBERS = {definition[1]: definition[0] for definition in DEFINITIONS}


@dataclass(frozen=True)
class WheelSet:
    """The wheels of a car: positions relative to the actor, and the largest steering angle."""

    wheelbase_m: float
    track_m: float
    rear_axle_m: float
    """Of the rear axle; negative: behind the actor's origin."""
    max_steering_deg: float


def physics_control(
    wheels: WheelSet, place: Any, mass_kg: float, steering_curve: Sequence[Sequence[float]]
) -> list[Any]:
    """Return the 17 fields of the physics control; `place` maps metres ahead and to the right to a world position."""
    packed_wheels = [
        [
            3.5,
            0.25,
            wheels.max_steering_deg if is_front else 0.0,
            35.5,
            1500.0,
            0.0 if is_front else 4000.0,
            1000.0,
            3.0,
            20.0,
            [100.0 * part for part in place(wheels.rear_axle_m + is_front * wheels.wheelbase_m, side)],
        ]
        for is_front in (True, False)
        for side in (-wheels.track_m / 2, wheels.track_m / 2)
    ]
    return [
        [[0.0, 400.0], [5000.0, 400.0]],
        5800.0,
        1.0,
        0.15,
        2.0,
        0.35,
        True,
        0.5,
        10.0,
        4.0,
        [[4.0, 0.5, 0.65]],
        mass_kg,
        0.3,
        [0.0, 0.0, 0.0],
        [list(point) for point in steering_curve],
        packed_wheels,
        False,
    ]


def sensor_header(kind: int, frame: int, elapsed_s: float, pose: WirePose) -> bytes:
    return struct.pack("<QQd6f", kind, frame, elapsed_s, *pose.location, *pose.rotation)


def picture_data(width_px: int, height_px: int, field_of_view_deg: float, bgra: bytes) -> bytes:
    return struct.pack("<IIf", width_px, height_px, field_of_view_deg) + bgra


def snapshot_data(episode: int, platform_s: float, dt_s: float, actors: Sequence[WireActor]) -> bytes:
    """Return the world's state: 36 bytes, and 119 for each actor."""
    parts = [struct.pack("<QdfiiiI", episode, platform_s, dt_s, 0, 0, 0, 0)]
    for actor in actors:
        throttle, steer, brake, hand_brake, reverse, manual, gear = actor.control
        union = struct.pack(
            "<3f3?ifB?IB", throttle, steer, brake, hand_brake, reverse, manual, gear, 30.0, 0, False, 0, 0
        )
        parts.append(
            struct.pack(
                "<IB15f54s",
                actor.number,
                1,
                *actor.pose.location,
                *actor.pose.rotation,
                *actor.velocity,
                *actor.angular_degps,
                *(0.0, 0.0, 0.0),
                union,
            )
        )
    return b"".join(parts)
