"""Output directories: no file in them is overwritten, and no directory is created for work that cannot begin."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lavt.errors import UserError

DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG}
"""The errors of a disk that a write can have."""


def check_directory(out: Path) -> None:
    """Raise `UserError` unless `out` is absent or an empty directory; create nothing."""
    try:
        is_usable = not out.exists() or (out.is_dir() and not any(out.iterdir()))
    except OSError as error:
        raise UserError(f"{out} cannot be read ({error.strerror}): name another directory with --out") from error
    if not is_usable:
        raise UserError(f"{out} is not an empty directory: name another with --out, or remove it")


def prepare_directory(out: Path) -> None:
    """Create the directory; raise `UserError` if it exists and is not empty."""
    check_directory(out)
    make_directory(out)


def make_directory(out: Path) -> None:
    """Create the directory unless it exists; raise `UserError` if it cannot be created."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out} cannot be created ({error.strerror}): name another directory with --out") from error


def check_output(out: Path, config: str, *, resume: bool) -> None:
    """Raise `UserError` unless new work can begin in `out`, or with `resume`, unless `out` has the file `config`.

    Stopped work leaves this file.
    """
    if not resume:
        check_directory(out)
    elif not os.path.isfile(out / config):  # noqa: PTH113 (`Path.is_file` raises for a directory that cannot be read)
        raise UserError(f"there is nothing to resume in {out}: omit --resume to begin")


@contextmanager
def disk_errors_named(output: Path | str) -> Iterator[None]:
    """Add the output's name to a disk error inside the `with` block; an error of writing itself names no file."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno in DISK_ERRORS:
            raise OSError(error.errno, error.strerror, str(output)) from error
        raise


@contextmanager
def reserve_directory(out: Path) -> Iterator[None]:
    """Keep other processes that call this out of an existing directory; raise `UserError` if one is in it.

    The operating system ends the reservation with the process. Where it has no `flock`, nothing is reserved.
    """
    try:
        import fcntl  # noqa: PLC0415 (not on every system)
    except ImportError:
        yield
        return
    descriptor = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise UserError(f"another command writes into {out}: wait for its end, or name another --out") from None
        yield
    finally:
        os.close(descriptor)


def replace_text(path: Path, text: str) -> None:
    """Write a text file atomically: a reader never sees an incomplete file, and an old one stays if writing fails."""
    unfinished = path.with_name(path.name + ".part")
    try:
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(path)
    except (OSError, UnicodeEncodeError):
        unfinished.unlink(missing_ok=True)
        raise
