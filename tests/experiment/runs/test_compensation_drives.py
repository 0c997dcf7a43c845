"""Drives in virtual time at delays beyond the boundary of the lane keeper."""

from __future__ import annotations

from typing import Any

import pytest

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.runs.monitored_run import MonitoredRun, drive_monitored
from lavt.experiment.runs.plan import plan_run


def drive_route(kind: str, condition: str, *changes: Any) -> MonitoredRun:
    """Drive the key part of route A without pixels."""
    settings = [
        "time=virtual",
        "fidelity=geometry",
        f"controller.kind={kind}",
        f"network.condition={condition}",
        "safety.picture_age_limit_ms=2000",
        "safety.stopping_distance_limit_m=200",
    ]
    return drive_monitored(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), [*settings, *changes])))


@pytest.mark.parametrize("condition", ["L5", "H2", pytest.param("H4", marks=pytest.mark.full)])
def test_the_predictive_controller_stays_in_its_lane(condition: str) -> None:
    """At L5 and beyond, the route is completed within 0.5 m of the lane's centre."""
    drive = drive_route("predictive", condition)
    assert (drive.ending, drive.lane_invasions) == ("completed", 0)
    assert max(map(abs, drive.cross_track_m)) < 0.5


def test_the_lane_keeper_does_not() -> None:
    """At 500 + 100 ms the lane keeper leaves its lane on the same route."""
    assert drive_route("lane_keeper", "H2").lane_invasions > 0
