"""Tests of `benchmarks/recompute.py`, which recomputes a sweep without LAVT."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from benchmarks.recompute import differences, main
from benchmarks.recomputing.runs import recompute_run

from lavt.config import SweepConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.runs.plan import plan_sweep
from lavt.experiment.sweep.sweep import drive_sweep

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SCRIPT = BENCHMARKS / "recompute.py"
CHANGES = (
    "fidelity=geometry",
    "routes=[a_key, b_key]",
    "conditions=[L2, L3]",
    "repetitions=2",
    "clocks.offset_ms=120",
    "clocks.drift_ppm=30",
)
"""Drives that are completed in their own lane, completed in others, and not completed; on clocks that differ."""


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the directory of a small sweep."""
    config = load_config(SweepConfig, shipped("configs/paper.yaml"), CHANGES)
    out: Path = tmp_path_factory.mktemp("sweep")
    drive_sweep(config, plan_sweep(config), out, jobs=2, on_progress=lambda _: None)
    return out


def recompute(directory: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, SCRIPT, directory], capture_output=True, text=True, timeout=250, check=False)


@pytest.mark.full
def test_every_value_is_recomputed_without_lavt(sweep: Path) -> None:
    """All values of a small sweep are recomputed from its records, with no difference beyond rounding."""
    completed = recompute(sweep)
    assert "; 0 differ by more than rounding" in completed.stdout, completed.stdout + completed.stderr
    assert completed.returncode == 0
    count = re.search(r"(\d+) values were recomputed", completed.stdout)
    assert count is not None
    assert int(count[1]) > 8 * 60
    assert completed.stdout.count("\n| L") == 2
    summary: Any = json.loads((sweep / "summary.json").read_text())
    l2, l3 = (summary["conditions"][name] for name in ("L2", "L3"))
    assert l2["completion_rate"] == 1.0
    assert 0.0 < l2["own_lane_completion_rate"] < 1.0
    assert 0.0 < l3["completion_rate"] < 1.0


@pytest.mark.full
def test_a_wrong_value_is_found(sweep: Path) -> None:
    """Each published value of a run that is not the recomputed one, or is missing, is named."""
    directory = sweep / "runs" / "b_key_L2_00"
    values, result = recompute_run(directory), json.loads((directory / "result.json").read_text())
    assert list(differences("run", values, result)) == []
    result["p95_m"] *= 1 + 1e-6
    result["lane_kept"]["followed_changes"] += 1
    result["tau_v_ms"]["p50"] += 1e-6  # 1 ns
    result["p95_by_10m"].pop()
    del result["ending"]
    names = {text.split(":")[0] for text in differences("run", values, result)}
    changed = ("p95_m", "lane_kept.followed_changes", "tau_v_ms.p50", "p95_by_10m", "ending")
    assert names == {f"run.{name}" for name in changed}


def test_a_single_run_is_recomputed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A directory with a result is one of a run; its values are compared without a table of conditions."""
    (tmp_path / "result.json").write_text('{"p95_m": 1.0}')
    for p95_m, code in ((1.0, 0), (2.0, 1)):
        monkeypatch.setattr("benchmarks.recompute.recompute_run", lambda _directory, p95_m=p95_m: {"p95_m": p95_m})
        assert main([str(tmp_path)]) == code
        assert capsys.readouterr().out.startswith(f"1 values were recomputed; {code} differ")


def test_the_exit_code_tells_of_differences(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a difference the program names it and returns 1, otherwise 0."""
    for found, code in ((["summary.x: recomputed 1, published 2"], 1), ([], 0)):
        monkeypatch.setattr("benchmarks.recompute.recompute_sweep", lambda _directory, found=found: ({}, found, 5))
        assert main(["out"]) == code
        printed = capsys.readouterr().out
        assert f"5 values were recomputed; {len(found)} differ" in printed
        assert ("summary.x" in printed) == bool(found)


def test_nothing_of_lavt_is_imported() -> None:
    """The program imports the standard library, `mcap`, `numpy`, `scipy` and its own modules only."""
    allowed = {*sys.stdlib_module_names, "mcap", "numpy", "scipy", "benchmarks"}
    for path in (SCRIPT, *(BENCHMARKS / "recomputing").glob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
        names += [str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)]
        assert {name.split(".")[0] for name in names} <= allowed
        assert {name for name in names if name.startswith("benchmarks")} <= {
            "benchmarks.recomputing.conditions",
            "benchmarks.recomputing.runs",
        }
