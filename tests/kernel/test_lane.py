"""The lane itself: two separate machines, and tools that measure them correctly."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from tests.kernel.lane import clocks, ntp_server
from tests.kernel.lane.chrony import SERVE_OWN_CLOCK, correction_s, follow_server, start_chronyd, wait_synchronised
from tests.kernel.lane.machine import Machine, MachineError
from tests.kernel.lane.netem import netem_on_all
from tests.kernel.lane.verdicts import MEDIAN_SHARE
from tests.support.stalls import Stalls

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.transport.clock_sync.chrony import NOT_RUNNING, Chronyc, read_chrony

TrueOffset = Callable[[], int]
NTP_PORT = 11123
CLOCK = MachineClock()
JUDGES_TIMES = pytest.mark.judges_times(share=MEDIAN_SHARE)
"""A failure is excused only if the host stalled for at least `MEDIAN_SHARE` of the duration of the test."""


def shortest_round_trip_ms(machine: Machine, to: Machine) -> float:
    output = machine.run(["ping", "-c", "11", "-i", "0.05", "-q", to.address])
    return float(output.rpartition(" = ")[2].split("/")[0])


def delta_ns(server: Machine, client: Machine) -> float:
    """Return the clock offset Delta between the machines, from the corrections that chrony reports."""
    return (correction_s(client) - correction_s(server)) * NS_PER_S


@JUDGES_TIMES
def test_delay_of_one_machine_is_in_the_round_trip(server_machine: Machine, client_machine: Machine) -> None:
    """A netem delay of 50 ms on either machine adds 50 ms to the round trip, and is gone afterwards."""
    for machine in (server_machine, client_machine):
        with netem_on_all(machine, "delay", "50ms"):
            assert 49.5 < shortest_round_trip_ms(server_machine, client_machine) < 53
    assert shortest_round_trip_ms(server_machine, client_machine) < 5


def test_remote_failure_is_raised_here(client_machine: Machine) -> None:
    """If a program or a function fails on the client's machine, the call raises its error here."""
    with pytest.raises(MachineError, match=r"ended with 2: .*no-such-file"):
        client_machine.run(["ls", "/no-such-file"])
    with pytest.raises(MachineError, match="No such file"):
        client_machine.read("/no-such-file")


def test_progress_file_names_the_running_test(request: pytest.FixtureRequest) -> None:
    """The file of LAVT_PROGRESS on the host contains the name of this test."""
    progress = os.environ.get("LAVT_PROGRESS")
    if not progress:
        pytest.skip("needs LAVT_PROGRESS, which python -m tests.lanes sets")
    assert request.node.nodeid in Path(progress).read_text()


def test_started_program_is_stopped_after_the_test(client_machine: Machine) -> None:
    """A program that a test started on a machine is stopped when the test ends."""
    program = client_machine.start(["sleep", "600"])
    assert program.running
    client_machine.stop_all()
    assert not program.running


@JUDGES_TIMES
def test_host_stalls_have_the_time_of_this_machine(server_machine: Machine, stalls: Stalls) -> None:
    """A report of the host's stall probes has this machine's time of the query, also if this machine's clock drifts."""
    server_machine.call(clocks.set_drift, 500)
    pause(2 * NS_PER_S)
    round_trips_ns = []
    for _ in range(20):
        before_ns = CLOCK.now().mono_ns
        reported_ns, _ = stalls.probes[0].report()
        after_ns = CLOCK.now().mono_ns
        assert before_ns < reported_ns < after_ns
        round_trips_ns.append(after_ns - before_ns)
    assert min(round_trips_ns) < 5 * NS_PER_MS


@JUDGES_TIMES
def test_clock_step_changes_the_true_offset(server_machine: Machine, true_offset_ns: TrueOffset) -> None:
    """Stepping the server's clock by 250 ms changes the offset between the machines by 250 ms, plus or minus 50 us."""
    before_ns = true_offset_ns()
    assert abs(before_ns) < 5 * NS_PER_MS

    server_machine.call(clocks.step, 250 * NS_PER_MS)

    assert true_offset_ns() - before_ns == pytest.approx(250 * NS_PER_MS, abs=50_000)


@JUDGES_TIMES
def test_true_offset_agrees_with_ntp_exchanges(
    server_machine: Machine, client_machine: Machine, true_offset_ns: TrueOffset
) -> None:
    """An NTP exchange (four time stamps) over the network gives the true offset within half its round trip."""
    server_machine.call(clocks.step, -70 * NS_PER_MS)
    client_machine.start_python("tests.kernel.lane.ntp_server", client_machine.address, str(NTP_PORT)).first_line()

    client_ahead_ns, round_trip_ns = ntp_server.query_offset(client_machine.address, NTP_PORT)

    assert round_trip_ns < 5 * NS_PER_MS
    assert -client_ahead_ns == pytest.approx(true_offset_ns(), abs=round_trip_ns / 2)


@JUDGES_TIMES
def test_clock_drift_is_the_rate_of_the_true_offset(server_machine: Machine, true_offset_ns: TrueOffset) -> None:
    """If the server's clock runs 30 ppm fast, it gains 25 to 35 us a second on the client's clock."""
    begin_raw_ns, begin_ns = clocks.read_raw_clock_ns(), true_offset_ns()
    server_machine.call(clocks.set_drift, 30)
    pause(4 * NS_PER_S)
    elapsed_s = (clocks.read_raw_clock_ns() - begin_raw_ns) / NS_PER_S

    assert (true_offset_ns() - begin_ns) / elapsed_s == pytest.approx(30_000, abs=5_000)


@JUDGES_TIMES
def test_chrony_measures_the_offset(
    server_machine: Machine, client_machine: Machine, true_offset_ns: TrueOffset
) -> None:
    """The client's chronyd, which does not adjust the clock, measures that the server is 250 ms ahead, within 1 ms."""
    server_machine.call(clocks.step, 250 * NS_PER_MS)
    start_chronyd(server_machine, *SERVE_OWN_CLOCK)
    start_chronyd(client_machine, follow_server(server_machine.address))
    wait_synchronised(client_machine, updates=8)

    assert delta_ns(server_machine, client_machine) == pytest.approx(true_offset_ns(), abs=NS_PER_MS)


@JUDGES_TIMES
def test_chrony_measures_the_offset_of_a_slewed_clock(
    server_machine: Machine, client_machine: Machine, true_offset_ns: TrueOffset
) -> None:
    """While the server's clock is slewed to a third clock, the difference of both corrections is the true offset."""
    server_machine.start_python(
        "tests.kernel.lane.ntp_server", "127.0.0.1", str(NTP_PORT), str(60 * NS_PER_MS), "20"
    ).first_line()
    start_chronyd(server_machine, follow_server("127.0.0.1", NTP_PORT), "maxslewrate 1000", "allow", adjusts_clock=True)
    wait_synchronised(server_machine, updates=4)
    start_chronyd(client_machine, follow_server(server_machine.address))
    wait_synchronised(client_machine, updates=8)

    for _ in range(5):
        assert correction_s(server_machine) > 0.005, "the clock is no longer slewed"
        assert delta_ns(server_machine, client_machine) == pytest.approx(true_offset_ns(), abs=NS_PER_MS)
        pause(NS_PER_S)


def test_chronyc_survives_a_restart_of_chronyd(server_machine: Machine) -> None:
    """The persistent chronyc reports that chronyd is not running, and its status again after a restart."""
    chronyd = start_chronyd(server_machine, *SERVE_OWN_CLOCK)
    with closing(Chronyc()) as chronyc:
        statuses = [status_of(chronyc)]
        chronyd.stop()
        statuses.append(status_of(chronyc))
        start_chronyd(server_machine, *SERVE_OWN_CLOCK)
        statuses.append(status_of(chronyc))
    assert statuses == ["its own clock is the reference", NOT_RUNNING, "its own clock is the reference"]


def status_of(chronyc: Chronyc) -> str | None:
    report = read_chrony(CLOCK, chronyc.run)
    return None if report is None else report.status
