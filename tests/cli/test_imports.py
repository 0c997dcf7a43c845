from __future__ import annotations

import json
import subprocess
import sys

import pytest

LARGE_PACKAGES = {
    "av",
    "can",
    "cantools",
    "carla",
    "cryptography",
    "cv2",
    "matplotlib",
    "mcap",
    "numpy",
    "scipy",
    "zenoh",
}
SMALL_COMMANDS = ["boundary", "can", "keys", "netem", "rendezvous", "router"]
ALLOWED_PACKAGES: dict[str, set[str]] = {
    **{command: set() for command in SMALL_COMMANDS},
    **{command: {"numpy"} for command in ("relay", "road", "software-car")},
    "clock": {"mcap", "numpy"},
    "stop": {"zenoh"},
    "vehicles": {"zenoh"},
    "run": {"av", "cv2", "mcap", "numpy"},
    "server": {"av", "cv2", "mcap", "numpy", "zenoh"},
    "drive": {"av", "cv2", "mcap", "numpy", "zenoh"},
    "client": {"av", "cv2", "mcap", "numpy", "zenoh"},
}
"""The large packages that a command may import before it begins its work."""

HELP_IMPORTS = """
import contextlib, io, json, sys
from lavt.cli.main import main

sys.argv = ["lavt", "--help"]
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
    main()
print(json.dumps(sorted(sys.modules)))
"""
"""A program that prints the modules that the help of `lavt` imports."""

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

INTERRUPTED_IMPORT = """
import runpy, signal, sys

interrupted = sys.argv[1]

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == interrupted:
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                raise ValueError("as from the import of pydantic's models")

signal.signal(signal.SIGINT, signal.default_int_handler)  # even if the tests ignore it
sys.meta_path.insert(0, Finder())
sys.argv = ["lavt", "run", "absent.yaml"]
runpy.run_module("lavt", run_name="__main__")
"""
"""A program that sends itself SIGINT when `lavt run` imports the module that the first argument names."""

INTERRUPTED_END = """
import os, runpy, signal, sys, threading, time

def interrupt():
    while threading.main_thread().is_alive():  # until the interpreter waits for this thread
        time.sleep(0.001)
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(60)

signal.signal(signal.SIGINT, signal.default_int_handler)  # even if the tests ignore it
threading.Thread(target=interrupt).start()
sys.argv = ["lavt", "--version"]
runpy.run_module("lavt", run_name="__main__")
"""
"""A program that sends itself SIGINT when `lavt --version` has ended and a thread has not."""


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


def test_the_help_of_lavt_imports_no_command() -> None:
    """The help of `lavt` imports no module of a command, and none of the packages that commands need."""
    completed = subprocess.run(
        [sys.executable, "-c", HELP_IMPORTS], capture_output=True, text=True, timeout=300, check=True
    )
    modules = set(json.loads(completed.stdout))
    assert {name for name in modules if name.startswith("lavt.cli.")} == {"lavt.cli.console", "lavt.cli.main"}
    assert not modules & (LARGE_PACKAGES | {"msgspec", "pydantic", "yaml"})


@pytest.mark.parametrize("module", ["lavt.cli.main", "typer", "pydantic", "lavt.cli.run", "lavt.config_file"])
def test_ctrl_c_during_the_start_of_a_command(module: str) -> None:
    """Ctrl-C while a command imports its modules ends it with exit code 130 and no traceback."""
    completed = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_IMPORT, module], capture_output=True, text=True, timeout=300, check=False
    )
    assert (completed.returncode, completed.stdout, completed.stderr) == (130, "", "")


def test_ctrl_c_while_a_command_ends() -> None:
    """Ctrl-C while a command that has done its work waits for its threads ends it at once, without a traceback."""
    completed = subprocess.run(
        [sys.executable, "-c", INTERRUPTED_END], capture_output=True, text=True, timeout=300, check=False
    )
    assert completed.stdout.startswith("lavt ")
    assert (completed.returncode, completed.stderr) == (130, "")


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_closed_standard_streams(closed: tuple[int, ...]) -> None:
    """A command whose standard streams are closed runs, and rejects wrong input with exit code 2."""
    closing = " ".join(f"{number}>&-" for number in closed)
    command = f'exec "$0" -m lavt server missing.yaml {closing}'
    result = subprocess.run(["/bin/sh", "-c", command, sys.executable], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert 2 in closed or "missing.yaml cannot be read" in result.stderr
