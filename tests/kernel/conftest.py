"""Fixtures of the tests on a real kernel: the two machines, their true clock offset, and drives between them.

Each test finds the machines unchanged: no programs of an earlier test, clocks reset, and no qdiscs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

import pytest
from tests.kernel.lane import clocks, netem
from tests.kernel.lane.driving import DriveResult, LoopPrograms, collect, start_loop, wait_for_end
from tests.kernel.lane.guests import SERIAL_LINE
from tests.kernel.lane.host_stalls import HostProbe
from tests.kernel.lane.machine import Machine, local_machine, remote_machine
from tests.kernel.lane.verdicts import require_valid
from tests.require import need
from tests.support.inconclusive import SESSION
from tests.support.stalls import ProbeProcess, Stalls

from lavt.experiment.analysis.invalid_reason import InvalidCode

LANE = os.environ.get("LAVT_KERNEL_LANE", "")
"""`pair` in the first of two machines, `native` on this machine's own kernel; set only by tests/kernel/run."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    if not LANE:
        need("kernel", "needs a kernel with netem: run tests/kernel/run")


@pytest.fixture(scope="session")
def stalls(request: pytest.FixtureRequest) -> Stalls:
    """Return the record of stalls; inside a machine, the record of the host's own probes and of one in this machine.

    While this machine's kernel waits for the host's files, its only processor runs nothing else. The host's probes do
    not show these times.
    """
    if LANE == "pair":
        host = HostProbe(SERIAL_LINE)
        record = Stalls([host, ProbeProcess(0, "of the first machine")], host.processor_times)
    else:
        record = Stalls.start_probes()
    request.config.stash[SESSION].stalls = record
    return record


@pytest.fixture(scope="session")
def machines() -> tuple[Machine, Machine]:
    """Return the server's and the client's machine, with equal wall clocks, for the two fixtures below."""
    if LANE != "pair":
        pytest.skip("needs two machines: run tests/kernel/run without --native")
    key = os.environ["LAVT_KERNEL_KEY"].encode()
    server = local_machine("server", "10.9.0.1")
    client = remote_machine("client", "10.9.0.2", "10.9.1.2", key)
    client.call(clocks.step, offset_ns(server, client))
    return server, client


@pytest.fixture
def server_machine(machines: tuple[Machine, Machine]) -> Iterator[Machine]:
    """Return the vehicle's machine, which runs the tests."""
    server, _ = machines
    yield from restoring_machine(server)


@pytest.fixture
def client_machine(machines: tuple[Machine, Machine]) -> Iterator[Machine]:
    """Return the client's machine, which tests control from the server's."""
    _, client = machines
    yield from restoring_machine(client)


def restoring_machine(machine: Machine) -> Iterator[Machine]:
    """Yield a machine; then stop its programs, reset its clock and delete its qdiscs."""
    wall_minus_raw_ns = machine.call(clocks.wall_minus_raw_ns)
    yield machine
    machine.stop_all()
    machine.call(clocks.restore, wall_minus_raw_ns)
    netem.clear(machine)


@pytest.fixture
def report_measurement(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Return a function that prints a measurement into the lane's output, whether or not the test passes."""
    plugins = request.config.pluginmanager
    reporter, capture = plugins.getplugin("terminalreporter"), plugins.getplugin("capturemanager")
    assert reporter is not None
    assert capture is not None

    def write_line(measurement: str) -> None:
        with capture.global_and_fixture_disabled():
            reporter.write_line(f"\n{request.node.name}: {measurement}")

    return write_line


@pytest.fixture
def true_offset_ns(server_machine: Machine, client_machine: Machine) -> Callable[[], int]:
    """Return a function that measures the server's wall clock minus the client's, with the counter that both read."""
    return lambda: offset_ns(server_machine, client_machine)


def offset_ns(server: Machine, client: Machine) -> int:
    client_reading = client.call(clocks.read_wall_clock)
    return clocks.offset_ns(server.call(clocks.read_wall_clock), client_reading)


@pytest.fixture
def drive(
    server_machine: Machine, client_machine: Machine, tmp_path: Path, stalls: Stalls
) -> Callable[..., DriveResult]:
    """Return a function that drives over both machines, from starting the four programs to the result.

    The drive must be valid, except for reasons with the expected codes.
    """

    def drive_once(
        name: str = "drive",
        *,
        server: tuple[str, ...] = (),
        client: tuple[str, ...] = (),
        expected_codes: Collection[InvalidCode] = (),
        meanwhile: Callable[[LoopPrograms], None] = lambda _: None,
    ) -> DriveResult:
        out = tmp_path / f"{name}-{len(list(tmp_path.iterdir()))}"
        loop = start_loop(server_machine, client_machine, out, server_changes=server, client_changes=client)
        wait_for_end(loop, meanwhile)
        finished_drive = collect(loop, client_machine, out)
        require_valid(finished_drive, stalls, expected_codes)
        return finished_drive

    return drive_once
