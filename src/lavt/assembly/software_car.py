"""The construction of software cars: a by-wire kit and the built-in simulator."""

from __future__ import annotations

from typing import Final, Literal

from lavt.assembly.simulators import simulator_of
from lavt.config import ServerConfig
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.software_car.car import SoftwareCar
from lavt.vehicle.software_car.kit import Kit
from lavt.vehicle.software_car.mechanics import Mechanics

GENERATIONS: Final[dict[str, Literal[1, 2]]] = {"dataspeed_1": 1, "dataspeed_2": 2}
"""The kit's generation for each value of a profile's `kit`."""


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
