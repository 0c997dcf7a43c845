from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

import pytest

from lavt.errors import UserError
from lavt.recording.output_directory import disk_errors_named, replace_text, reserve_directory


def test_a_reserved_directory_is_not_shared(tmp_path: Path) -> None:
    """While a directory is reserved, it cannot be reserved again; afterwards it can."""
    with (
        reserve_directory(tmp_path),
        pytest.raises(UserError, match="another command"),
        reserve_directory(tmp_path),
    ):
        pass
    with reserve_directory(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is always full: /dev/full")
def test_an_error_of_the_disk_names_the_directory(tmp_path: Path) -> None:
    """A write to a full disk raises an error with the output directory, whose own error names no file."""
    with pytest.raises(OSError, match=tmp_path.name) as raised, disk_errors_named(tmp_path):
        Path("/dev/full").write_text("text")
    assert raised.value.errno == errno.ENOSPC


def test_an_error_that_names_a_file_is_raised_as_it_is(tmp_path: Path) -> None:
    """An error that names its file, or is not one of a disk, does not get the output directory."""
    with pytest.raises(FileNotFoundError, match="absent"), disk_errors_named(tmp_path):
        (tmp_path / "absent").read_text()
    with pytest.raises(OSError, match="Bad file descriptor") as raised, disk_errors_named(tmp_path):
        os.close(-1)
    assert raised.value.filename is None


def test_without_flock_nothing_is_reserved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a system without `flock` the reservation does nothing."""
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with reserve_directory(tmp_path), reserve_directory(tmp_path):
        pass


def test_a_file_that_cannot_be_written_stays(tmp_path: Path) -> None:
    """If a text cannot be written, the old file stays, and no other file is left."""
    path = tmp_path / "road.yaml"
    replace_text(path, "old")
    with pytest.raises(UnicodeEncodeError):
        replace_text(path, "x" * 10_000 + "\udc80")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    replace_text(path, "new")
    assert path.read_text() == "new"
