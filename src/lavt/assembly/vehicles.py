"""The construction of vehicles with their cameras and, if known, their roads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points

import numpy as np
from msgspec.structs import replace

from lavt.assembly.by_wire import build_inside, check_by_wire, is_simulated
from lavt.assembly.cameras import build_camera, camera_model, check_simulated_camera
from lavt.assembly.simulators import car_of, open_carla, simulator_of
from lavt.clock import Clock
from lavt.config import ServerConfig, VehicleConfig
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import UserError
from lavt.nodes.payloads import Route
from lavt.perception.lane_detector import GRID
from lavt.streams import stream
from lavt.vehicle.camera import Camera, FrameTimes, TimedCamera
from lavt.vehicle.sim.rendering.camera import SimCamera
from lavt.vehicle.sim.rendering.lane_camera import LaneCamera
from lavt.vehicle.sim.road.road import Road, load_road
from lavt.vehicle.vehicle import Vehicle

CUSTOM_VEHICLES = "lavt.vehicles"
"""The group of entry points with which users add vehicles: functions like `build_simulator`."""

ROUTE_STEP_M = 1.0
"""The distance between the recorded points of a route."""


@dataclass(frozen=True, slots=True)
class VehicleSetup:
    """A vehicle with its camera and, if known, its road."""

    camera: Camera
    start: Callable[[Now], Vehicle] | None
    """Builds the vehicle; called when the loop starts, after preparations that take seconds. None: the process of the
    actuator builds the vehicle (`actuator_process.py`)."""
    route: Route | None
    simulated: bool = False
    catches_up: bool = False
    """Whether a late call of the vehicle's `advance` loses no accuracy."""
    run: Callable[[Clock], None] | None = None
    """Starts the vehicle's own thread in real time; None: it has none."""
    close: Callable[[], None] | None = None
    """Ends the vehicle's connections; None: it has none."""


def build_simulator(config: ServerConfig) -> VehicleSetup:
    """Build the built-in simulator and its camera."""
    check_simulated_camera(config)
    road = load_road(config.vehicle.route)
    return _build_simulated(config, road, _build_sim_camera(config, road))


def build_dbw(config: ServerConfig) -> VehicleSetup:
    """Build a by-wire vehicle and its camera; a software car that sends ground truth has the simulator's camera."""
    check_vehicle(config.vehicle)
    dbw = config.vehicle.dbw
    if dbw.is_inside:
        return build_simulator(config)
    if dbw.truth:
        check_simulated_camera(config)
        camera = _build_sim_camera(config, load_road(config.vehicle.route))
        return VehicleSetup(camera, start=None, route=None, simulated=is_simulated(dbw))
    device = build_camera(config)
    if device is None:
        raise UserError(
            "a real car needs a real camera: set camera.source device and camera.device, or set vehicle.dbw.truth for "
            "`lavt software-car`"
        )
    return VehicleSetup(device, start=None, route=None)


def build_carla(config: ServerConfig) -> VehicleSetup:
    """Connect to the configured CARLA server, and build its car and its camera."""
    road = load_road(config.vehicle.route)
    parts = open_carla(config, road, camera_phase_ns(config))
    return VehicleSetup(
        parts.camera,
        parts.start,
        route_of(config.vehicle.route, road),
        simulated=True,
        run=parts.run,
        close=parts.close,
    )


def _build_sim_camera(config: ServerConfig, road: Road) -> SimCamera:
    camera = SimCamera(
        model=camera_model(config.camera),
        rate_hz=config.camera.rate_hz,
        phase_ns=camera_phase_ns(config),
        road=road,
        seed=config.seed,
        scenery=config.vehicle.scenery,
        light=config.vehicle.light,
        weather=config.vehicle.weather,
        exposure_ns=round(config.camera.exposure_ms * NS_PER_MS),
        sensor_delay_ns=round(config.camera.sensor_delay_ms * NS_PER_MS),
    )
    camera.prepare()
    return camera


def build_geometry_setup(config: ServerConfig) -> VehicleSetup:
    """Build the built-in simulator with a camera that captures only the lane; raise `UserError` for other vehicles."""
    kind = config.vehicle.kind
    if kind != "simulator" and not (kind == "dbw" and config.vehicle.dbw.is_inside):
        raise UserError(
            f"fidelity geometry needs the road, which is known for the built-in simulator only: choose vehicle.kind "
            f"simulator instead of {kind!r}, or another fidelity"
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
    return _build_simulated(config, road, camera)


def camera_phase_ns(config: ServerConfig) -> int:
    """Return the random time between the start and the camera's first frame, shorter than one frame period."""
    return int(stream(config.seed, "camera phase").integers(round(NS_PER_S / config.camera.rate_hz)))


def driven_route(config: ServerConfig) -> Route | None:
    """Return the route of a by-wire car on a bus: known for a software car that sends ground truth, otherwise None."""
    return route_of(config.vehicle.route, load_road(config.vehicle.route)) if config.vehicle.dbw.truth else None


def route_of(name: str, road: Road) -> Route:
    """Return the centre line of a road's lane for the record."""
    x_m, y_m, _, _ = road.centre_at(np.arange(0.0, road.route_length_m, ROUTE_STEP_M))
    return Route(name, road.route_length_m, tuple(zip(x_m.tolist(), y_m.tolist(), strict=True)))


def _build_simulated(config: ServerConfig, road: Road, camera: Camera) -> VehicleSetup:
    route = route_of(config.vehicle.route, road)
    if config.vehicle.kind == "dbw":

        def start_inside(start: Now) -> Vehicle:
            return build_inside(config, road, start)

        return VehicleSetup(camera, start_inside, route, simulated=True)
    return VehicleSetup(
        camera, lambda start: simulator_of(config, road, start.mono_ns), route, simulated=True, catches_up=True
    )


VEHICLES: dict[str, Callable[[ServerConfig], VehicleSetup]] = {
    "simulator": build_simulator,
    "dbw": build_dbw,
    "carla": build_carla,
}


def build_vehicle_setup(config: ServerConfig) -> VehicleSetup:
    """Build the configured vehicle with its camera; raise `UserError` with the known kinds for an unknown one."""
    return _find_builder(config.vehicle.kind)(config)


def _find_builder(kind: str) -> Callable[[ServerConfig], VehicleSetup]:
    if kind in VEHICLES:
        return VEHICLES[kind]
    custom = {entry.name: entry for entry in entry_points(group=CUSTOM_VEHICLES)}
    if kind not in custom:
        raise UserError(f"unknown vehicle kind {kind!r}: choose one of {', '.join([*VEHICLES, *custom])}")
    build: Callable[[ServerConfig], VehicleSetup] = custom[kind].load()
    return build


def check_vehicle(config: VehicleConfig) -> None:
    """Raise `UserError` for an unknown vehicle, road or car, before any work starts."""
    _find_builder(config.kind)
    if config.kind == "dbw":
        check_by_wire(config)
    if config.kind in {"simulator", "carla"} or config.dbw.is_inside or config.dbw.truth:
        load_road(config.route)
        car_of(config)


def physics_sample_times(camera: Camera, start_ns: int) -> list[FrameTimes]:
    """Return the times when the vehicle's pose is needed: the shutter opens or, after an exposure, closes."""
    opening_times = FrameTimes(start_ns + camera.phase_ns, camera.rate_hz)
    exposure_ns = camera.exposure_ns if isinstance(camera, TimedCamera) else 0
    if not exposure_ns:
        return [opening_times]
    return [opening_times, replace(opening_times, first_ns=opening_times.first_ns + exposure_ns)]
