"""The actuator's process, with a node that never returns."""

from __future__ import annotations

import os
import re
import signal
import threading
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from lavt.assembly import actuator_process
from lavt.node import WAKE
from lavt.runtime import process_priority
from lavt.runtime.resident_memory import lift_lock_limit

pytestmark = pytest.mark.timeout(120)


class StuckNode:
    """An actuator whose first wake never returns."""

    name = "actuator"

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.gate = SimpleNamespace(in_force=lambda: (0, -1))
        self.pipelines: dict[str, Any] = {WAKE: (("wait", lambda *_: threading.Event().wait()),), "server_ends": ()}

    def next_wake_ns(self) -> int:
        """Return a time in the past."""
        return 0


def serve_stuck(connection: Connection) -> None:
    """Serve a stuck node, with shorter limits."""
    vehicle = SimpleNamespace(is_idle_or_overridden=False, close=lambda: None)
    for name, replacement in {
        "open_by_wire": lambda *_: vehicle,
        "build_actuator": lambda *_, **__: StuckNode(),
        "driven_route": lambda *_: None,
        "STOP_TIMEOUT_S": 0.1,
        "KILL_AFTER_S": 1,
    }.items():
        setattr(actuator_process, name, replacement)
    process_priority.raise_priority = lambda *_: None
    config: Any = SimpleNamespace(vehicle=None)
    actuator_process.serve_actuator(connection, config, "", 0)


def test_a_stuck_actuator_does_not_outlive_its_server() -> None:
    """An actuator whose node never returns is killed soon after its server has ended."""
    process, own_end = actuator_process.spawn(serve_stuck)
    try:
        assert own_end.recv() is None
        own_end.close()
        process.join(60)
        assert process.exitcode == -signal.SIGALRM
    finally:
        process.kill()


def test_the_actuator_locks_its_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before it drives, the actuator's process has locked its memory, if its user has the right to lock memory.

    It has no threads and buffers of libraries for further processors, and small stacks, so it keeps little in RAM.
    """
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    process, own_end = actuator_process.spawn(serve_stuck)
    try:
        assert own_end.recv() is None
        status = Path(f"/proc/{process.pid}/status").read_text()
        kib = {name: int(value.split()[0]) for name, value in re.findall(r"(VmLck|RssAnon|Threads):\s*(.*)", status)}
        assert (kib["VmLck"] > 1000) == (lift_lock_limit() == "")
        assert kib["RssAnon"] < 150 * 1024
        assert "OPENBLAS_NUM_THREADS" not in os.environ
    finally:
        process.kill()


def test_the_alarm_leaves_time_to_stop() -> None:
    """The alarm that kills an actuator comes later than the limit for stopping and disengaging the vehicle."""
    assert actuator_process.KILL_AFTER_S > actuator_process.STOP_TIMEOUT_S
