"""On a system without what only Linux has, virtual time works, and real time is rejected with one sentence."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from lavt import operating_system
from lavt.cli.main import COMMANDS, ON_ANY_SYSTEM
from lavt.errors import UserError
from lavt.operating_system import missing_in_real_time

SCRIPT = Path(__file__).parent / "support" / "other_system.py"
REPOSITORY = SCRIPT.parents[2]


def run_elsewhere(*arguments: str, like: str = "windows") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(SCRIPT), *arguments],
        cwd=REPOSITORY,
        env={**os.environ, "LAVT_LIKE": like},
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )


def test_here_nothing_is_missing() -> None:
    """On Linux, real time lacks nothing."""
    assert missing_in_real_time() == ""


@pytest.mark.parametrize("like", ["windows", pytest.param("macos", marks=pytest.mark.full)])
def test_all_modules_can_be_imported(like: str) -> None:
    """No module needs one of the names when it is imported."""
    completed = run_elsewhere(like=like)
    assert completed.returncode == 0, completed.stderr


@pytest.mark.parametrize(
    ("arguments", "like"),
    [
        (["server"], "macos"),
        pytest.param(["keys"], "windows", marks=pytest.mark.full),
        (["run", "configs/demo.yaml", "--set", "time=real"], "windows"),
    ],
)
def test_real_time_is_rejected(arguments: list[str], like: str, tmp_path: Path) -> None:
    """A command that needs Linux says so in one sentence, and what to do, with exit code 2."""
    out = ["--out", str(tmp_path / "out")] if arguments[0] == "run" else []
    completed = run_elsewhere(*arguments, *out, like=like)
    assert completed.returncode == 2
    [line] = completed.stderr.splitlines()
    assert "needs Linux (this system has no os.sched_getaffinity): use a machine with Linux" in line
    assert not (tmp_path / "out").exists()


def test_the_commands_on_any_system_exist() -> None:
    """The table names only commands of LAVT."""
    assert set(COMMANDS) > ON_ANY_SYSTEM


def test_a_run_is_driven(tmp_path: Path) -> None:
    """A run in virtual time is driven."""
    short = ["--set", "fidelity=geometry", "--set", "vehicle.time_limit_s=2"]
    completed = run_elsewhere("run", "configs/demo.yaml", *short, "--out", str(tmp_path / "run"))
    assert completed.returncode == 0, completed.stderr
    assert (tmp_path / "run" / "result.json").exists()


@pytest.mark.full
def test_the_demo_leaves_out_real_time(tmp_path: Path) -> None:
    """The demo leaves out the part in real time and says so, drives the rest in processes, and writes its report.

    Here it drives on one of its roads.
    """
    completed = run_elsewhere("demo", "--out", str(tmp_path / "demo"))
    assert completed.returncode == 0, completed.stderr
    assert "the part in real time needs Linux" in completed.stderr
    assert (tmp_path / "demo" / "report" / "index.html").exists()


def test_without_loopback_a_run_in_real_time_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the address of the machine itself cannot be reached, the sentence names the interface to enable."""
    operating_system.require_loopback()
    monkeypatch.setattr(operating_system, "LOOPBACK", "255.255.255.255")  # a socket may not send to all by default
    with pytest.raises(UserError, match="ip link set lo up"):
        operating_system.require_loopback()
