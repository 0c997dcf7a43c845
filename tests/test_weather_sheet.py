"""Tests of `benchmarks/weather_sheet.py`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks import weather_sheet

from lavt.vehicle.sim.road.road import load_road


def test_the_sweep_table_tells_completion_in_the_own_lane_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row counts completed runs and those in their own lane, and names the other endings."""
    endings = (("fog", "safe_stop", False), ("clear", "completed", True), ("night", "completed", False))
    for weather, ending, own in endings:
        run = tmp_path / "runs" / weather
        run.mkdir(parents=True)
        result = {
            "condition": "L0",
            "axes": {"vehicle.weather": weather},
            "ending": ending,
            "p95_m": 0.25,
            "completed_in_own_lane": own,
        }
        (run / "result.json").write_text(json.dumps(result))
    monkeypatch.setattr(weather_sheet, "confidences_of", lambda _: np.array([0.5, 0.5]))
    rows = weather_sheet.sweep_table(tmp_path).splitlines()[2:]
    assert rows == [
        "| L0 | `clear` | 1 | 1 | 1 | 0.25 m | 0.50, 0.50 |",
        "| L0 | `fog` | 1 | 0 (safe_stop) | 0 |  | 0.50, 0.50 |",
        "| L0 | `night` | 1 | 1 | 0 | 0.25 m | 0.50, 0.50 |",
    ]


def test_a_lane_on_the_roads_centre_has_no_error() -> None:
    """On a straight road a lane straight ahead has no error, and one that is 0.3 m aside has an error of 0.3 m."""
    road = load_road("straight")
    pose = weather_sheet.pose_on(road, 100.0, 0)
    assert weather_sheet.centre_error_m(road, pose, 100.0, np.zeros(3)) == pytest.approx(0.0, abs=1e-6)
    assert weather_sheet.centre_error_m(road, pose, 100.0, np.array([0.3, 0.0, 0.0])) == pytest.approx(0.3, abs=1e-6)
