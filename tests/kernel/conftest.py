"""What the tests on a real kernel share: the two machines, the truth of their clocks, and drives between them.

Each test finds the machines as they were: nothing started by the one before, clocks set back, no queue left.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.kernel.lane import clocks, netem
from tests.kernel.lane.driving import Drive, Loop, collect, start_loop, wait_for_the_end
from tests.kernel.lane.guests import LINE
from tests.kernel.lane.host_stalls import HostProbe
from tests.kernel.lane.machine import Machine, local_machine, remote_machine
from tests.kernel.lane.verdicts import require_valid
from tests.require import need
from tests.support.inconclusive import SESSION
from tests.support.stalls import Stalls

LANE = os.environ.get("LAVT_KERNEL_LANE", "")
"""`pair` in the first of two machines, `native` on this machine's own kernel; set by tests/kernel/run alone."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    if not LANE:
        need("kernel", "needs a kernel with netem: run tests/kernel/run")


@pytest.fixture(scope="session")
def stalls(request: pytest.FixtureRequest) -> Stalls:
    """Give the record of the host's stalls, as everywhere; inside a machine it is what the host's own probes tell."""
    if LANE == "pair":
        probe = HostProbe(LINE)
        measured = Stalls([probe], probe.processor_times)
    else:
        measured = Stalls.measured()
    request.config.stash[SESSION].stalls = measured
    return measured


@pytest.fixture(scope="session")
def machines() -> tuple[Machine, Machine]:
    """Give both machines, with one time; `server_machine` and `client_machine` are what tests take."""
    if LANE != "pair":
        pytest.skip("needs two machines: run tests/kernel/run without --native")
    key = os.environ["LAVT_KERNEL_KEY"].encode()
    pair = local_machine("server", "10.9.0.1"), remote_machine("client", "10.9.0.2", "10.9.1.2", key)
    pair[1].call(clocks.step, offset_ns(*pair))
    return pair


@pytest.fixture
def server_machine(machines: tuple[Machine, Machine]) -> Iterator[Machine]:
    """Give the vehicle's machine, which the tests run on."""
    yield from as_it_was(machines[0])


@pytest.fixture
def client_machine(machines: tuple[Machine, Machine]) -> Iterator[Machine]:
    """Give the remote machine."""
    yield from as_it_was(machines[1])


def as_it_was(machine: Machine) -> Iterator[Machine]:
    less_raw_ns = machine.call(clocks.wall_less_raw_ns)
    yield machine
    machine.end_all()
    machine.call(clocks.restore, less_raw_ns)
    netem.clear(machine)


@pytest.fixture
def tell(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Print a figure that was measured, whatever becomes of the test: the lane's output has them all."""
    plugins = request.config.pluginmanager
    reporter, capture = plugins.getplugin("terminalreporter"), plugins.getplugin("capturemanager")
    assert reporter is not None
    assert capture is not None

    def line(figure: str) -> None:
        with capture.global_and_fixture_disabled():
            reporter.write_line(f"\n{request.node.name}: {figure}")

    return line


@pytest.fixture
def true_offset_ns(server_machine: Machine, client_machine: Machine) -> Callable[[], int]:
    """Tell how far the server's wall clock is ahead of the client's, from what both read of one counter."""
    return lambda: offset_ns(server_machine, client_machine)


def offset_ns(server: Machine, client: Machine) -> int:
    of_client = client.call(clocks.reading)
    return clocks.ahead_ns(server.call(clocks.reading), of_client)


@pytest.fixture
def drive(server_machine: Machine, client_machine: Machine, tmp_path: Path, stalls: Stalls) -> Callable[..., Drive]:
    """Drive over both machines, from the start of the four programs to the result.

    Nothing may speak against the drive other than the reason its test is about, which begins with `about`.
    """

    def once(
        name: str = "drive",
        *,
        server: tuple[str, ...] = (),
        client: tuple[str, ...] = (),
        about: str | None = None,
        meanwhile: Callable[[Loop], None] = lambda _: None,
    ) -> Drive:
        out = tmp_path / f"{name}-{len(list(tmp_path.iterdir()))}"
        loop = start_loop(server_machine, client_machine, out, server_changes=server, client_changes=client)
        wait_for_the_end(loop, meanwhile)
        driven = collect(loop, client_machine, out)
        require_valid(driven, stalls, about)
        return driven

    return once
