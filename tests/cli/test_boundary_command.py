"""`lavt boundary` as a user types it."""

from __future__ import annotations

import csv
import json
import os
import signal
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


def test_what_was_found_before_ctrl_c_is_kept(tmp_path: Path) -> None:
    """Ctrl-C after the first seed: a sentence, exit code 1, and the seeds that were finished are in boundary.json."""
    out = tmp_path / "out"
    running = subprocess.Popen(
        command("--set", "repetitions=50", "--out", str(out), "--jobs", "1"), stderr=subprocess.PIPE, text=True
    )
    assert running.stderr is not None
    for line in running.stderr:
        if ": onset " in line:
            break
    os.kill(running.pid, signal.SIGINT)
    rest = running.stderr.read()
    assert running.wait(timeout=300) == 1
    assert f"lavt: stopped; what was found is in {out}" in rest
    assert "Traceback" not in rest
    runs = json.loads((out / "boundary.json").read_text())["runs"]
    assert 1 <= len(runs) < 50


def test_bad_input_is_refused_in_a_sentence(tmp_path: Path) -> None:
    """Exit code 2, one line on standard error, no traceback, and no directory is left."""
    for arguments, says in (
        (["--set", "network.video.delay_ms=5"], "network.video.delay_ms is what is searched for: leave it out"),
        (["--set", "routes=[nowhere]"], "there is no road 'nowhere'"),
        (["--set", "grid_ms=0"], "'grid_ms'"),
        (["--set", "conditions=[L0]"], "unknown key 'conditions'"),
        (["--set", "vehicle.kind=mine"], "vehicle.kind"),
    ):
        out = tmp_path / "out"
        done = subprocess.run(
            command(*arguments, "--out", str(out)), capture_output=True, text=True, check=False, timeout=120
        )
        assert (done.returncode, done.stdout) == (2, ""), done
        assert done.stderr.startswith("lavt: ")
        assert says in done.stderr
        assert done.stderr.count("\n") == 1
        assert not out.exists()


def test_a_directory_with_something_in_it_is_not_written_into(tmp_path: Path) -> None:
    """What is there is never overwritten."""
    (tmp_path / "boundary.json").write_text("mine")
    done = subprocess.run(command("--out", str(tmp_path)), capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 2
    assert "is not an empty directory" in done.stderr
    assert (tmp_path / "boundary.json").read_text() == "mine"
