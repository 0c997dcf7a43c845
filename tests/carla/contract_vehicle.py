"""A vehicle in a stand-in server, for the contract of vehicles."""

from __future__ import annotations

import atexit
from contextlib import ExitStack
from dataclasses import replace

from tests.carla.stand_in import StandIn, need_carla, stand_in

from lavt.assembly.vehicles import carla_settings
from lavt.config import CarlaConfig, ServerCameraConfig, ServerConfig, VehicleConfig
from lavt.vehicle.carla.session import BRAKED, CarlaSession
from lavt.vehicle.carla.settings import CarlaSettings
from lavt.vehicle.carla.ticker import Ticker
from lavt.vehicle.carla.vehicle import CarlaVehicle
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ
from lavt.vehicle.sim.road.road import Road, load_road

ROAD = "a_key"
_servers: list[StandIn] = []
_sessions: list[CarlaSession] = []


def shared_server() -> StandIn:
    """Return the stand-in server of this process's contract tests, started at the first call."""
    need_carla()
    if not _servers:
        stack = ExitStack()
        _servers.append(stack.enter_context(stand_in("--road", ROAD)))
        atexit.register(stack.close)
    return _servers[0]


def server_config(port: int, **carla: object) -> ServerConfig:
    """Return a server's config with a car in a CARLA server at a port of this machine."""
    section = CarlaConfig.model_validate({"port": port, **carla})
    return ServerConfig(
        vehicle=VehicleConfig(kind="carla", route=ROAD, carla=section), camera=ServerCameraConfig(source="carla")
    )


def blind_settings(port: int, **carla: object) -> tuple[CarlaSettings, Road]:
    """Return the settings of a session without a camera, and its road."""
    road = load_road(ROAD)
    return replace(carla_settings(server_config(port, **carla), road), camera=None), road


def contract_vehicle(start_ns: int) -> CarlaVehicle:
    """Return a car without a camera in the shared server; it replaces the one of the last call."""
    settings, road = blind_settings(shared_server().port)
    while _sessions:
        _sessions.pop().close()
    session = CarlaSession(settings)
    _sessions.append(session)
    ticker = Ticker(session, first_due_ns=start_ns, period_s=settings.tick_s, actuation=BRAKED)
    return CarlaVehicle(session, ticker, road, LINCOLN_MKZ, start_ns=start_ns)
