"""What LAVT_REQUIRE makes of a test that does not find what it needs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
NEEDY = """
from tests.require import need

def test_needy():
    need("unicorn", "no unicorn here")
"""


def outcome(folder: Path, required: str | None, tests: str, **variables: str) -> tuple[int, str]:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LAVT_")} | variables
    if required is not None:
        environment["LAVT_REQUIRE"] = required
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", f"--rootdir={folder}", tests],
        cwd=REPOSITORY,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout


@pytest.mark.parametrize(
    ("required", "code", "said"),
    [
        (None, 0, "1 skipped"),
        ("", 0, "1 skipped"),
        ("kernel", 0, "1 skipped"),
        ("unicorn", 1, "LAVT_REQUIRE names unicorn: no unicorn here"),
        ("kernel, unicorn", 1, "1 failed"),
    ],
)
def test_what_is_required_may_not_be_missing(tmp_path: Path, required: str | None, code: int, said: str) -> None:
    """A test skips where the machine lacks something, and fails where LAVT_REQUIRE names that."""
    file = tmp_path / "test_needy.py"
    file.write_text(NEEDY)

    exit_code, output = outcome(tmp_path, required, str(file))

    assert exit_code == code
    assert said in output


@pytest.mark.parametrize(
    ("required", "code", "said"), [(None, 0, "tests/kernel/run"), ("kernel", 1, "LAVT_REQUIRE names kernel")]
)
def test_the_lane_skips_on_an_ordinary_machine(tmp_path: Path, required: str | None, code: int, said: str) -> None:
    """Outside the lane its tests skip and name its command; where the kernel is required they fail."""
    exit_code, output = outcome(tmp_path, required, "tests/kernel/test_lane.py")

    assert exit_code == code, output
    assert said in output


@pytest.mark.parametrize(
    ("required", "code", "said"),
    [(None, 0, "apt-get install gstreamer1.0-tools"), ("gstreamer", 1, "LAVT_REQUIRE names gstreamer: needs gst")],
)
def test_the_tests_with_foreign_tools_skip_where_there_are_none(
    tmp_path: Path, required: str | None, code: int, said: str
) -> None:
    """Without GStreamer and ffmpeg their tests skip and name the packages; where these are required they fail."""
    exit_code, output = outcome(tmp_path, required, "tests/interop", PATH=str(tmp_path))

    assert exit_code == code, output
    assert said in output
    assert "passed" not in output
