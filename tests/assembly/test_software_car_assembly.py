"""The construction of software cars from a server's config."""

from __future__ import annotations

import pytest
from tests.vehicle.software_car.rig import START_NS, CommandValues, Sender1, Sender2

from lavt.assembly.dbw import load_profile
from lavt.assembly.simulators import build_software_car, simulator_of
from lavt.config import DbwConfig, ServerConfig, VehicleConfig
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.software_car.car import SoftwareCar


def build(profile: str, config: ServerConfig | None = None) -> SoftwareCar:
    return build_software_car(config or ServerConfig(), load_profile(profile), load_road("a_key"), START_NS)


@pytest.mark.parametrize(
    ("profile", "accepted_sender"),
    [
        ("dataspeed_gen1", "generation 1"),
        ("dataspeed_gen2", "remote"),
        ("dataspeed_gen2:remote", "remote"),
        ("dataspeed_gen2:user", "user"),
    ],
)
def test_the_kit_accepts_the_commands_of_its_profile(profile: str, accepted_sender: str) -> None:
    """The kit accepts only commands of the generation and command set that the profile describes."""
    senders: dict[str, Sender1 | Sender2] = {
        "generation 1": Sender1(),
        "remote": Sender2(),
        "user": Sender2(first_identifier=0x210),
    }
    for name, sender in senders.items():
        car = build(profile)
        for frame in sender.commands(CommandValues(brake=0.5)):
            car.receive(frame, START_NS)
        assert (car.kit.state.actuators["brake"].order is not None) == (name == accepted_sender)


def test_the_car_matches_the_config() -> None:
    """The car starts where a simulator of the same config starts, with its seed and its lags."""
    config = ServerConfig(seed=7, vehicle=VehicleConfig(steering_lag_ms=250.0))
    car, simulator = build("dataspeed_gen2", config), simulator_of(config, load_road("a_key"), START_NS)
    assert car.simulator.ground_truth() == simulator.ground_truth()
    assert car.simulator.ground_truth() != build("dataspeed_gen2").simulator.ground_truth()
    assert car.simulator._parameters.steering_lag_s == 0.25


def test_a_config_with_bus_options_is_hashable() -> None:
    """Configs with equal bus options are equal and have equal hashes, so that they can be keys of a cache."""
    config, equal_config, different_config = (
        VehicleConfig(dbw=DbwConfig(options={"port": port})) for port in (1, 1, 2)
    )
    assert hash(config) == hash(equal_config)
    assert len({config, equal_config, different_config}) == 2
