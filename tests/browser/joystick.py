"""A joystick for a real browser: a device of umockdev, which the browser finds and reads like one of the kernel."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Final

PACKAGES: Final = ("umockdev",)
"""Debian packages; .ci/run installs them."""
PRELOAD: Final = "libumockdev-preload.so.0"
PROGRAM: Final = Path(__file__).with_name("joystick_devices.py")
FULL: Final = 32767
"""The value of an axis at its end."""


def is_missing() -> bool:
    """Return whether umockdev's libraries are not installed, or not for this Python."""
    command = [sys.executable, "-c", f"import ctypes; ctypes.CDLL('libumockdev.so.0'); ctypes.CDLL('{PRELOAD}')"]
    return subprocess.run(command, stderr=subprocess.DEVNULL, check=False).returncode != 0


class Joystick:
    """A gamepad that is not plugged yet; `environment` lets a program see it."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.environment: Mapping[str, str] = {"LD_PRELOAD": PRELOAD, "UMOCKDEV_DIR": self._line()}

    def plug(self) -> None:
        """Connect the gamepad."""
        self._execute("plug")

    def unplug(self) -> None:
        """Disconnect the gamepad."""
        self._execute("unplug")

    def button(self, number: int, *, down: bool) -> None:
        """Press or release a button."""
        self._execute(f"button {number} {int(down)}")

    def axis(self, number: int, value: int) -> None:
        """Move an axis to a value of -`FULL` to `FULL`."""
        self._execute(f"axis {number} {value}")

    def _execute(self, command: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()
        assert self._line() == "done"

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


@contextmanager
def joystick() -> Iterator[Joystick]:
    """Yield a gamepad that is not plugged yet, and remove it afterwards."""
    process = subprocess.Popen(
        [sys.executable, PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"LD_PRELOAD": PRELOAD},
    )
    try:
        yield Joystick(process)
    finally:
        process.communicate()
