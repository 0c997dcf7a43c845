from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from lavt.cli.report import report
from lavt.experiment.analysis.results import IDENTITY_KEYS, run_result, write_json
from lavt.recording.record import read_record

MakeRun = Callable[..., Path]


def add_run(make_run: MakeRun, sweep: Path, name: str, *, preset: str, condition: str = "L0") -> None:
    directory = make_run(sweep / "runs" / name, seconds=2.0)
    identity = {
        **dict.fromkeys(IDENTITY_KEYS),
        "run": name,
        "time": "virtual",
        "fidelity": "geometry",
        "injection": "model",
        "route": "a",
        "condition": condition,
        "preset": preset,
        "seed": 1,
        "repetition": 0,
        "injected_ms": {"video": 0.0, "control": 0.0},
        "digest": None,
    }
    server, client = (read_record(directory / f"{side}.mcap") for side in ("server", "client"))
    write_json(directory / "result.json", run_result(identity, server, client))


@pytest.fixture
def sweeps(make_run: MakeRun, tmp_path: Path) -> tuple[Path, Path]:
    """Return two sweeps whose directories and runs have equal names; the first sweep has one more run."""
    first, second = tmp_path / "old" / "sweep", tmp_path / "new" / "sweep"
    add_run(make_run, first, "a_L0_00", preset="paper_calibrated")
    add_run(make_run, first, "a_L1_00", preset="paper_calibrated", condition="L1")
    add_run(make_run, second, "a_L0_00", preset="designed")
    return first, second


@pytest.mark.full
def test_two_sweeps_in_one_report_are_separate_groups(sweeps: tuple[Path, Path], tmp_path: Path) -> None:
    """Each run names its sweep, each sweep is a group, and `conditions` has only the runs of the first sweep."""
    report(list(sweeps), tmp_path / "both")
    summary = json.loads((tmp_path / "both" / "summary.json").read_text())
    assert [(run["run"], run["sweep"], run["preset"]) for run in summary["runs"]] == [
        ("a_L0_00", "old/sweep", "paper_calibrated"),
        ("a_L1_00", "old/sweep", "paper_calibrated"),
        ("a_L0_00", "new/sweep", "designed"),
    ]
    assert {name: entry["runs"] for name, entry in summary["conditions"].items()} == {"L0": 1, "L1": 1}
    assert [(group["sweep"], list(group["conditions"])) for group in summary["groups"]] == [
        ("old/sweep", ["L0", "L1"]),
        ("new/sweep", ["L0"]),
    ]
    with (tmp_path / "both" / "report" / "tables" / "runs.csv").open(newline="") as file:
        assert [row["sweep"] for row in csv.DictReader(file)] == ["old/sweep", "old/sweep", "new/sweep"]
    figures = {path.stem for path in (tmp_path / "both" / "report").glob("trajectories*.svg")}
    assert figures == {
        "trajectories_whole_virtual_preset_paper_calibrated",
        "trajectories_whole_virtual_preset_designed",
    }


@pytest.mark.full
def test_a_single_sweep_has_no_name(sweeps: tuple[Path, Path], tmp_path: Path) -> None:
    """In a report of one directory or of single runs, no run and no group has the name of a sweep."""
    first, second = sweeps
    runs = [first / "runs" / "a_L0_00", second / "runs" / "a_L0_00"]
    for directories in ([first], runs):
        report(directories, tmp_path / "out")
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert not any("sweep" in entry for entry in [*summary["runs"], *summary["groups"]])
        assert len(summary["runs"]) == 2
