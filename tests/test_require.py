"""The effect of LAVT_REQUIRE on tests whose requirements are missing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
TEST_THAT_NEEDS_A_UNICORN = """
from tests.require import need

def test_needy():
    need("unicorn", "no unicorn here")
"""


def run_tests(folder: Path, required: str | None, tests: str, **variables: str) -> tuple[int, str]:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LAVT_")} | variables
    if required is not None:
        environment["LAVT_REQUIRE"] = required
    completed = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", f"--rootdir={folder}", tests],
        cwd=REPOSITORY,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return completed.returncode, completed.stdout


@pytest.mark.parametrize(
    ("required", "code", "expected"),
    [
        (None, 0, "1 skipped"),
        pytest.param("", 0, "1 skipped", marks=pytest.mark.full),
        ("kernel", 0, "1 skipped"),
        ("unicorn", 1, "LAVT_REQUIRE names unicorn: no unicorn here"),
        ("kernel, unicorn", 1, "1 failed"),
    ],
)
def test_missing_requirement_fails(tmp_path: Path, required: str | None, code: int, expected: str) -> None:
    """A test whose requirement is missing is skipped, or fails if LAVT_REQUIRE names the requirement."""
    file = tmp_path / "test_needy.py"
    file.write_text(TEST_THAT_NEEDS_A_UNICORN)

    exit_code, output = run_tests(tmp_path, required, str(file))

    assert exit_code == code
    assert expected in output


@pytest.mark.full
@pytest.mark.parametrize(
    ("required", "code", "expected"), [(None, 0, "tests/kernel/run"), ("kernel", 1, "LAVT_REQUIRE names kernel")]
)
def test_kernel_lane_skips_on_an_ordinary_machine(
    tmp_path: Path, required: str | None, code: int, expected: str
) -> None:
    """Outside their lane, kernel tests are skipped and name the lane's command, or fail if the kernel is required."""
    exit_code, output = run_tests(tmp_path, required, "tests/kernel/test_lane.py")

    assert exit_code == code, output
    assert expected in output


@pytest.mark.full
@pytest.mark.parametrize(
    ("required", "code", "expected"),
    [(None, 0, "apt-get install gstreamer1.0-tools"), ("gstreamer", 1, "LAVT_REQUIRE names gstreamer: needs gst")],
)
def test_interop_tests_skip_without_their_tools(tmp_path: Path, required: str | None, code: int, expected: str) -> None:
    """Without GStreamer and ffmpeg, interop tests are skipped and name the packages, or fail if required."""
    exit_code, output = run_tests(tmp_path, required, "tests/interop", PATH=str(tmp_path))

    assert exit_code == code, output
    assert expected in output
    assert "passed" not in output
