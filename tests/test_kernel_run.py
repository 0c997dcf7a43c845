"""`tests/kernel/run` on a machine where it cannot run, and the arguments that it hands to pytest."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.kernel.lane.command import pytest_arguments, writable_directories

RUN = Path(__file__).parent / "kernel" / "run"


def rejection(*arguments: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, str(RUN), *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    return done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("given", "passed"),
    [
        ([], ["tests/kernel"]),
        (["-x", "-k", "lane"], ["-x", "-k", "lane", "tests/kernel"]),
        (["test_lane.py"], ["tests/kernel/test_lane.py"]),
        (["tests/kernel/test_lane.py", "-q"], ["tests/kernel/test_lane.py", "-q"]),
        (["test_lane.py::test_a[b.py]"], ["tests/kernel/test_lane.py::test_a[b.py]"]),
        (["tests/assembly/test_assembly.py"], ["tests/assembly/test_assembly.py", "tests/kernel"]),
    ],
)
def test_tests_are_named_by_their_file_alone(given: list[str], passed: list[str]) -> None:
    """A test file of the lane may be named by its name, and without one all of tests/kernel is run."""
    assert pytest_arguments(given) == passed


def test_without_debian_it_says_what_to_do(tmp_path: Path) -> None:
    """Where there is no apt-get, one sentence names a system that has it."""
    assert "use Debian or Ubuntu" in rejection(PATH=str(tmp_path), LAVT_KERNEL=str(tmp_path / "kernel"))


def test_without_the_archive_it_says_what_to_do(tmp_path: Path) -> None:
    """Where Debian's archive is out of reach, one sentence says so."""
    for name in ("apt-get", "dpkg"):
        stand_in = tmp_path / name
        stand_in.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('E: Could not resolve the archive')\n")
        stand_in.chmod(0o755)

    said = rejection(PATH=f"{tmp_path}{os.pathsep}{os.environ['PATH']}", LAVT_KERNEL=str(tmp_path / "kernel"))

    assert "Could not resolve the archive" in said
    assert "connect this machine" in said


def test_a_cache_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    """Where the cache directory cannot be made, one sentence names LAVT_KERNEL."""
    (tmp_path / "file").touch()

    assert "LAVT_KERNEL" in rejection(LAVT_KERNEL=str(tmp_path / "file" / "kernel"))


@pytest.mark.parametrize("told", [False, True])
def test_the_machines_may_write_where_they_are_told_to(
    told: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They write below --out and beside the file of LAVT_PROGRESS, and nowhere else."""
    progress = tmp_path / "lane" / "progress"
    monkeypatch.delenv("LAVT_PROGRESS", raising=False)
    if told:
        monkeypatch.setenv("LAVT_PROGRESS", str(progress))
    assert writable_directories(None) == [progress.parent] * told
    assert writable_directories(tmp_path / "out") == [*[progress.parent] * told, tmp_path / "out"]
