"""The settings of a session with a CARLA server, and what a session reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from msgspec import Struct

from lavt.domain import CameraModel
from lavt.vehicle.carla.frames import FlatPose


@dataclass(frozen=True, slots=True)
class CarlaSettings:
    """The settings of a session; the config section `vehicle.carla` describes them."""

    host: str
    port: int
    tick_s: float
    """The time by which a tick advances the world."""
    start: FlatPose | None
    """The start of the rear axle, in LAVT's world frame; None: the first place that the town recommends."""
    map_shift_m: tuple[float, float] = (0.0, 0.0)
    town: str = ""
    weather: str = ""
    blueprint: str = "vehicle.lincoln.mkz_2020"
    role_name: str = "lavt"
    camera: CameraModel | None = None
    """None: no camera."""
    timeout_s: float = 10.0
    tick_timeout_s: float = 2.0
    load_timeout_s: float = 120.0
    max_steering_rad: float | None = None
    """None: the angle that the server announces."""
    is_asynchronous: bool = False
    """Whether the world runs by itself."""

    @property
    def address(self) -> str:
        """The address for messages."""
        return f"{self.host}:{self.port}"


class CarlaEvent(Struct, frozen=True):
    """A collision, a lane invasion, or a loss of time of an asynchronous world."""

    frame: int
    kind: Literal["collision", "lane_invasion", "late"]
    detail: str


class Snapshot(Struct, frozen=True):
    """The car after a tick."""

    frame: int
    pose: FlatPose
    """The rear axle's pose in LAVT's world frame."""
    speed_mps: float
    steering_rad: float
    gear: int
    """-1 is reverse."""
    elapsed_s: float = 0.0
    """The time that has elapsed in the world; 0 in a synchronous world, whose ticks have due times."""
    platform_s: float = 0.0
    """The time of the clock of the server's machine; 0 in a synchronous world."""
