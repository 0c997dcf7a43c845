"""The only module that imports the package `carla`, and only when a CARLA vehicle is built."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import Any

from lavt.errors import UserError

SUPPORTED = "0.9.16"
"""The version of client and server; another server's version aborts the client's process."""


def check_library() -> None:
    """Raise `UserError` if the package `carla` is not installed or has another version."""
    try:
        installed = version("carla")
    except PackageNotFoundError:
        raise UserError(
            f"vehicle.kind carla needs the package carla {SUPPORTED}: pip install -e '.[carla]' in the clone, with "
            "Python 3.11 or 3.12"
        ) from None
    if installed != SUPPORTED:
        raise UserError(
            f"the package carla is {installed}, but LAVT supports {SUPPORTED} only: pip install carla=={SUPPORTED}"
        )


def load_library() -> Any:
    """Return the module `carla`; raise `UserError` if it is not installed or has another version."""
    check_library()
    import carla  # noqa: PLC0415 (an extra, and large)

    return carla
