"""Test that `lavt boundary` prints its results and writes them to files."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from tests.support.command_line import Run

from lavt.config_file import shipped

BOUNDARY = str(shipped("configs/boundary.yaml"))
SMALL_SEARCH = [
    "routes=[a_key]",
    "presets=[paper_calibrated]",
    "longest_delay_ms=300",
    "grid_ms=150",
    "within_ms=30",
    "repetitions=1",
]


@pytest.mark.full
def test_results_are_printed_and_written(run: Run, tmp_path: Path) -> None:
    """The results are printed as JSON, and written as JSON, as CSV with a row for each seed, and as a figure."""
    out = tmp_path / "out"
    changes = [part for change in SMALL_SEARCH for part in ("--set", change)]
    code, printed, messages = run("boundary", BOUNDARY, *changes, "--out", str(out), "--jobs", "1", "--json")
    assert code == 0
    result = json.loads(printed)
    assert result == json.loads((out / "boundary.json").read_text())
    assert (result["schema"], result["failed"], result["config"]["within_ms"]) == (1, [], 30.0)
    with (out / "boundary.csv").open() as file:
        (row,) = csv.DictReader(file)
    (search,) = result["runs"]
    assert list(row) == [
        "route",
        "preset",
        "seed",
        "repetition",
        "onset_ms",
        "departure_ms",
        "completion_ms",
        "theory_ms",
    ]
    assert float(row["onset_ms"]) == search["onset_ms"]
    assert {path.name for path in out.iterdir()} == {
        "boundary.csv",
        "boundary.json",
        "boundary.png",
        "boundary.svg",
        "boundary.yaml",
    }
    assert "a_key paper_calibrated 00: onset " in messages
    assert run("boundary", BOUNDARY, *changes, "--out", str(out), "--resume", "--json")[:2] == (0, printed)
