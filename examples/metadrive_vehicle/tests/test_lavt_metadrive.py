"""A car of MetaDrive passes LAVT's contract of vehicles, and the lane keeper drives it."""

from __future__ import annotations

from pathlib import Path

import pytest
from lavt_metadrive import LIMITS, MetaDriveVehicle

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_S
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once
from lavt.vehicle.carla.frames import FlatPose
from lavt.vehicle.contract import CHECKS
from lavt.vehicle.sim.road.road import load_road

START_NS = 5 * NS_PER_S


@pytest.mark.parametrize("name", CHECKS)
def test_the_contract(name: str) -> None:
    """The car passes each check of the contract."""
    road = load_road("straight")
    vehicle = MetaDriveVehicle(road, FlatPose(*road.start), START_NS)
    assert CHECKS[name](vehicle, START_NS, LIMITS) == []


def test_the_lane_keeper_drives_it(tmp_path: Path) -> None:
    """The lane keeper completes the key part of route a with it, at most half a metre from the lane's centre."""
    changes = ("vehicle.kind=metadrive", "vehicle.scenery=none", "fidelity=pixels", "camera.width_px=320")
    run = plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), [*changes, "camera.height_px=240"]))
    result = run_once(run, tmp_path / "run")
    assert (result["ending"], result["valid"]) == ("completed", True)
    assert result["p95_m"] < 0.5
