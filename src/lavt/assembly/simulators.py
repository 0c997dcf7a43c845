"""The construction of the built-in simulator, and of software cars: a by-wire kit and this simulator."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal

from lavt.config import ServerConfig, VehicleConfig
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.sim.dynamics import CarParameters, named_car
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.simulator import Simulator
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.kit import Kit
from lavt.vehicle.software_car.mechanics import Mechanics

GENERATIONS: Final[dict[str, Literal[1, 2]]] = {"dataspeed_1": 1, "dataspeed_2": 2}
"""The kit's generation for each value of a profile's `kit`."""


def car_of(config: VehicleConfig) -> CarParameters:
    """Return the configured car with the configured lags and stiffness.

    Raises `UserError` with the known names for an unknown car.
    """
    lags_ms = {
        "steering_dead_time_s": config.steering_dead_time_ms,
        "steering_lag_s": config.steering_lag_ms,
        "pedal_dead_time_s": config.pedal_dead_time_ms,
        "throttle_lag_s": config.throttle_lag_ms,
        "brake_lag_s": config.brake_lag_ms,
    }
    lags_s = {name: lag_ms / 1000 for name, lag_ms in lags_ms.items() if lag_ms is not None}
    car = replace(named_car(config.car), **lags_s)
    stiffness_nprad = config.front_stiffness_nprad
    return car if stiffness_nprad is None else replace(car, front_stiffness_nprad=stiffness_nprad)


def simulator_of(config: ServerConfig, road: Road, start_ns: int) -> Simulator:
    """Build the configured car, stationary at the start of a road."""
    return Simulator(
        road=road,
        seed=config.seed,
        start_mono_ns=start_ns,
        parameters=car_of(config.vehicle),
        continue_after_collision=config.vehicle.after_collision == "continue",
        limit_s=config.vehicle.time_limit_s,
        speed_report_factor=config.vehicle.speed_report_factor,
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
