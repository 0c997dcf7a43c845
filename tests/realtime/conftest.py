"""Marks and fixtures of the real-time tests: waiting with a time limit, and the drives of the demo."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest
from tests.support.stalls import SharedResult, Stalls

from lavt.clock import MachineClock, pause
from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.analysis.invalid_reason import InvalidReason
from lavt.experiment.analysis.metrics import measure
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.experiment.runs.real_run import relay_invalid_reasons
from lavt.recording.record import read_record

HERE = Path(__file__).parent
POLL_NS = 50 * NS_PER_MS
TIMEOUT_S = 900
"""On a busy host a test can need several drives."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.realtime)
            item.add_marker(pytest.mark.timeout(TIMEOUT_S))


@pytest.fixture(scope="session")
def wait_until() -> Callable[[str, Callable[[], bool], float], None]:
    def wait(expectation: str, condition: Callable[[], bool], limit_s: float) -> None:
        clock = MachineClock()
        limit_ns = clock.now().mono_ns + round(limit_s * NS_PER_S)
        while not condition():
            assert clock.now().mono_ns < limit_ns, f"not within {limit_s:g} s: {expectation}"
            pause(POLL_NS)

    return wait


@pytest.fixture(scope="session")
def planned() -> Callable[..., PlannedRun]:
    """Return a function that plans a run in real time as `lavt demo` does, with changes of its config."""

    def plan(*changes: str, repetition: int = 0) -> PlannedRun:
        all_changes = ["time=real", f"repetition={repetition}", *changes]
        return plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), all_changes))

    return plan


@dataclass(frozen=True)
class RealDrive:
    """One drive in real time: its directory, its result, why the relay makes it invalid, and the closure error."""

    out: Path
    result: dict[str, Any]
    relay_invalid_reasons: list[InvalidReason]
    closure_p95_ms: float | None


def read_drive(out: Path, result: dict[str, Any]) -> RealDrive:
    reasons = relay_invalid_reasons(json.loads((out / "relay.json").read_text()))
    server, client = read_record(out / "server.mcap"), read_record(out / "client.mcap")
    return RealDrive(out, result, reasons, measure(server, client).closure_p95_ms)


@dataclass(frozen=True)
class Demo:
    """A finished demo: its directory, exit code, terminal output and times."""

    out: Path
    code: int
    output: str
    since_ns: int
    until_ns: int

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Return the content of summary.json."""
        summary: dict[str, Any] = json.loads((self.out / "summary.json").read_text())
        return summary

    @cached_property
    def drives_by_condition(self) -> dict[str, RealDrive]:
        """Return the drives in real time by condition."""
        drives = {}
        for name in ("L0", "L5"):
            out = self.out / "runs" / f"real_a_key_{name}_00"
            drives[name] = read_drive(out, json.loads((out / "result.json").read_text()))
        return drives


def run_at_a_terminal(arguments: list[str]) -> tuple[int, str]:
    """Run a program with a terminal as standard output and error; return its exit code and output."""
    terminal, program_side = pty.openpty()
    program = subprocess.Popen(arguments, stdout=program_side, stderr=program_side, stdin=subprocess.DEVNULL)
    os.close(program_side)
    output = bytearray()
    while True:
        try:
            piece = os.read(terminal, 65536)
        except OSError:  # Linux reports so that the program has closed the terminal
            break
        if not piece:
            break
        output += piece
    os.close(terminal)
    return program.wait(), output.decode(errors="replace")


@pytest.fixture(scope="session")
def demos(tmp_path_factory: pytest.TempPathFactory, stalls: Stalls) -> SharedResult[Demo]:
    clock = MachineClock()

    def run() -> Demo:
        out, since_ns = tmp_path_factory.mktemp("demo") / "out", clock.now().mono_ns
        code, output = run_at_a_terminal([sys.executable, "-m", "lavt", "demo", "--out", str(out)])
        assert code == 0, output
        return Demo(out, code, output, since_ns, clock.now().mono_ns)

    return SharedResult(stalls, run)


@pytest.fixture
def demo(demos: SharedResult[Demo]) -> Demo:
    """Return the demo, which runs once for all tests, and again only if the host stalled it."""
    return demos.get()
