"""The actuator's process, with a node that never returns."""

from __future__ import annotations

import multiprocessing
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
    vehicle = SimpleNamespace(is_silent=False, close=lambda: None)
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
    context = multiprocessing.get_context("spawn")
    own_end, actuator_end = context.Pipe()
    process = context.Process(target=serve_stuck, args=(actuator_end,))
    process.start()
    actuator_end.close()
    try:
        assert own_end.recv() is None
        own_end.close()
        process.join(60)
        assert process.exitcode == -signal.SIGALRM
    finally:
        process.kill()


def test_the_actuator_locks_its_memory() -> None:
    """Before it drives, the actuator's process has locked its memory, if its user has the right to lock memory."""
    context = multiprocessing.get_context("spawn")
    own_end, actuator_end = context.Pipe()
    process = context.Process(target=serve_stuck, args=(actuator_end,))
    process.start()
    try:
        assert own_end.recv() is None
        status = Path(f"/proc/{process.pid}/status").read_text()
        locked_kib = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmLck"))
        assert (locked_kib > 1000) == (lift_lock_limit() == "")
    finally:
        process.kill()


def test_the_alarm_leaves_time_to_stop() -> None:
    """The alarm that kills an actuator comes later than the limit for stopping and disengaging the vehicle."""
    assert actuator_process.KILL_AFTER_S > actuator_process.STOP_TIMEOUT_S
