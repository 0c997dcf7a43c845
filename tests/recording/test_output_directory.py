from __future__ import annotations

import sys
from pathlib import Path

import pytest

from lavt.errors import UserError
from lavt.recording.output_directory import reserve_directory


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
