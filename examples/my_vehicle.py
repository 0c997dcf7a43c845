"""A custom vehicle: the built-in car with a steering that pulls to the right.

python examples/my_vehicle.py [DIRECTORY]

A package can register a vehicle with an entry point. Every `lavt` command then accepts, in this example,
`vehicle.kind: pulling_car`:

    [project.entry-points."lavt.vehicles"]
    pulling_car = "my_package:build_pulling_car"
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

from lavt.assembly.simulators import simulator_of
from lavt.assembly.vehicles import VEHICLES, VehicleSetup, build_simulator
from lavt.config import RunConfig, ServerConfig
from lavt.config_file import load_config, shipped
from lavt.domain import Actuation, GroundTruth, VehicleEvent, VehicleState
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.vehicle import Capabilities, ReachedCommand, Vehicle

PULL_RAD = math.radians(-1.0)
"""The angle by which the road wheels are turned too far; left is positive."""


class PullingCar:
    """A car whose road wheels are turned by a constant angle from the commanded one; it has every member of `Vehicle`.

    A car of your own sends commands to its hardware in `apply`, and reads its reports in `advance`.
    """

    def __init__(self, car: Vehicle) -> None:
        self._car = car

    @property
    def capabilities(self) -> Capabilities:
        """Return the properties of this vehicle."""
        return self._car.capabilities

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Advance to `to_ns` and return the events since the last call."""
        return self._car.advance(to_ns)

    def apply(self, actuation: Actuation, now_ns: int) -> None:
        """Apply `actuation` from `now_ns` on."""
        steering_rad = actuation.steering_rad + PULL_RAD
        self._car.apply(Actuation(steering_rad, actuation.throttle, actuation.brake), now_ns)

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Engage or disengage the vehicle."""
        self._car.engage(wanted, now_ns)

    def take_reached(self) -> list[ReachedCommand]:
        """Return the commands that have reached the wheels."""
        return self._car.take_reached()

    def state(self) -> VehicleState:
        """Return the newest state."""
        return self._car.state()

    def ground_truth(self) -> GroundTruth | None:
        """Return the true position, which only a simulated vehicle knows."""
        return self._car.ground_truth()

    def next_wake_ns(self) -> int:
        """Return the time by which `advance` should be called next."""
        return self._car.next_wake_ns()


def build_pulling_car(config: ServerConfig) -> VehicleSetup:
    """Return the car with the simulator's camera and road."""
    road = load_road(config.vehicle.route)
    return replace(build_simulator(config), start=lambda now: PullingCar(simulator_of(config, road, now.mono_ns)))


if __name__ == "__main__":
    VEHICLES["pulling_car"] = build_pulling_car
    directory = Path(sys.argv[1] if len(sys.argv) > 1 else mkdtemp(prefix="lavt-"))
    for kind in ("simulator", "pulling_car"):
        changes = [f"vehicle.kind={kind}", "vehicle.scenery=none"]
        run = plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes))
        result = run_once(run, directory / kind)
        print(f"{kind}: {result['ending']}, cross-track P95 {result['p95_m']:.2f} m")
