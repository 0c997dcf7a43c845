"""Directories for what is written: what is in one is never overwritten, and none is made for work that cannot begin."""

from __future__ import annotations

from pathlib import Path

from lavt.errors import UserError


def check_directory(out: Path) -> None:
    """Raise `UserError` where `out` is anything but absent or empty; makes nothing."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UserError(f"{out} is not an empty directory: name another with --out, or remove it")


def prepare_directory(out: Path) -> None:
    """Make the directory; what is in it is never overwritten."""
    check_directory(out)
    make_directory(out)


def make_directory(out: Path) -> None:
    """Make the directory where there is none; raises `UserError` where it cannot be made."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be made ({error.strerror}): name another directory with --out") from error
