from __future__ import annotations

import sys
from pathlib import Path

import pytest

from lavt.errors import UserError
from lavt.recording.output_directory import replace_text, reserve_directory


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
