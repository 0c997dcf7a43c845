"""The construction of vehicles with their cameras and, if known, their roads."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import entry_points

import numpy as np
from msgspec.structs import replace

from lavt.assembly.by_wire import build_inside, check_by_wire, is_simulated
from lavt.assembly.cameras import CARLA, build_camera, camera_model, check_simulated_camera
from lavt.assembly.simulators import car_of, simulator_of
from lavt.clock import Clock
from lavt.config import ServerConfig, VehicleConfig
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import UserError
from lavt.nodes.payloads import Route
from lavt.perception.lane_detector import GRID
from lavt.streams import stream
from lavt.vehicle.camera import Camera, FrameTimes, TimedCamera
from lavt.vehicle.carla.camera import CarlaCamera
from lavt.vehicle.carla.connection import check_server
from lavt.vehicle.carla.follower import Follower
from lavt.vehicle.carla.frames import FlatPose
from lavt.vehicle.carla.guard import Guard, await_trial
from lavt.vehicle.carla.library import check_library
from lavt.vehicle.carla.session import BRAKED, CarlaSession
from lavt.vehicle.carla.settings import CarlaSettings
from lavt.vehicle.carla.ticker import Ticker
from lavt.vehicle.carla.vehicle import CarlaVehicle
from lavt.vehicle.sim.rendering.camera import SimCamera
from lavt.vehicle.sim.rendering.lane_camera import LaneCamera, LaneNoise
from lavt.vehicle.sim.road.road import Road, load_road
from lavt.vehicle.sim.simulator import start_offset
from lavt.vehicle.vehicle import Vehicle

CUSTOM_VEHICLES = "lavt.vehicles"
"""The group of entry points with which users add vehicles: functions like `build_simulator`."""

ROUTE_STEP_M = 1.0
"""The distance between the recorded points of a route."""


LONGEST_TICK_S = 0.1
"""CARLA's physics is not valid for longer ticks."""


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
    run: Callable[[Clock], None] = lambda _clock: None
    """Starts the vehicle's own thread in real time, if it has one."""
    close: Callable[[], None] = lambda: None
    """Ends the vehicle's own thread and connections, if it has any."""


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
    """Connect to the configured CARLA server, and build its car and its camera; raise `UserError` if that fails."""
    if config.camera.source != CARLA:
        raise UserError("a vehicle of kind 'carla' has CARLA's camera: set camera.source carla")
    road, phase_ns = load_road(config.vehicle.route), camera_phase_ns(config)
    settings = carla_settings(config, road)
    session = CarlaSession(settings)
    camera = CarlaCamera(
        session,
        camera_model(config.camera),
        rate_hz=config.camera.rate_hz,
        phase_ns=phase_ns,
        sensor_delay_ns=round(config.camera.sensor_delay_ms * NS_PER_MS),
    )
    tickers: list[Ticker | Follower] = []
    guards: list[Guard] = []

    def start(now: Now) -> Vehicle:
        limit_s = config.vehicle.time_limit_s
        if settings.is_asynchronous:
            guards.append(Guard(settings, session.car_number, lambda: session.steer))
            await_trial(lambda: session.wait_for_state().steering_rad, session.max_steering_rad)
            follower = Follower(session, beat=guards[0].beat)
            camera.ticker = follower
            tickers.append(follower)
            return CarlaVehicle(session, follower, road, car_of(config.vehicle), start_ns=now.mono_ns, limit_s=limit_s)
        period_ns = round(settings.tick_s * NS_PER_S)
        # The ticks include the times of all frames; the first is the first one after the start.
        first_ns = now.mono_ns + phase_ns - phase_ns // period_ns * period_ns
        ticker = Ticker(session, first_due_ns=first_ns, period_s=settings.tick_s, actuation=BRAKED)
        camera.ticker = ticker
        tickers.append(ticker)
        return CarlaVehicle(session, ticker, road, car_of(config.vehicle), start_ns=now.mono_ns, limit_s=limit_s)

    def run(clock: Clock) -> None:
        for ticker in tickers:
            ticker.start(clock)

    def close() -> None:
        for ticker in tickers:
            ticker.stop()
        session.close()
        for guard in guards:  # last: until here it brakes if this process dies
            guard.end(is_car_gone=session.is_car_gone)

    route = route_of(config.vehicle.route, road)
    return VehicleSetup(camera, start, route, simulated=True, run=run, close=close)


def carla_settings(config: ServerConfig, road: Road | None) -> CarlaSettings:
    """Return the settings of a session for a config; without a road, the car starts at a place of the town.

    Raises `UserError` for values that do not fit together.
    """
    carla, camera = config.vehicle.carla, config.camera
    tick_s = 1.0 / (camera.rate_hz * carla.ticks_per_frame)
    if tick_s > LONGEST_TICK_S:
        raise UserError(
            f"a tick of CARLA would be {tick_s:.3g} s long, but at most {LONGEST_TICK_S} s are valid: raise "
            "vehicle.carla.ticks_per_frame or camera.rate_hz"
        )
    if camera.exposure_ms:
        raise UserError("CARLA's camera takes instantaneous pictures: leave out camera.exposure_ms")
    return CarlaSettings(
        host=carla.host,
        port=carla.port,
        tick_s=tick_s,
        start=None if road is None else start_pose(config, road),
        map_shift_m=carla.map_shift_m,
        town=carla.town,
        weather=carla.weather,
        blueprint=carla.blueprint,
        role_name=carla.role_name,
        camera=camera_model(camera),
        timeout_s=carla.timeout_s,
        tick_timeout_s=carla.tick_timeout_s,
        is_asynchronous=carla.asynchronous,
        max_steering_rad=None if carla.max_steering_deg is None else math.radians(carla.max_steering_deg),
    )


def check_carla_servers(configs: Iterable[VehicleConfig]) -> None:
    """Raise `UserError` if a vehicle is in CARLA, and the package or the server is absent or has another version.

    A sweep asks this once, instead of failing with each of its runs.
    """
    cars = {(config.carla.host, config.carla.port): config.carla for config in configs if config.kind == "carla"}
    if cars:
        check_library()
    for carla in cars.values():
        check_server(CarlaSettings(carla.host, carla.port, LONGEST_TICK_S, None, timeout_s=carla.timeout_s))


def start_pose(config: ServerConfig, road: Road) -> FlatPose:
    """Return the rear axle's start in the road's frame: the configured one, or near the route's start by the seed."""
    if config.vehicle.carla.start is not None:
        x_m, y_m, heading_deg = config.vehicle.carla.start
        return FlatPose(x_m, y_m, math.radians(heading_deg))
    ahead_m, lateral_m, turned_rad = start_offset(config.seed)
    x_m, y_m = road.point_at(ahead_m, lateral_m).tolist()
    return FlatPose(x_m, y_m, float(road.centre_at(ahead_m).heading_rad) + turned_rad)


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
        noise=lane_noise(config),
    )
    return _build_simulated(config, road, camera)


def lane_noise(config: ServerConfig) -> LaneNoise | None:
    """Return the configured noise of the seen lane; None without any."""
    vehicle = config.vehicle
    if not vehicle.lane_noise_m and not vehicle.lane_noise_rad:
        return None
    return LaneNoise(config.seed, vehicle.lane_noise_m, vehicle.lane_noise_rad)


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
