"""A run whose vehicle is a software car behind a by-wire kit, in virtual time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lavt.config import RunConfig
from lavt.config_file import parse_config
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once

GENERATIONS = ("dataspeed_gen1", "dataspeed_gen2")


def result_of(out: Path, kind: str, profile: str = GENERATIONS[0]) -> dict[str, Any]:
    said = {
        "vehicle": {
            "kind": kind,
            "route": "a_key",
            "dbw": {"profile": profile, "interface": "inside", "steering_sign": 1},
        },
        "fidelity": "geometry",
    }
    return run_once(plan_run(parse_config(RunConfig, said, "the run")), out)


@pytest.mark.parametrize("profile", [pytest.param(GENERATIONS[0], marks=pytest.mark.full), GENERATIONS[1]])
def test_a_route_is_driven_through_the_kit(profile: str, tmp_path: Path) -> None:
    """Over a bus the key part of route A is driven about as well as without, and each hop to the wheel is timed."""
    result, without = result_of(tmp_path / "by-wire", "dbw", profile), result_of(tmp_path / "without", "simulator")
    assert (result["ending"], result["valid"]) == ("completed", True)
    assert result["p95_m"] <= 0.22
    assert result["p95_m"] == pytest.approx(without["p95_m"], abs=0.03)
    (wheel,) = [
        stage for stage in result["stages_ms"] if (stage["node"], stage["stage"]) == ("vehicle", "command to wheel")
    ]
    assert wheel["n"] > 100
    assert 0 < wheel["p50"] < wheel["p95"] < 20, "a frame's time on the bus, the kit's report, and half its period"


@pytest.mark.full
def test_the_same_seed_gives_the_same_run(tmp_path: Path) -> None:
    """Bus, kit and adapter are as deterministic as all else in virtual time."""
    first, second = result_of(tmp_path / "first", "dbw"), result_of(tmp_path / "second", "dbw")
    assert first["digest"] == second["digest"]
