"""The built-in simulator of a config."""

from __future__ import annotations

from dataclasses import replace

from lavt.config import ServerConfig, VehicleConfig
from lavt.vehicle.sim.dynamics import CarParameters
from lavt.vehicle.sim.rendering.cars import named_car
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.simulator import Simulator


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


def simulator_of(config: ServerConfig, road: Road, start_ns: int) -> Simulator:
    """Make the configured car, which stands at the start of a road."""
    return Simulator(
        road=road,
        seed=config.seed,
        start_mono_ns=start_ns,
        parameters=car_of(config.vehicle),
        continue_after_collision=config.vehicle.after_collision == "continue",
        limit_s=config.vehicle.time_limit_s,
    )
