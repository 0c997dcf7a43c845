"""The lane itself: two machines that are really two, and tools that tell the truth about them."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from tests.kernel.lane import clocks, ntp_server
from tests.kernel.lane.chrony import SERVING, correction_s, following, start_chronyd, wait_synchronised
from tests.kernel.lane.driving import Drive
from tests.kernel.lane.machine import Machine, MachineError
from tests.kernel.lane.netem import netem_on_all
from tests.kernel.lane.verdicts import MEDIAN_SHARE, require_completed
from tests.support.stalls import Stalls

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.clock_sync.chrony import NOT_RUNNING, Chronyc, read_chrony

TrueOffset = Callable[[], int]
NTP_PORT = 11123
CLOCK = MachineClock()
TIMES = pytest.mark.judges_times(share=MEDIAN_SHARE)


def least_round_trip_ms(machine: Machine, to: Machine) -> float:
    said = machine.run(["ping", "-c", "11", "-i", "0.05", "-q", to.address])
    return float(said.rpartition(" = ")[2].split("/")[0])


def delta_ns(server: Machine, client: Machine) -> float:
    return (correction_s(client) - correction_s(server)) * NS_PER_S


@TIMES
def test_a_delay_on_one_machine_is_in_the_round_trip_and_gone_afterwards(
    server_machine: Machine, client_machine: Machine
) -> None:
    """Each machine has netem, on a link that the other's delay is not part of."""
    for machine in (server_machine, client_machine):
        with netem_on_all(machine, "delay", "50ms"):
            assert 49.5 < least_round_trip_ms(server_machine, client_machine) < 53
    assert least_round_trip_ms(server_machine, client_machine) < 5


def test_what_fails_on_the_other_machine_is_told_here(client_machine: Machine) -> None:
    """A program that fails on the client's machine raises with what it said, and so does a function."""
    with pytest.raises(MachineError, match=r"ended with 2: .*no-such-file"):
        client_machine.run(["ls", "/no-such-file"])
    with pytest.raises(MachineError, match="No such file"):
        client_machine.read("/no-such-file")


def test_whoever_runs_the_lane_is_told_of_the_test_that_runs(request: pytest.FixtureRequest) -> None:
    """The file of LAVT_PROGRESS, which lies on the host, has the name of this test."""
    progress = os.environ.get("LAVT_PROGRESS")
    if not progress:
        pytest.skip("needs LAVT_PROGRESS, which python -m tests.lanes sets")
    assert request.node.nodeid in Path(progress).read_text()


def test_a_started_program_ends_with_its_test(client_machine: Machine) -> None:
    """What a test has started on a machine is gone when the machine is left."""
    started = client_machine.start(["sleep", "600"])
    assert started.running
    client_machine.end_all()
    assert not started.running


@TIMES
def test_the_hosts_stalls_are_told_in_this_machines_time(server_machine: Machine, stalls: Stalls) -> None:
    """What the host's probes tell at a time has that time, to the 5 ms that asking takes, also on a slewed clock."""
    server_machine.call(clocks.drift, 500)
    pause(2 * NS_PER_S)
    took_ns = []
    for _ in range(20):
        before_ns = CLOCK.now().mono_ns
        told_ns, _ = stalls.probes[0].report()
        after_ns = CLOCK.now().mono_ns
        assert before_ns < told_ns < after_ns
        took_ns.append(after_ns - before_ns)
    assert min(took_ns) < 5 * NS_PER_MS


@TIMES
def test_a_step_of_one_clock_is_the_change_of_the_true_offset(
    server_machine: Machine, true_offset_ns: TrueOffset
) -> None:
    """Setting the server's clock 250 ms ahead changes the offset between the machines by 250 ms, to 50 us."""
    before_ns = true_offset_ns()
    assert abs(before_ns) < 5 * NS_PER_MS

    server_machine.call(clocks.step, 250 * NS_PER_MS)

    assert true_offset_ns() - before_ns == pytest.approx(250 * NS_PER_MS, abs=50_000)


@TIMES
def test_the_true_offset_is_what_an_exchange_of_time_stamps_finds(
    server_machine: Machine, client_machine: Machine, true_offset_ns: TrueOffset
) -> None:
    """Four time stamps over the network find the true offset within half their round trip."""
    server_machine.call(clocks.step, -70 * NS_PER_MS)
    client_machine.start_python("tests.kernel.lane.ntp_server", client_machine.address, str(NTP_PORT)).first_line()

    client_ahead_ns, round_trip_ns = ntp_server.ask(client_machine.address, NTP_PORT)

    assert round_trip_ns < 5 * NS_PER_MS
    assert -client_ahead_ns == pytest.approx(true_offset_ns(), abs=round_trip_ns / 2)


@TIMES
def test_a_drift_of_one_clock_is_the_rate_of_the_true_offset(
    server_machine: Machine, true_offset_ns: TrueOffset
) -> None:
    """A server's clock that runs 30 ppm fast gains 30 us on the client's in each second, to 5 us."""
    begin_raw_ns, begin_ns = clocks.raw_ns(), true_offset_ns()
    server_machine.call(clocks.drift, 30)
    pause(4 * NS_PER_S)
    gone_s = (clocks.raw_ns() - begin_raw_ns) / NS_PER_S

    assert (true_offset_ns() - begin_ns) / gone_s == pytest.approx(30_000, abs=5_000)


@TIMES
def test_chrony_of_the_client_finds_the_offset(
    server_machine: Machine, client_machine: Machine, true_offset_ns: TrueOffset
) -> None:
    """Chronyd that follows the server, and touches no clock, finds a server 250 ms ahead to 1 ms."""
    server_machine.call(clocks.step, 250 * NS_PER_MS)
    start_chronyd(server_machine, *SERVING)
    start_chronyd(client_machine, following(server_machine.address))
    wait_synchronised(client_machine, updates=8)

    assert delta_ns(server_machine, client_machine) == pytest.approx(true_offset_ns(), abs=NS_PER_MS)


@TIMES
def test_chrony_finds_the_offset_while_the_server_is_slewed(
    server_machine: Machine, client_machine: Machine, true_offset_ns: TrueOffset
) -> None:
    """While the server's clock slews towards a third one, the difference of both corrections is the true offset."""
    server_machine.start_python(
        "tests.kernel.lane.ntp_server", "127.0.0.1", str(NTP_PORT), str(60 * NS_PER_MS), "20"
    ).first_line()
    start_chronyd(
        server_machine, following("127.0.0.1", NTP_PORT), "maxslewrate 1000", "allow", adjusts_clock=True
    )  # fmt: skip
    wait_synchronised(server_machine, updates=4)
    start_chronyd(client_machine, following(server_machine.address))
    wait_synchronised(client_machine, updates=8)

    for _ in range(5):
        assert correction_s(server_machine) > 0.005, "it slews still"
        assert delta_ns(server_machine, client_machine) == pytest.approx(true_offset_ns(), abs=NS_PER_MS)
        pause(NS_PER_S)


def test_a_road_is_driven_over_both_machines(
    server_machine: Machine, client_machine: Machine, drive: Callable[..., Drive], stalls: Stalls
) -> None:
    """With the server's clock 250 ms ahead, a short road is driven to its end, and the loop's parts close to 1 ms."""
    server_machine.call(clocks.step, 250 * NS_PER_MS)
    start_chronyd(server_machine, *SERVING)
    start_chronyd(client_machine, following(server_machine.address))
    wait_synchronised(client_machine, updates=8)

    driven = drive()

    require_completed(driven, stalls)
    assert driven.measured.closure_p95_ms is not None
    assert driven.measured.closure_p95_ms <= 1
    assert driven.measured.clocks.bound_ms is not None
    assert 0 < driven.result["tau_c_ms"]["p50"] < 50, "an offset of 250 ms would show"


def test_one_client_of_chrony_outlives_the_daemon(server_machine: Machine) -> None:
    """What drives use to ask chrony says when the daemon is gone and, when it runs again, what it says."""
    chronyd = start_chronyd(server_machine, *SERVING)
    with closing(Chronyc()) as chronyc:
        statuses = [status_of(chronyc)]
        chronyd.stop()
        statuses.append(status_of(chronyc))
        start_chronyd(server_machine, *SERVING)
        statuses.append(status_of(chronyc))
    assert statuses == ["its own clock is the reference", NOT_RUNNING, "its own clock is the reference"]


def status_of(chronyc: Chronyc) -> str | None:
    report = read_chrony(CLOCK, chronyc.run)
    return None if report is None else report.status
