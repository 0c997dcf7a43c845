"""`lavt boundary` as a user types it."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

from lavt.config_file import shipped

BOUNDARY = str(shipped("configs/boundary.yaml"))
SMALL = ["routes=[a_key]", "presets=[paper_calibrated]", "longest_delay_ms=300", "grid_ms=150", "within_ms=30"]


def command(*arguments: str) -> list[str]:
    changes = [part for each in SMALL for part in ("--set", each)]
    return [sys.executable, "-m", "lavt", "boundary", BOUNDARY, *changes, *arguments]


def test_it_writes_what_it_found(tmp_path: Path) -> None:
    """One JSON object on standard output, the same in boundary.json, a row for each seed in CSV, and two pictures."""
    out = tmp_path / "out"
    done = subprocess.run(
        command("--set", "repetitions=1", "--out", str(out), "--jobs", "1", "--json"),
        capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    found = json.loads(done.stdout)
    assert found == json.loads((out / "boundary.json").read_text())
    assert (found["schema"], found["failed"], found["config"]["within_ms"]) == (1, [], 30.0)
    with (out / "boundary.csv").open() as file:
        (row,) = csv.DictReader(file)
    (run,) = found["runs"]
    assert list(row) == [
        "route", "preset", "seed", "repetition", "onset_ms", "departure_ms", "completion_ms", "theory_ms",
    ]  # fmt: skip
    assert float(row["onset_ms"]) == run["onset_ms"]
    assert sorted(path.name for path in out.iterdir()) == [
        "boundary.csv", "boundary.json", "boundary.png", "boundary.svg",
    ]  # fmt: skip
    assert "a_key paper_calibrated 00: onset " in done.stderr
