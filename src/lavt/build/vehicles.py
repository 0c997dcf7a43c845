"""Vehicles of configs, each with its camera and, where one is known, the road it drives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import entry_points

import numpy as np

from lavt.build.cameras import camera_model
from lavt.config import ServerConfig, VehicleConfig
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import UserError
from lavt.nodes.reports import Route
from lavt.perception.lane_detector import GRID
from lavt.streams import stream
from lavt.vehicle.camera import Camera, FrameTimes, TimedCamera
from lavt.vehicle.sim.camera import SimCamera
from lavt.vehicle.sim.cars import named_car
from lavt.vehicle.sim.dynamics import CarParameters
from lavt.vehicle.sim.lane_camera import LaneCamera
from lavt.vehicle.sim.road import Road, load_road
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.vehicle import Vehicle

CUSTOM_VEHICLES = "lavt.vehicles"
"""Entry points of this group are functions like `build_simulator`: a user adds a vehicle without touching LAVT."""


ROUTE_STEP_M = 1.0


@dataclass(frozen=True, slots=True)
class Plant:
    """A vehicle with its camera, and the road it drives where one is known.

    `start` begins its time: building takes seconds, and a vehicle's time must not run before the loop does.
    """

    camera: Camera
    start: Callable[[Now], Vehicle]
    route: Route | None
    catches_up: bool = False
    """The vehicle loses nothing when `advance` is called later than it asked for."""


def car_of(config: VehicleConfig) -> CarParameters:
    """Take the configured car with the configured lags; raises `UserError` naming the known cars."""
    given = {
        "steering_dead_time_s": config.steering_dead_time_ms,
        "steering_lag_s": config.steering_lag_ms,
        "pedal_dead_time_s": config.pedal_dead_time_ms,
        "throttle_lag_s": config.throttle_lag_ms,
        "brake_lag_s": config.brake_lag_ms,
    }
    return replace(named_car(config.car), **{name: each / 1000 for name, each in given.items() if each is not None})


def build_simulator(config: ServerConfig) -> Plant:
    """Make the built-in simulator and its camera."""
    road = load_road(config.vehicle.route)
    camera = SimCamera(
        model=camera_model(config.camera),
        rate_hz=config.camera.rate_hz,
        phase_ns=camera_phase_ns(config),
        road=road,
        seed=config.seed,
        scenery=config.vehicle.scenery,
        light=config.vehicle.light,
        exposure_ns=round(config.camera.exposure_ms * NS_PER_MS),
        sensor_delay_ns=round(config.camera.sensor_delay_ms * NS_PER_MS),
    )
    camera.prepare()
    return _simulated(config, road, camera)


def build_unpictured(config: ServerConfig) -> Plant:
    """Make the built-in simulator with a camera that gives the lane itself; other vehicles' roads are not known."""
    if config.vehicle.kind != "simulator":
        raise UserError(
            f"fidelity geometry needs the road, which only the built-in simulator tells: choose vehicle.kind simulator "
            f"instead of {config.vehicle.kind!r}, or another fidelity"
        )
    road = load_road(config.vehicle.route)
    camera = LaneCamera(
        model=camera_model(config.camera),
        rate_hz=config.camera.rate_hz,
        phase_ns=camera_phase_ns(config),
        road=road,
        near_m=GRID.near_m,
        far_m=GRID.far_m,
        half_width_m=GRID.half_width_m,
        exposure_ns=round(config.camera.exposure_ms * NS_PER_MS),
        sensor_delay_ns=round(config.camera.sensor_delay_ms * NS_PER_MS),
    )
    return _simulated(config, road, camera)


def camera_phase_ns(config: ServerConfig) -> int:
    """Draw when the camera's first frame is taken after the start: anywhere within its period."""
    return int(stream(config.seed, "camera phase").integers(round(NS_PER_S / config.camera.rate_hz)))


def _simulated(config: ServerConfig, road: Road, camera: Camera) -> Plant:
    stations_m = np.arange(0.0, road.length_m, ROUTE_STEP_M)
    x_m, y_m, _, _ = road.point(stations_m)
    points = tuple(zip(x_m.tolist(), y_m.tolist(), strict=True))
    return Plant(
        camera,
        lambda start: Simulator(
            road=road,
            seed=config.seed,
            start_mono_ns=start.mono_ns,
            parameters=car_of(config.vehicle),
            goes_on=config.vehicle.after_collision == "continue",
            limit_s=config.vehicle.time_limit_s,
        ),
        Route(config.vehicle.route, road.length_m, points),
        catches_up=True,
    )


VEHICLES: dict[str, Callable[[ServerConfig], Plant]] = {"simulator": build_simulator}


def build_plant(config: ServerConfig) -> Plant:
    """Make the configured vehicle with its camera; raises `UserError` naming the known kinds."""
    return _vehicle(config.vehicle.kind)(config)


def _vehicle(kind: str) -> Callable[[ServerConfig], Plant]:
    if kind in VEHICLES:
        return VEHICLES[kind]
    custom = {entry.name: entry for entry in entry_points(group=CUSTOM_VEHICLES)}
    if kind not in custom:
        raise UserError(f"there is no vehicle {kind!r}: the known kinds are {', '.join([*VEHICLES, *custom])}")
    build: Callable[[ServerConfig], Plant] = custom[kind].load()
    return build


def check_vehicle(config: VehicleConfig) -> None:
    """Raise `UserError` for a vehicle, road or car that does not exist, before any work is begun."""
    _vehicle(config.kind)
    if config.kind == "simulator":
        load_road(config.route)
        car_of(config)


def looks_of(camera: Camera, start_ns: int) -> list[FrameTimes]:
    """Tell when the vehicle's pose is needed: when the shutter opens and, where the camera has an exposure, closes."""
    opens = FrameTimes(start_ns + camera.phase_ns, camera.rate_hz)
    exposure_ns = camera.exposure_ns if isinstance(camera, TimedCamera) else 0
    return [opens, replace(opens, first_ns=opens.first_ns + exposure_ns)] if exposure_ns else [opens]
