"""What all tests in real time share: they are marked, they wait with a limit, and the lightest drive that they need."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from lavt.clock import MachineClock, pause
from lavt.config import RunConfig, load_config, shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.experiment.plan import PlannedRun, plan_run

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
