"""What all tests in real time share: they are marked, they wait with a limit, and the lightest drive that they need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from lavt.clock import MachineClock, pause
from lavt.config import RunConfig, load_config, shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.metrics import measure
from lavt.experiment.plan import PlannedRun, plan_run
from lavt.experiment.real_run import drive_real
from lavt.experiment.record import read_record
from lavt.experiment.results import run_result

HERE = Path(__file__).parent
POLL_NS = 50 * NS_PER_MS


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.realtime)


@pytest.fixture(scope="session")
def wait_until() -> Callable[[str, Callable[[], bool], float], None]:
    def wait(what: str, holds: Callable[[], bool], limit_s: float) -> None:
        clock = MachineClock()
        limit_ns = clock.now().mono_ns + round(limit_s * NS_PER_S)
        while not holds():
            assert clock.now().mono_ns < limit_ns, f"waited {limit_s:g} s in vain until {what}"
            pause(POLL_NS)

    return wait


@pytest.fixture(scope="session")
def planned() -> Callable[..., PlannedRun]:
    """Plan a real run as `lavt demo` drives it, with changes of its config."""

    def plan(*changes: str, repetition: int = 0) -> PlannedRun:
        config = load_config(RunConfig, shipped("configs/demo.yaml"), ["time=real", *changes])
        return plan_run(config, repetition=repetition)

    return plan


@dataclass(frozen=True)
class RealDrive:
    """One drive in real time: its records, its result, what the relay says against itself, and the closure."""

    out: Path
    result: dict[str, Any]
    relay_says: list[str]
    closure_p95_ms: float | None


@pytest.fixture(scope="session")
def real_drive(tmp_path_factory: pytest.TempPathFactory) -> Callable[[PlannedRun], RealDrive]:
    def drive(planned: PlannedRun) -> RealDrive:
        out = tmp_path_factory.mktemp("real")
        relay_says = drive_real(planned, out)
        server, client = read_record(out / "server.mcap"), read_record(out / "client.mcap")
        closure_p95_ms = measure(server, client).closure_p95_ms
        return RealDrive(out, run_result(planned.identity, server, client), relay_says, closure_p95_ms)

    return drive


@pytest.fixture(scope="session")
def injected(planned: Callable[..., PlannedRun], real_drive: Callable[[PlannedRun], RealDrive]) -> dict[str, RealDrive]:
    """Give a drive under L0 and one under L5."""
    return {name: real_drive(planned(f"network.condition={name}")) for name in ("L0", "L5")}
