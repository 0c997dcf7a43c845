"""Drives with a CARLA server's stand-in between LAVT and its own car agree with drives without it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.carla.stand_in import StandIn, stand_in

from lavt.config import RunConfig
from lavt.config_file import parse_config
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.experiment.runs.run import run_once

ROUTE = "a_key"
TOLERANCE_M = 0.01
PICTURE = (320, 240)


def planned(kind: str, condition: str, port: int = 2000) -> PlannedRun:
    settings = {
        "vehicle": {"kind": kind, "route": ROUTE, "scenery": "none", "carla": {"port": port}},
        "camera": dict(zip(("width_px", "height_px"), PICTURE, strict=True)),
        "network": {"condition": condition},
        "fidelity": "pixels",
    }
    return plan_run(parse_config(RunConfig, settings, "the test"))


@pytest.fixture(scope="module")
def server() -> Iterator[StandIn]:
    """Start a stand-in server that all drives share."""
    with stand_in("--road", ROUTE, "--scenery", "none", "--camera", *map(str, PICTURE)) as started:
        yield started


@pytest.mark.full
@pytest.mark.parametrize("condition", ["L0", "L2", "L3", "L5"])
def test_a_drive_agrees_with_the_drive_without_carla(condition: str, server: StandIn, tmp_path: Path) -> None:
    """In virtual time, the 95th percentile of the cross-track error differs by less than 1 cm."""
    without = run_once(planned("simulator", condition), tmp_path / "without")
    through = run_once(planned("carla", condition, server.port), tmp_path / "through")
    assert (through["ending"], through["valid"]) == (without["ending"], True)
    assert abs(measured(through) - measured(without)) < TOLERANCE_M
    assert measured(through) != measured(without), "the two drives are the same drive"
    assert server.ask("actors") == ""
    assert server.ask("settings") == "False [False]"


def measured(result: dict[str, Any]) -> float:
    value = result["p95_m"]
    assert isinstance(value, float)
    return value
