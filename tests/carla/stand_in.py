"""Start a stand-in for a CARLA server as a process, and freeze or kill it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cv2  # noqa: F401 (its first import changes the environment, which no test may do)
from tests.require import need
from tests.support.ports import free_port_pair

from lavt.vehicle.carla.library import SUPPORTED

REPOSITORY = Path(__file__).resolve().parents[2]


def need_carla() -> None:
    """Skip the calling test without the wheel, or fail it if LAVT_REQUIRE names carla."""
    try:
        installed = version("carla")
    except PackageNotFoundError:
        installed = "missing"
    if installed != SUPPORTED:
        need("carla", f"needs the wheel carla {SUPPORTED}: pip install carla=={SUPPORTED} (Python 3.11 or 3.12)")


@dataclass(frozen=True)
class StandIn:
    """A running stand-in server."""

    port: int
    process: subprocess.Popen[str]

    def freeze(self) -> None:
        """Stop the process without ending it, and wait until it has stopped."""
        self.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self.process.pid, os.WSTOPPED | os.WNOWAIT)

    def resume(self) -> None:
        """Continue a frozen process."""
        self.process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """Kill the process."""
        self.process.kill()
        self.process.wait()

    def ask(self, *command: Any) -> str:
        """Send a command to the process's standard input and return its answer."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(" ".join(map(str, command)) + "\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().strip()


@contextmanager
def stand_in(*options: str) -> Iterator[StandIn]:
    """Start a stand-in server on free ports, and end it afterwards."""
    need_carla()
    port = free_port_pair(socket.SOCK_STREAM)
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.carla.stand_in_server", "--port", str(port), *options],
        cwd=REPOSITORY,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY / "src"), str(REPOSITORY)])},
    )
    with process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == f"ready {port}\n"
            yield StandIn(port, process)
        finally:
            process.kill()
