"""The construction of the simulators: the built-in one, software cars (a by-wire kit and this one), and CARLA."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Literal

from lavt.assembly.cameras import CARLA, camera_model
from lavt.clock import Clock
from lavt.config import ServerConfig, VehicleConfig
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import UserError
from lavt.vehicle.camera import Camera
from lavt.vehicle.carla.camera import CarlaCamera
from lavt.vehicle.carla.frames import FlatPose
from lavt.vehicle.carla.session import BRAKED, CarlaSession
from lavt.vehicle.carla.settings import CarlaSettings
from lavt.vehicle.carla.ticker import Ticker
from lavt.vehicle.carla.vehicle import CarlaVehicle
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.sim.dynamics import CarParameters, named_car
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.simulator import Simulator, start_offset
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.kit import Kit
from lavt.vehicle.software_car.mechanics import Mechanics
from lavt.vehicle.vehicle import Vehicle

GENERATIONS: Final[dict[str, Literal[1, 2]]] = {"dataspeed_1": 1, "dataspeed_2": 2}
"""The kit's generation for each value of a profile's `kit`."""

LONGEST_TICK_S = 0.1
"""CARLA's physics is not valid for longer ticks."""


def car_of(config: VehicleConfig) -> CarParameters:
    """Return the configured car with the configured lags; raise `UserError` with the known names for an unknown car."""
    lags_ms = {
        "steering_dead_time_s": config.steering_dead_time_ms,
        "steering_lag_s": config.steering_lag_ms,
        "pedal_dead_time_s": config.pedal_dead_time_ms,
        "throttle_lag_s": config.throttle_lag_ms,
        "brake_lag_s": config.brake_lag_ms,
    }
    lags_s = {name: lag_ms / 1000 for name, lag_ms in lags_ms.items() if lag_ms is not None}
    return replace(named_car(config.car), **lags_s)


def simulator_of(config: ServerConfig, road: Road, start_ns: int) -> Simulator:
    """Build the configured car, stationary at the start of a road."""
    return Simulator(
        road=road,
        seed=config.seed,
        start_mono_ns=start_ns,
        parameters=car_of(config.vehicle),
        continue_after_collision=config.vehicle.after_collision == "continue",
        limit_s=config.vehicle.time_limit_s,
    )


def build_software_car(config: ServerConfig, profile: Profile, road: Road, start_ns: int) -> SoftwareCar:
    """Build a car with the kind of kit and the command set of a profile; the car uses nothing else of the profile.

    The kit interprets commands as documented. If the profile has an error, the car therefore does not respond.
    """
    simulator = simulator_of(config, road, start_ns)
    kit = Kit(
        GENERATIONS[profile.kit],
        start_ns=start_ns,
        commands=profile.commands or "remote",
        mechanics=Mechanics(max_braking_mps2=simulator.capabilities.max_braking_mps2),
    )
    return SoftwareCar(kit, simulator)


@dataclass(frozen=True, slots=True)
class CarlaParts:
    """A car in a CARLA server, its camera, and what runs and ends them."""

    camera: Camera
    start: Callable[[Now], Vehicle]
    run: Callable[[Clock], None]
    close: Callable[[], None]


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
        max_steering_rad=None if carla.max_steering_deg is None else math.radians(carla.max_steering_deg),
    )


def start_pose(config: ServerConfig, road: Road) -> FlatPose:
    """Return the rear axle's start in the road's frame: the configured one, or near the route's start by the seed."""
    if config.vehicle.carla.start is not None:
        x_m, y_m, heading_deg = config.vehicle.carla.start
        return FlatPose(x_m, y_m, math.radians(heading_deg))
    ahead_m, lateral_m, turned_rad = start_offset(config.seed)
    x_m, y_m = road.point_at(ahead_m, lateral_m).tolist()
    return FlatPose(x_m, y_m, float(road.centre_at(ahead_m).heading_rad) + turned_rad)


def open_carla(config: ServerConfig, road: Road, phase_ns: int) -> CarlaParts:
    """Open a session with the configured server; raise `UserError` if it cannot be used."""
    if config.camera.source != CARLA:
        raise UserError("a vehicle of kind 'carla' has CARLA's camera: set camera.source carla")
    settings = carla_settings(config, road)
    session = CarlaSession(settings)
    camera = CarlaCamera(
        session,
        camera_model(config.camera),
        rate_hz=config.camera.rate_hz,
        phase_ns=phase_ns,
        sensor_delay_ns=round(config.camera.sensor_delay_ms * NS_PER_MS),
    )
    tickers: list[Ticker] = []

    def start(now: Now) -> Vehicle:
        period_ns = round(settings.tick_s * NS_PER_S)
        # The ticks include the times of all frames; the first is the first one after the start.
        first_ns = now.mono_ns + phase_ns - phase_ns // period_ns * period_ns
        ticker = Ticker(session, first_due_ns=first_ns, period_s=settings.tick_s, actuation=BRAKED)
        camera.ticker = ticker
        tickers.append(ticker)
        limit_s = config.vehicle.time_limit_s
        return CarlaVehicle(session, ticker, road, car_of(config.vehicle), start_ns=now.mono_ns, limit_s=limit_s)

    def run(clock: Clock) -> None:
        for ticker in tickers:
            ticker.start(clock)

    def close() -> None:
        for ticker in tickers:
            ticker.stop()
        session.close()

    return CarlaParts(camera, start, run, close)
