"""Imported roads as routes of sweeps, driven in the simulator and in a stand-in for a CARLA server."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from tests.carla.stand_in import REPOSITORY, stand_in

pytestmark = pytest.mark.full

HAMLET = REPOSITORY / "tests" / "opendrive" / "data" / "hamlet.xodr"
PICTURE = ("320", "240")
LARGEST_DIFFERENCE_M = 0.01


def run_lavt(directory: Path, *words: object) -> list[str]:
    """Run a command in a directory, and return the lines that it printed."""
    done = subprocess.run(
        [sys.executable, "-m", "lavt", *map(str, words)],
        cwd=directory,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY / "src")},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_an_imported_route_is_driven_in_both_and_compared(tmp_path: Path) -> None:
    """One config drives lanes of a small map in both vehicles, and one command prints the results side by side."""
    run_lavt(tmp_path, "road", "import", HAMLET, "--from", "1,1", "--to", "1,1", "--out", "hamlet.yaml")
    config = {
        "vehicle": {"scenery": "none"},
        "camera": {"width_px": int(PICTURE[0]), "height_px": int(PICTURE[1])},
        "fidelity": "pixels",
        "routes": ["hamlet.yaml"],
        "conditions": ["L0"],
    }
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(config))
    options = ("sweep.yaml", "--jobs", "1", "--out")
    run_lavt(tmp_path, "sweep", *options, "out/simulator")
    with stand_in("--road", str(tmp_path / "hamlet.yaml"), "--scenery", "none", "--camera", *PICTURE) as server:
        changes = ("--set", "vehicle.kind=carla", "--set", f"vehicle.carla.port={server.port}")
        run_lavt(tmp_path, "sweep", *options, "out/carla", *changes, "--set", "vehicle.carla.timeout_s=30.0")
    header, line, last = run_lavt(tmp_path, "report", "out/simulator", "out/carla", "--out", "out/both")
    assert header.split()[:4] == ["route", "condition", "simulator:", "completed"]
    assert line.split()[:5] == ["hamlet", "L0", "1", "of", "1"]
    assert line.split()[6:9] == ["1", "of", "1"]
    assert abs(float(line.split()[-1])) <= LARGEST_DIFFERENCE_M
    assert last == "the report is out/both/report/index.html"
