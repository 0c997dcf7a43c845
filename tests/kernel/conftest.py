"""What the tests on a real kernel share: the machines, their clocks, chrony, netem and drives between them."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.kernel.lane.machine import Machine, local_machine, remote_machine
from tests.require import need

LANE = os.environ.get("LAVT_KERNEL_LANE", "")
"""`pair` in the first of two machines, `native` on this machine's own kernel; set by tests/kernel/run alone."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    if not LANE:
        need("kernel", "needs a kernel with netem: run tests/kernel/run")


@pytest.fixture(scope="session")
def _machines() -> tuple[Machine, Machine]:
    if LANE != "pair":
        pytest.skip("needs two machines: run tests/kernel/run without --native")
    key = os.environ["LAVT_KERNEL_KEY"].encode()
    return local_machine("server", "10.9.0.1"), remote_machine("client", "10.9.0.2", "10.9.1.2", key)


@pytest.fixture
def server_machine(_machines: tuple[Machine, Machine]) -> Iterator[Machine]:
    """Give the vehicle's machine, which the tests run on."""
    yield _machines[0]
    _machines[0].end_all()


@pytest.fixture
def client_machine(_machines: tuple[Machine, Machine]) -> Iterator[Machine]:
    """Give the remote machine."""
    yield _machines[1]
    _machines[1].end_all()
