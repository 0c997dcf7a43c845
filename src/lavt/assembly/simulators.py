"""The construction of the built-in simulator."""

from __future__ import annotations

from dataclasses import replace

from lavt.config import ServerConfig, VehicleConfig
from lavt.vehicle.sim.dynamics import CarParameters, named_car
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.simulator import Simulator


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
