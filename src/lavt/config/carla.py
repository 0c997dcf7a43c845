"""The schema of the config section `vehicle.carla`: a server, its town, and the car in it."""

from __future__ import annotations

from pydantic import Field

from lavt.config.section import Section


class CarlaConfig(Section):
    """A car in a CARLA server (`docs/carla.md`); no real server was ever used."""

    host: str = Field("127.0.0.1", min_length=1)
    """The machine of the server."""
    port: int = Field(2000, ge=1, le=65_534)
    """The server's RPC port; sensor data come from the next port."""
    town: str = ""
    """The town to load, such as Town04; empty: the town that is loaded."""
    weather: str = ""
    """The name of a weather of CARLA, such as ClearNoon; empty: the weather that is set."""
    blueprint: str = Field("vehicle.lincoln.mkz_2020", min_length=1)
    """The car's blueprint. Its body must have about the size of `vehicle.car`."""
    role_name: str = Field("lavt", min_length=1)
    """The role name of LAVT's actors. Actors with this name that a killed run left are removed."""
    map_shift_m: tuple[float, float] = (0.0, 0.0)
    """The position of the road's origin in the town's map, in the map's right-handed x and y (m)."""
    start: tuple[float, float, float] | None = None
    """The start of the rear axle on the road: x, y (m) and heading (degrees, positive to the left); null: the route's
    start, with an offset from the seed as in the simulator."""
    asynchronous: bool = False
    """Whether the world runs by itself instead of being ticked: in real time only (`docs/carla.md`)."""
    ticks_per_frame: int = Field(1, ge=1, le=8)
    """How many ticks of the world there are for each frame of the camera; a tick is at most 0.1 s long."""
    max_steering_deg: float | None = Field(None, gt=0, lt=90)
    """The road wheel angle at full steer; null: the one that the server announces."""
    timeout_s: float = Field(10.0, gt=0, le=600)
    """The longest wait for an answer of the server while a session begins."""
    tick_timeout_s: float = Field(5.0, gt=0, le=60)
    """The longest wait for a tick; then the run ends."""
