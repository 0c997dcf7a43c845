from __future__ import annotations

import json
import subprocess
import sys

import pytest

LARGE_PACKAGES = {"av", "can", "cantools", "cryptography", "cv2", "matplotlib", "mcap", "scipy", "zenoh"}
SMALL_COMMANDS = ["boundary", "can", "keys", "netem", "relay", "rendezvous", "road", "router", "software-car"]
ALLOWED_PACKAGES: dict[str, set[str]] = {
    **{command: set() for command in SMALL_COMMANDS},
    "clock": {"mcap"},
    "stop": {"zenoh"},
    "vehicles": {"zenoh"},
    "run": {"av", "cv2", "mcap"},
    "server": {"av", "cv2", "mcap", "zenoh"},
    "client": {"av", "cv2", "mcap", "zenoh"},
    "": {"av", "cv2", "mcap", "zenoh"},  # the help of `lavt`, which describes all commands
}
"""The large packages that a command may import before it begins its work."""

LIST_IMPORTS = """
import contextlib, io, json, os, sys
import lavt.config
from lavt.cli.main import main

for command in sys.argv[1:]:
    if os.fork() == 0:
        sys.argv = ["lavt", *command.split(), "--help"]
        with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
            main()
        print(json.dumps([command, sorted(name for name in sys.modules if "." not in name)]), flush=True)
        os._exit(0)
    os.wait()
"""
"""A program that prints the packages that each command imports; a fork of the program runs each command."""


@pytest.fixture(scope="module")
def imported() -> dict[str, list[str]]:
    """Return the packages that the help of each command imports."""
    completed = subprocess.run(
        [sys.executable, "-c", LIST_IMPORTS, *ALLOWED_PACKAGES], capture_output=True, text=True, timeout=300, check=True
    )
    return dict(json.loads(line) for line in completed.stdout.splitlines())


@pytest.mark.parametrize("command", ALLOWED_PACKAGES)
def test_a_command_imports_no_large_package_that_it_does_not_use(command: str, imported: dict[str, list[str]]) -> None:
    """The start of a command imports only the large packages that it uses."""
    assert "lavt" in imported[command]
    assert {*imported[command]} & LARGE_PACKAGES <= ALLOWED_PACKAGES[command]
