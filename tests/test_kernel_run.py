"""`tests/kernel/run` on a machine where it cannot run, and the arguments that it passes to pytest."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.kernel.lane.command import pytest_arguments, writable_directories

RUN = Path(__file__).parent / "kernel" / "run"


def run_rejected(*arguments: str, **environment: str) -> str:
    """Run the lane where it cannot run; return the last line of its message."""
    completed = subprocess.run(
        [sys.executable, str(RUN), *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert completed.returncode == 2
    assert completed.stdout == ""
    assert "Traceback" not in completed.stderr
    return completed.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("extra", "expected"),
    [
        ([], ["tests/kernel"]),
        (["-x", "-k", "lane"], ["-x", "-k", "lane", "tests/kernel"]),
        (["test_lane.py"], ["tests/kernel/test_lane.py"]),
        (["tests/kernel/test_lane.py", "-q"], ["tests/kernel/test_lane.py", "-q"]),
        (["test_lane.py::test_a[b.py]"], ["tests/kernel/test_lane.py::test_a[b.py]"]),
        (["--ignore=tests/kernel/test_can.py"], ["--ignore=tests/kernel/test_can.py", "tests/kernel"]),
        (["tests/assembly/test_assembly.py"], ["tests/assembly/test_assembly.py", "tests/kernel"]),
    ],
)
def test_files_can_be_given_by_name(extra: list[str], expected: list[str]) -> None:
    """A test file of the lane can be given by its name alone; without a test file the whole directory runs."""
    assert pytest_arguments(extra) == expected


def test_missing_apt_get_is_reported(tmp_path: Path) -> None:
    """Without apt-get the message names systems that have apt-get."""
    assert "use Debian or Ubuntu" in run_rejected(PATH=str(tmp_path), LAVT_KERNEL=str(tmp_path / "kernel"))


def test_unreachable_archive_is_reported(tmp_path: Path) -> None:
    """If Debian's archive cannot be reached, the message says so."""
    for name in ("apt-get", "dpkg"):
        fake_tool = tmp_path / name
        fake_tool.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('E: Could not resolve the archive')\n")
        fake_tool.chmod(0o755)

    message = run_rejected(PATH=f"{tmp_path}{os.pathsep}{os.environ['PATH']}", LAVT_KERNEL=str(tmp_path / "kernel"))

    assert "Could not resolve the archive" in message
    assert "connect this machine" in message


def test_unwritable_cache_is_reported(tmp_path: Path) -> None:
    """If the cache directory cannot be created, the message names LAVT_KERNEL."""
    (tmp_path / "file").touch()

    assert "LAVT_KERNEL" in run_rejected(LAVT_KERNEL=str(tmp_path / "file" / "kernel"))


@pytest.mark.parametrize("has_progress", [False, True])
def test_writable_directories_of_the_machines(
    has_progress: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The machines can write to `--out` and to the directory of LAVT_PROGRESS, and nowhere else."""
    progress = tmp_path / "lane" / "progress"
    monkeypatch.delenv("LAVT_PROGRESS", raising=False)
    if has_progress:
        monkeypatch.setenv("LAVT_PROGRESS", str(progress))
    assert writable_directories(None) == [progress.parent] * has_progress
    assert writable_directories(tmp_path / "out") == [*[progress.parent] * has_progress, tmp_path / "out"]
