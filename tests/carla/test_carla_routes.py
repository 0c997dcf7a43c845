"""Imported roads as routes of sweeps, driven in the simulator and in a stand-in for a CARLA server."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import pytest
import yaml
from tests.carla.stand_in import REPOSITORY, stand_in

from lavt.cli.main import main

pytestmark = [pytest.mark.full, pytest.mark.timeout(900)]  # two sweeps and three reports, on a busy host

HAMLET = REPOSITORY / "tests" / "opendrive" / "data" / "hamlet.xodr"
PICTURE = ("320", "240")
LARGEST_DIFFERENCE_M = 0.01


def run_lavt(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], *words: object) -> list[str]:
    """Run a command in this process, which saves the imports, and return the lines that it printed."""
    capfd.readouterr()
    monkeypatch.setattr(sys, "argv", ["lavt", *map(str, words)])
    with pytest.raises(SystemExit) as raised:
        main()
    printed, messages = capfd.readouterr()
    assert not raised.value.code, messages
    return printed.splitlines()


def test_an_imported_route_is_driven_in_both_and_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """One config drives lanes of a small map in both vehicles, and one command prints the results side by side."""
    monkeypatch.chdir(tmp_path)
    run = partial(run_lavt, monkeypatch, capfd)
    run("road", "import", HAMLET, "--from", "1,1", "--to", "1,1", "--out", "hamlet.yaml")
    config = {
        "vehicle": {"scenery": "none"},
        "camera": {"width_px": int(PICTURE[0]), "height_px": int(PICTURE[1])},
        "fidelity": "pixels",
        "routes": ["hamlet.yaml"],
        "conditions": ["L0"],
    }
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(config))
    options = ("sweep.yaml", "--jobs", "1", "--out")
    run("sweep", *options, "out/simulator")
    with stand_in("--road", str(tmp_path / "hamlet.yaml"), "--scenery", "none", "--camera", *PICTURE) as server:
        changes = ("--set", "vehicle.kind=carla", "--set", f"vehicle.carla.port={server.port}")
        run("sweep", *options, "out/carla", *changes, "--set", "vehicle.carla.timeout_s=30.0")
    header, line, last = run("report", "out/simulator", "out/carla", "--out", "out/both")
    assert header.split()[:4] == ["route", "condition", "simulator:", "completed"]
    assert line.split()[:5] == ["hamlet", "L0", "1", "of", "1"]
    assert line.split()[6:9] == ["1", "of", "1"]
    assert abs(float(line.split()[-1])) <= LARGEST_DIFFERENCE_M
    assert last == "the report is out/both/report/index.html"
