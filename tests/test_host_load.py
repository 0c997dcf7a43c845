from __future__ import annotations

import subprocess
import sys
from itertools import pairwise

import pytest
from tests.support.host_load import stop_times
from tests.support.stalls import HostStalled, Stalls

MODULE = [sys.executable, "-m", "tests.support.host_load"]
STOP_MS, SHORTEST_STOP_MS, SLICE_MS = 120, 90, 5
"""The length of a stop, the shortest stall that is taken for one, and the longest that the load's share can cause."""
HOST_MS = 50
"""If the host stalls a processor for this long, the load can lack its share. A tenth of it is 108 ms."""


def test_stop_times_follow_from_the_seed() -> None:
    """The same seed gives the same stop times, another seed gives other times, and the mean rate is as requested."""
    settings = {"every_s": 20.0, "stop_ms": 300.0, "last_stop_s": 20_000.0}
    stops = stop_times(1, **settings)
    assert stops == stop_times(1, **settings) != stop_times(2, **settings)
    assert 850 < len(stops) < 1150  # 20000 s / (20 s + 300 ms) = 985 are expected
    assert all(end - begin == 300_000_000 for begin, end in stops)
    assert all(end <= begin for (_, end), (begin, _) in pairwise(stops))
    assert stop_times(1, every_s=0, stop_ms=300) == []


@pytest.mark.parametrize("arguments", [["--share", "0.3"], ["--share", "0.7", "--stop-ms", "300", "--", "true"]])
def test_invalid_arguments_are_rejected(arguments: list[str]) -> None:
    """Without a command, or with more load than the kernel allows real-time programs, the exit code is 2."""
    assert subprocess.run([*MODULE, *arguments], capture_output=True, check=False).returncode == 2


@pytest.mark.realtime
def test_load_stops_all_processors_together() -> None:
    """While the command runs, all processors stop together and the load takes its share; the exit code is returned."""
    measured = Stalls.start_probes()
    try:
        if not all(probe.has_realtime_priority for probe in measured.probes):
            pytest.skip("needs the right to real-time priority")
        options = ["--share", "0.3", "--stop-ms", str(STOP_MS), "--stops-every-s", "0.5", "--seed", "1"]
        command = [sys.executable, "-c", "import time; time.sleep(3); raise SystemExit(3)"]
        completed = subprocess.run([*MODULE, *options, "--", *command], capture_output=True, text=True, check=False)
        measured.collect()
    finally:
        measured.end()
    assert completed.returncode == 3
    try:
        check_load(measured, completed.stderr)
    except AssertionError as failure:
        slow = [stall for stall in measured.recorded if stall.length_ms > SLICE_MS]
        host_ms = max(
            sum(stall.length_ms for stall in slow if stall.processor == number) - STOP_MS * int(line.split()[-2])
            for number, line in enumerate(completed.stderr.splitlines())
        )
        if host_ms < HOST_MS:
            raise
        raise HostStalled(f"the host stalled a processor for {host_ms:.0f} ms; {failure}") from None


def check_load(measured: Stalls, report: str) -> None:
    """Check that all processors were stopped together, and that the load had its share."""
    stops = [
        [
            stall
            for stall in measured.recorded
            if stall.processor == probe.processor and stall.length_ms > SHORTEST_STOP_MS  # type: ignore[attr-defined]
        ]
        for probe in measured.probes
    ]
    assert len({len(processor_stops) for processor_stops in stops}) == 1
    assert stops[0]
    for simultaneous_stalls in zip(*stops, strict=True):
        end_times_ns = [stall.end_ns for stall in simultaneous_stalls]
        assert max(end_times_ns) - min(end_times_ns) < 20_000_000
    shares = [float(line.partition(" had ")[2].partition("%")[0]) for line in report.splitlines()]
    assert all(share > 90 for share in shares), report
