from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from tests.support.stalls import (
    STALL_MS,
    HostStalled,
    HostStalledEachTime,
    ProbeEnded,
    ProbeProcess,
    SharedResult,
    Stall,
    Stalls,
    idle_share,
    inconclusive_too_often,
    overlapping,
    stalled_share,
)

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S

pytest_plugins = ["pytester"]

MS = NS_PER_MS
QUIET, BUSY = "cpu 0 0 0 0 0 0 0 0 0 0", "cpu 90 0 0 10 0 0 0 0 0 0"
"""The first line of /proc/stat at the start, and after a time in which the machine was busy for 90 of 100 ticks."""


@dataclass
class FakeLatenessProbe:
    """A fake `Probe`: it returns the given reports of stalls in order, and then reports without stalls."""

    reports: list[tuple[int, list[Stall]]] = field(default_factory=list)
    has_realtime_priority: bool = True
    report_count: int = 0

    def report(self) -> tuple[int, list[Stall]]:  # noqa: D102 (documented in `Probe`)
        self.report_count += 1
        return self.reports.pop(0) if self.reports else (2**62, [])

    def end(self) -> None:  # noqa: D102 (documented in `Probe`)
        pass


def stalls_of(*recorded: Stall) -> Stalls:
    return Stalls([FakeLatenessProbe()], lambda: QUIET, list(recorded))


@pytest.mark.parametrize(
    ("since_ms", "until_ms", "count"),
    [(0, 99, 0), (0, 100, 1), (120, 130, 1), (150, 200, 1), (151, 200, 0), (0, 1000, 2)],
)
def test_only_overlapping_stalls_are_returned(since_ms: int, until_ms: int, count: int) -> None:
    """A stall that ended before an interval, or began after it, does not overlap it."""
    stalls = [Stall(0, 100 * MS, 150 * MS), Stall(1, 600 * MS, 610 * MS)]
    assert len(overlapping(stalls, since_ms * MS, until_ms * MS)) == count


def test_short_stalls_are_not_returned() -> None:
    """Only stalls of at least the given length are returned."""
    stalls = [Stall(0, 0, 29 * MS), Stall(0, 100 * MS, 131 * MS)]
    assert overlapping(stalls, 0, 1000 * MS, at_least_ms=30) == [stalls[1]]


def test_stalled_share_is_that_of_the_longest_stalled_processor() -> None:
    """The stalled share adds up the stalls of one processor in the interval: the processor that was stalled longest."""
    stalls = [Stall(0, 0, 20 * MS), Stall(0, 50 * MS, 60 * MS), Stall(1, 0, 15 * MS), Stall(0, 90 * MS, 500 * MS)]
    assert stalled_share(stalls, 10 * MS, 100 * MS) == pytest.approx((10 + 10 + 10) / 90)
    assert stalled_share([], 0, 100) == 0


def test_passing_check_does_not_query_probes() -> None:
    """A check that passes does not wait for the probes."""
    stalls = stalls_of()
    before = stalls.probes[0].report_count  # type: ignore[attr-defined]
    stalls.require(True, "late", 0, 100)
    with stalls.excusing_failures(0, 100):
        pass
    assert stalls.probes[0].report_count == before  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("stall", "raised"),
    [
        (None, AssertionError),
        (Stall(0, 0, 29 * MS), AssertionError),
        (Stall(0, 0, 31 * MS), HostStalled),
        (Stall(1, 990 * MS, 2000 * MS), HostStalled),
        (Stall(0, 1001 * MS, 2000 * MS), AssertionError),
    ],
)
def test_only_an_overlapping_stall_excuses_a_failure(stall: Stall | None, raised: type[Exception]) -> None:
    """A late result is a failure, unless a stall of at least 30 ms overlaps the interval."""
    stalls = stalls_of(*([stall] if stall else []))
    with pytest.raises(raised, match="it was late") as caught:
        stalls.require(False, "it was late", 0, 1000 * MS)
    assert caught.type is raised
    assert STALL_MS == 30


@pytest.mark.parametrize(
    ("stall_ms", "until_ms", "raised"),
    [(20, 1000, HostStalled), (20, 999, AssertionError), (14, 1000, AssertionError)],
)
def test_many_short_stalls_excuse_a_failure(stall_ms: int, until_ms: int, raised: type[Exception]) -> None:
    """Stalls that are too short excuse a failure if they take 15 % of an interval of at least a second."""
    stalls = stalls_of(*(Stall(0, at * 100 * MS, (at * 100 + stall_ms) * MS) for at in range(10)))
    with pytest.raises(raised, match="slow") as caught, stalls.excusing_failures(0, until_ms * MS):
        raise AssertionError("slow")
    assert caught.type is raised


@pytest.mark.parametrize(("share", "raised"), [(0.05, HostStalled), (0.2, AssertionError)])
def test_stalled_share_excuses_a_failure(share: float, raised: type[Exception]) -> None:
    """A failed assertion is excused if a processor was stalled for at least the given share of the interval."""
    stalls = stalls_of(*(Stall(0, at * 100 * MS, (at * 100 + 10) * MS) for at in range(10)))
    with pytest.raises(raised, match="slow") as caught, stalls.excusing_failures(0, 1000 * MS, share=share):
        raise AssertionError("slow")
    assert caught.type is raised


def test_probes_are_queried_until_the_interval_is_covered() -> None:
    """`Stalls.during` queries each probe until the time of its report is after the end of the interval."""
    late = Stall(0, 50 * MS, 90 * MS)
    slow_probe = FakeLatenessProbe([(0, []), (80 * MS, []), (99 * MS, [late]), (101 * MS, [])])
    assert Stalls([slow_probe], lambda: QUIET).during(0, 100 * MS) == [late]
    assert slow_probe.reports == []


@pytest.mark.parametrize(
    ("inconclusive", "tests", "idle", "expected"),
    [
        (0, 0, 1.0, False),
        (0, 100, 0.9, False),
        (1, 1, 0.9, False),
        (2, 2, 0.9, True),
        (5, 100, 0.9, False),
        (6, 100, 0.9, True),
        (6, 100, 0.5, False),
        (100, 100, 0.4, False),
        (6, 100, 0.51, True),
    ],
)
def test_many_inconclusive_tests_fail_on_an_idle_machine(
    inconclusive: int, tests: int, idle: float, *, expected: bool
) -> None:
    """A session fails if more than 5 % of its tests, at least two, are inconclusive on a mostly idle machine."""
    assert inconclusive_too_often(inconclusive, tests, idle) is expected


def test_low_priority_work_is_idle_time() -> None:
    """Waiting for disks and running programs with a niceness above 0 count as idle time; stolen time does not."""
    before, after = "cpu  100 100 100 100 100 100 100 100 0 0", "cpu  110 120 110 130 110 100 100 120 0 0"
    assert idle_share(before, after) == pytest.approx((20 + 30 + 10) / 100)
    assert idle_share(before, before) == 0


@pytest.mark.parametrize(("stall", "raised"), [(None, AssertionError), (Stall(0, 0, 31 * MS), HostStalled)])
def test_stall_excuses_an_assertion_about_times(stall: Stall | None, raised: type[Exception]) -> None:
    """A stall excuses a failed assertion about times, but no other exception."""
    stalls = stalls_of(*([stall] if stall else []))
    with pytest.raises(raised, match="late") as caught, stalls.excusing_failures(0, 100 * MS):
        raise AssertionError("late")
    assert caught.type is raised
    assert stalls.excused == (raised is HostStalled)
    with pytest.raises(ValueError, match="broken"), stalls.excusing_failures(0, 100 * MS):
        raise ValueError("broken")


def test_shared_result_is_made_again_after_a_stall() -> None:
    """A shared result is made once, and again after each excuse, at most three times in all."""
    stalls, numbers = stalls_of(), iter(range(9))
    shared = SharedResult(stalls, lambda: next(numbers))
    assert [shared.get(), shared.get()] == [0, 0]
    stalls.excused += 1
    assert [shared.get(), shared.get()] == [1, 1]
    stalls.excused += 2
    assert shared.get() == 2
    stalls.excused += 1
    assert shared.get() == 2


def test_failure_to_make_a_shared_result_fails_every_test() -> None:
    """If a shared result cannot be made and no stall explains it, each request raises that failure."""
    attempts = []

    def broken() -> None:
        attempts.append(1)
        raise AssertionError("it does not stop")

    shared = SharedResult(stalls_of(), broken)
    for _ in range(4):
        with pytest.raises(AssertionError, match="does not stop"):
            shared.get()
    assert len(attempts) == 1


def test_shared_result_is_given_up_after_three_stalls() -> None:
    """If the host stalls each of three attempts, later requests raise without another attempt."""
    attempts = []

    def stalled() -> None:
        attempts.append(1)
        raise HostStalled("300 ms")

    shared = SharedResult(stalls_of(), stalled)
    for _ in range(3):
        with pytest.raises(HostStalled, match="300 ms"):
            shared.get()
    with pytest.raises(HostStalledEachTime):
        shared.get()
    assert len(attempts) == 3


CONFTEST = """
import pytest
from tests.support.inconclusive import SESSION
from tests.support.stalls import Stalls
from tests.test_stalls import {probe}

pytest_plugins = ["tests.support.inconclusive"]

def pytest_configure(config):
    config.addinivalue_line("markers", "judges_times: of the project")

@pytest.fixture(scope="session")
def stalls(request):
    processor_times = iter([{before!r}, {after!r}])  # as in /proc/stat
    stalls = request.config.stash[SESSION].stalls = Stalls([{probe}()], lambda: next(processor_times))
    return stalls

@pytest.fixture
def stalled_fixture(stalls):
    from tests.support.stalls import HostStalled
    raise HostStalled("in its setup")
"""
STALLED_TESTS = """
from tests.support.stalls import HostStalled, HostStalledEachTime

tries = []

def test_good(stalls):
    pass

def test_stalled_once(stalls):
    tries.append(1)
    if len(tries) == 1:
        raise HostStalled("300 ms")

def test_stalled_each_time(stalls):
    tries.append(2)
    raise HostStalled("300 ms")

def test_given_up(stalls):
    tries.append(3)
    raise HostStalledEachTime("300 ms")

def test_stalled_in_setup(stalled_fixture):
    pass

def test_without_the_fixture():
    assert tries == [1, 1, 2, 2, 2, 3]
"""
TESTS_WITH_MARKER = """
import pytest
from tests.support.stalls import Stall

late = []

@pytest.mark.judges_times(stall_ms=40)
def test_stalled_once(request):
    stalls = request.getfixturevalue("stalls")
    if not late:
        now_ns = stalls.clock.now().mono_ns
        stalls.recorded.append(Stall(0, now_ns, now_ns + 41_000_000))
        late.append(1)
        assert False, "late"
    stalls.recorded.clear()

@pytest.mark.judges_times(stall_ms=40)
def test_fault():
    late.append(2)
    assert False, "broken"

def test_tries():
    assert late == [1, 2]
"""
FAULTY_TESTS = """
from tests.support.stalls import HostStalled

tries = []

def test_fault(stalls):
    tries.append(1)
    raise AssertionError("HostStalled: a frame after the freeze")

def test_fault_while_stalled(stalls):
    tries.append(2)
    try:
        raise HostStalled("300 ms")
    finally:
        assert False

def test_fault_after_a_stall(stalls):
    tries.append(3)
    if tries.count(3) == 1:
        raise HostStalled("300 ms")
    assert False

def test_tries():
    assert tries == [1, 2, 3, 3]
"""


class EndedProbe(FakeLatenessProbe):
    """A fake lateness probe that ends after its first report."""

    def report(self) -> tuple[int, list[Stall]]:  # noqa: D102 (documented in `Probe`)
        if self.report_count:
            raise ProbeEnded("the lateness probe of processor 7 ended with -9")
        return super().report()


def run_session(
    pytester: pytest.Pytester, tests: str, *, after: str = BUSY, probe: type[FakeLatenessProbe] = FakeLatenessProbe
) -> pytest.RunResult:
    pytester.makeconftest(CONFTEST.format(before=QUIET, after=after, probe=probe.__name__))
    pytester.makepyfile(tests)
    return pytester.runpytest_inprocess("-p", "no:xdist", "-p", "no:cacheprovider", "-p", "no:randomly")


def test_a_test_that_is_stalled_each_time_is_inconclusive(pytester: pytest.Pytester) -> None:
    """After two more attempts a stalled test is listed as inconclusive; it neither passes nor fails."""
    result = run_session(pytester, STALLED_TESTS)
    assert result.parseoutcomes() == {"passed": 3, "rerun": 5, "inconclusive": 3}
    assert result.ret == pytest.ExitCode.OK
    result.stdout.fnmatch_lines(
        [
            "AGAIN *::test_stalled_once: *HostStalled: 300 ms",
            "INCONCLUSIVE *::test_stalled_each_time: *HostStalled: 300 ms",
            "INCONCLUSIVE *::test_given_up: *: 300 ms",
            "INCONCLUSIVE *::test_stalled_in_setup: *HostStalled: in its setup",
            "HOST *; the machine was 10% idle; 3 of 6 tests inconclusive",
        ]
    )


def test_stall_excuses_a_test_with_the_marker(pytester: pytest.Pytester) -> None:
    """A marked test is repeated if a stall overlaps it, and fails immediately otherwise."""
    result = run_session(pytester, TESTS_WITH_MARKER)
    assert result.parseoutcomes() == {"passed": 2, "failed": 1, "rerun": 1}


def test_fault_is_never_excused(pytester: pytest.Pytester) -> None:
    """Only `HostStalled` itself lets a test be repeated, and earlier stalls do not excuse a failed attempt."""
    result = run_session(pytester, FAULTY_TESTS)
    assert result.parseoutcomes() == {"failed": 3, "rerun": 1, "passed": 1}
    assert result.ret == pytest.ExitCode.TESTS_FAILED


def test_session_fails_for_inconclusive_tests_on_an_idle_machine(pytester: pytest.Pytester) -> None:
    """Three inconclusive tests of six fail the session of an idle machine, with a message."""
    result = run_session(pytester, STALLED_TESTS, after="cpu 40 0 0 60 0 0 0 0 0 0")
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(["FAILED: 3 of 6 tests were inconclusive on a machine that was 60% idle"])


def test_ended_probe_fails_the_session(pytester: pytest.Pytester) -> None:
    """A session fails if a probe ended early, even if all tests pass."""
    result = run_session(pytester, "def test_good(stalls): pass", probe=EndedProbe)
    assert result.parseoutcomes() == {"passed": 1}
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(["FAILED: the lateness probe of processor 7 ended with -9"])


SPIN = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
if sys.argv[2] == "real-time":
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(90))
else:
    os.setpriority(os.PRIO_PROCESS, 0, -15)
print(time.monotonic_ns())
end_ns = time.monotonic_ns() + int(sys.argv[3]) * 1_000_000
while time.monotonic_ns() < end_ns: pass
print(time.monotonic_ns())
"""


def spin(processor: int, priority: str, duration_ms: int) -> tuple[int, int]:
    """Occupy a processor; return the times (ns) at which the program began and ended."""
    arguments = [sys.executable, "-I", "-S", "-c", SPIN, str(processor), priority, str(duration_ms)]
    began, ended = subprocess.run(arguments, check=True, capture_output=True, text=True).stdout.split()
    return int(began), int(ended)


@contextmanager
def measuring_stalls() -> Iterator[Stalls]:
    measured = Stalls.start_probes()
    try:
        if not all(probe.has_realtime_priority for probe in measured.probes):
            pytest.skip("needs the right to real-time priority")
        yield measured
    finally:
        measured.end()


@pytest.mark.realtime
def test_stalled_processor_is_recorded() -> None:
    """A processor that a program of higher real-time priority takes for 100 ms is recorded as stalled for that time."""
    with measuring_stalls() as stalls:
        processor = min(os.sched_getaffinity(0))
        began_ns, ended_ns = spin(processor, "real-time", 100)
        recorded = stalls.during(began_ns, ended_ns, at_least_ms=60)
        assert [stall.processor for stall in recorded if 60 < stall.length_ms < 130] == [processor]


@pytest.mark.realtime
def test_busy_program_is_no_stall() -> None:
    """LAVT's highest process priority does not delay a probe, so a busy LAVT program is never recorded as a stall.

    One of five attempts without a stall is enough, because the host itself can stall the machine.
    """
    with measuring_stalls() as stalls:
        attempts_ns = [spin(min(os.sched_getaffinity(0)), "nice", 200) for _ in range(5)]
        assert not all(stalls.during(began_ns, ended_ns, at_least_ms=20) for began_ns, ended_ns in attempts_ns)


@pytest.mark.realtime
def test_probe_uses_little_processor_time() -> None:
    """A probe uses less than 2 % of its processor."""
    probe = ProbeProcess(min(os.sched_getaffinity(0)))
    try:
        before_s = processor_time_s(probe.pid)
        pause(2 * NS_PER_S)
        assert processor_time_s(probe.pid) - before_s < 0.04
    finally:
        probe.end()


def processor_time_s(pid: int) -> float:
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / NS_PER_S


PARENT = """
import signal, sys, time
from tests.support.stalls import Stalls
measured = Stalls.start_probes()
print(*(probe.pid for probe in measured.probes), flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("with_signal", [signal.SIGKILL, signal.SIGTERM])
def test_probes_end_with_pytest(with_signal: signal.Signals) -> None:
    """Whether pytest is killed by SIGKILL or SIGTERM, no probe remains."""
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    probes = parent.stdout.readline().split()
    parent.send_signal(with_signal)
    parent.wait()
    parent.stdout.close()
    assert probes
    for pid in probes:
        wait_for_end(int(pid))


def wait_for_end(pid: int) -> None:
    clock = MachineClock()
    limit_ns = clock.now().mono_ns + 10 * NS_PER_S
    while is_running(pid):
        assert clock.now().mono_ns < limit_ns, f"process {pid} still runs"
        pause(10 * NS_PER_MS)


def is_running(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2][0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_killed_probe_is_reported() -> None:
    """Querying a killed probe raises an error instead of returning an empty record."""
    probe = ProbeProcess(min(os.sched_getaffinity(0)))
    os.kill(probe.pid, signal.SIGKILL)
    wait_for_end(probe.pid)
    with pytest.raises(ProbeEnded, match="ended with -9"):
        probe.report()
    probe.end()
