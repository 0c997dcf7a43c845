"""Tests of runs in virtual time whose vehicle is a software car behind a by-wire kit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lavt.config import RunConfig
from lavt.config_file import parse_config
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once
from lavt.vehicle.dbw.speed_monitor import SpeedFault, SpeedMonitor

GENERATIONS = ("dataspeed_gen1", "dataspeed_gen2")


@pytest.fixture
def speed_faults(monkeypatch: pytest.MonkeyPatch) -> list[SpeedFault]:
    """Return a list that collects the implausible speeds of all runs."""
    faults: list[SpeedFault] = []
    update = SpeedMonitor.update

    def collect(*arguments: Any) -> SpeedFault | None:
        fault = update(*arguments)
        faults.extend([] if fault is None else [fault])
        return fault

    monkeypatch.setattr(SpeedMonitor, "update", collect)
    return faults


def result_of(out: Path, kind: str, profile: str = GENERATIONS[0], route: str = "a_key") -> dict[str, Any]:
    settings = {
        "vehicle": {
            "kind": kind,
            "route": route,
            "dbw": {"profile": profile, "interface": "inside", "steering_sign": 1},
        },
        "fidelity": "geometry",
    }
    return run_once(plan_run(parse_config(RunConfig, settings, "the run")), out)


@pytest.mark.parametrize("profile", [pytest.param(GENERATIONS[0], marks=pytest.mark.full), GENERATIONS[1]])
def test_a_route_is_driven_through_the_kit(profile: str, tmp_path: Path, speed_faults: list[SpeedFault]) -> None:
    """A route is driven about as well with the kit as without the kit, and the latency to the wheel is measured."""
    result, without_kit = result_of(tmp_path / "by-wire", "dbw", profile), result_of(tmp_path / "without", "simulator")
    assert (result["ending"], result["valid"]) == ("completed", True)
    assert result["p95_m"] <= 0.22
    assert result["p95_m"] == pytest.approx(without_kit["p95_m"], abs=0.03)
    (wheel,) = [
        stage for stage in result["stages_ms"] if (stage["node"], stage["stage"]) == ("vehicle", "command to wheel")
    ]
    assert wheel["n"] > 100
    assert speed_faults == []
    assert 0 < wheel["p50"] < wheel["p95"] < 20, "the frame's time on the bus, and the wait for the kit's next report"


@pytest.mark.full
@pytest.mark.parametrize("profile", GENERATIONS)
@pytest.mark.parametrize("route", ["b_key", "c_key"])
def test_no_drive_has_an_implausible_speed(
    profile: str, route: str, tmp_path: Path, speed_faults: list[SpeedFault]
) -> None:
    """The routes b_key and c_key are driven without a false alarm on the speed, too."""
    assert result_of(tmp_path, "dbw", profile, route)["ending"] == "completed"
    assert speed_faults == []


@pytest.mark.full
def test_a_by_wire_run_is_reproducible(tmp_path: Path) -> None:
    """A run with bus, kit and adapter in virtual time is byte-for-byte reproducible."""
    first, second = result_of(tmp_path / "first", "dbw"), result_of(tmp_path / "second", "dbw")
    assert first["digest"] == second["digest"]
