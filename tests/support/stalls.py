"""The record of times when the host stalled this machine, and verdicts on timing that use this record.

A test of real time can fail because a program is too slow, or because the host (the hypervisor) did not run this
machine. One probe for each processor (`lateness_probe.py`) distinguishes the two cases. No program of LAVT can delay a
probe, because the probe's real-time priority is higher than theirs. A failed timing assertion is excused
(`HostStalled`) only if a probe was late at the relevant time. Then pytest runs the test again, at most twice. If the
host stalls the last run, too, the test is inconclusive (`inconclusive.py`). Assertions on safety are plain `assert`s
and never excused.

Without the right to real-time priority the probes are ordinary processes. They are still used, because LAVT's programs
have no raised priority then, either. But then programs can delay a probe, which looks like a stall; the summary says
so.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S

PROBE = Path(__file__).with_name("lateness_probe.py")
STALL_MS = 30.0
"""The shortest stall that excuses a failure, unless an assertion names another length."""
LONG_STALL_MS = 100.0
"""A stall this long can make the car leave its lane, or can cause a command timeout, which comes after 300 ms."""
BUSY_SHARE = 0.05
"""If this share of a drive or more is stalled, the medians of the drive's latencies change."""
SLOW_SHARE = 0.15
"""The share of an interval that must be stalled before many short stalls explain a failure. A drive that lacks 15 ms of
each 100 ms still works as usual (`docs/by_wire.md`)."""
SLOW_INTERVAL_NS = NS_PER_S
"""In shorter intervals the share explains nothing, because one short stall can be a large share of them."""
COUNTED_MS = 10.0
"""The summary at the end counts only stalls of this length or more."""
MAX_DESCRIBED = 4
"""A description names at most this many stalls."""
MAX_ATTEMPTS = 3
MAX_INCONCLUSIVE = 0.05
"""The largest share of inconclusive tests with which a lane passes on a machine that is not busy."""
BUSY_BELOW = 0.5
"""A machine whose idle share is smaller is busy. Then any number of tests is allowed to be inconclusive."""

Result = TypeVar("Result")


class HostStalled(Exception):
    """The host stalled this machine, so the result of the test means nothing. The test is run again."""


class HostStalledEachTime(HostStalled):
    """The host stalled each of several attempts; the test is not run again."""


class ProbeEnded(Exception):
    """A lateness probe ended before pytest did, so nothing can be excused any more."""


@dataclass(frozen=True)
class Stall:
    """An interval in which one processor did not run its lateness probe (CLOCK_MONOTONIC)."""

    processor: int | str
    begin_ns: int
    end_ns: int

    @property
    def length_ms(self) -> float:
        """The length of the interval."""
        return (self.end_ns - self.begin_ns) / NS_PER_MS


def overlapping(stalls: Iterable[Stall], since_ns: int, until_ns: int, *, at_least_ms: float = 0.0) -> list[Stall]:
    """Return the stalls that overlap an interval and last `at_least_ms` or longer."""
    return [
        stall
        for stall in stalls
        if stall.begin_ns <= until_ns and stall.end_ns >= since_ns and stall.length_ms >= at_least_ms
    ]


def stalled_share(stalls: Iterable[Stall], since_ns: int, until_ns: int) -> float:
    """Return the stalled share of an interval, on the processor that was stalled for the longest time."""
    total_ns: dict[int | str, int] = {}
    for stall in overlapping(stalls, since_ns, until_ns):
        overlap_ns = min(stall.end_ns, until_ns) - max(stall.begin_ns, since_ns)
        total_ns[stall.processor] = total_ns.get(stall.processor, 0) + overlap_ns
    return max(total_ns.values(), default=0) / max(until_ns - since_ns, 1)


def describe(stalls: Sequence[Stall], since_ns: int) -> str:
    """Return a description of the longest stalls; their times count from `since_ns`."""
    longest = sorted(
        sorted(stalls, key=lambda stall: -stall.length_ms)[:MAX_DESCRIBED], key=lambda stall: stall.begin_ns
    )
    descriptions = [
        f"{stall.length_ms:.0f} ms on processor {stall.processor} at {(stall.begin_ns - since_ns) / NS_PER_MS:+.0f} ms"
        for stall in longest
    ]
    more = len(stalls) - len(longest)
    return ", ".join(descriptions) + (f" and {more} more" if more else "")


def inconclusive_too_often(inconclusive: int, tests: int, idle_share: float) -> bool:
    """Return whether more tests were inconclusive than the machine's load explains.

    Too many are more than 5 % and more than one test, if the machine was idle for more than half of the time.
    """
    return idle_share > BUSY_BELOW and inconclusive > max(1, MAX_INCONCLUSIVE * tests)


def idle_share(before: str, after: str) -> float:
    """Return the idle share of the processors between two readings of the first line of /proc/stat.

    Time of programs with a positive niceness counts as idle, because other work may run at low priority.
    """
    before_ticks, after_ticks = ([int(number) for number in line.split()[1:9]] for line in (before, after))
    _user, nice, _system, idle, wait, *_others = differences = [
        after_count - before_count for after_count, before_count in zip(after_ticks, before_ticks, strict=True)
    ]
    return (nice + idle + wait) / max(sum(differences), 1)


class Probe(Protocol):
    """The interface of a lateness probe, which records when its processor was stalled."""

    has_realtime_priority: bool
    """Whether no program without real-time priority can delay the probe."""

    def report(self) -> tuple[int, list[Stall]]:
        """Return the time (ns) and the stalls since the last report; raise `ProbeEnded` if the probe has ended."""
        ...

    def end(self) -> None:
        """End the probe."""
        ...


class ProbeProcess:
    """A process that runs `lateness_probe.py` on one processor."""

    def __init__(self, processor: int, name: str = "") -> None:
        self.processor: int | str = name or processor
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", PROBE, str(processor)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        self.has_realtime_priority = bool(json.loads(self._line()))

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    def report(self) -> tuple[int, list[Stall]]:
        """Return the present time (ns) and the stalls since the last report."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(b"?")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self._ended() from None
        now_ns, late_wakes = json.loads(self._line())
        return now_ns, [Stall(self.processor, begin_ns, end_ns) for begin_ns, end_ns in late_wakes]

    def end(self) -> None:
        """End the process."""
        self._process.communicate()

    def _line(self) -> bytes:
        assert self._process.stdout is not None
        line: bytes = self._process.stdout.readline()
        if not line:
            raise self._ended()
        return line

    def _ended(self) -> ProbeEnded:
        return ProbeEnded(f"the lateness probe of processor {self.processor} ended with {self._process.wait()}")


def read_processor_times() -> str:
    """Return the first line of /proc/stat."""
    return Path("/proc/stat").read_text().partition("\n")[0]


@dataclass
class Stalls:
    """The record of all probes, and verdicts that use the record."""

    probes: Sequence[Probe]
    processor_times: Callable[[], str] = read_processor_times
    recorded: list[Stall] = field(default_factory=list)
    clock: MachineClock = field(default_factory=MachineClock)
    excused: int = 0
    """Number of failures that the record has excused so far."""

    def __post_init__(self) -> None:
        self._before = self.processor_times()
        self._began_ns = max((probe.report()[0] for probe in self.probes), default=0)
        self._reported_ns = self._began_ns

    @classmethod
    def start_probes(cls) -> Stalls:
        """Start one probe on each processor that this process may use."""
        return cls([ProbeProcess(processor) for processor in sorted(os.sched_getaffinity(0))])

    def during(self, since_ns: int, until_ns: int, *, at_least_ms: float = 0.0) -> list[Stall]:
        """Return the stalls that overlap an interval; wait until all probes have reported beyond it."""
        pause(until_ns - self.clock.now().mono_ns)
        self.collect(until_ns)
        return overlapping(self.recorded, since_ns, until_ns, at_least_ms=at_least_ms)

    def collect(self, until_ns: int = 0) -> None:
        """Collect the probes' records, at least up to a time; raise `ProbeEnded` if a probe has ended."""
        for probe in self.probes:
            reported_ns, stalls = probe.report()
            self.recorded += stalls
            while reported_ns < until_ns:
                reported_ns, stalls = probe.report()
                self.recorded += stalls
            self._reported_ns = max(self._reported_ns, reported_ns)

    def require(
        self, condition: object, message: str, since_ns: int, until_ns: int, *, stall_ms: float = STALL_MS
    ) -> None:
        """Unless `condition` is true, raise `HostStalled` if a stall overlaps the interval, or else AssertionError.

        The interval must end at the test's time limit or earlier, because a late or missing event was due before that
        limit.
        """
        if not condition:
            raise self.verdict(message, since_ns, until_ns, stall_ms=stall_ms)

    def verdict(self, message: str, since_ns: int, until_ns: int, *, stall_ms: float = STALL_MS) -> Exception:
        """Return the exception for a failure: `HostStalled` if a stall overlaps the interval, else AssertionError."""
        stalls = self.during(since_ns, until_ns, at_least_ms=stall_ms)
        if not stalls:
            return AssertionError(message)
        self.excused += 1
        return HostStalled(f"{describe(stalls, since_ns)}; {message}")

    def share_verdict(self, message: str, since_ns: int, until_ns: int, *, share: float) -> Exception:
        """Return the exception for a wrong rate or median: `HostStalled` if the stalled share of the time is large.

        A single stall does not excuse such a failure. The share is that of `stalled_share`.
        """
        stalls = self.during(since_ns, until_ns)
        stalled = stalled_share(stalls, since_ns, until_ns)
        if stalled < share:
            return AssertionError(message)
        self.excused += 1
        return HostStalled(f"{stalled:.1%} of the time, {describe(stalls, since_ns)}; {message}")

    @contextmanager
    def excusing_failures(
        self, since_ns: int, until_ns: int | None = None, *, stall_ms: float = STALL_MS, share: float | None = None
    ) -> Iterator[None]:
        """Excuse a failed assertion about times in this context, by one stall or, with `share`, by a stalled share.

        In an interval of `SLOW_INTERVAL_NS` or more, many stalls shorter than `stall_ms` excuse it, too, if they take
        `SLOW_SHARE` of it. Without `until_ns` the interval ends when the assertion fails. Assertions on safety must be
        outside.
        """
        try:
            yield
        except AssertionError as failure:
            end_ns = self.clock.now().mono_ns if until_ns is None else until_ns
            verdict: Exception = failure
            if share is None:
                verdict = self.verdict(str(failure), since_ns, end_ns, stall_ms=stall_ms)
                share = SLOW_SHARE if end_ns - since_ns >= SLOW_INTERVAL_NS else math.inf
            if not isinstance(verdict, HostStalled):
                verdict = self.share_verdict(str(failure), since_ns, end_ns, share=share)
            if isinstance(verdict, AssertionError):
                raise
            raise verdict from None

    def idle_share(self) -> float:
        """Return the idle share of the processors since the start."""
        return idle_share(self._before, self.processor_times())

    def summary(self) -> str:
        """Return a summary of the record until the last report, by processor."""
        elapsed_ns = max(self._reported_ns - self._began_ns, 1)
        by_processor = []
        for processor in sorted({stall.processor for stall in self.recorded}, key=str):
            on_processor = [stall for stall in self.recorded if stall.processor == processor]
            counted = [stall for stall in on_processor if stall.length_ms >= COUNTED_MS]
            share = stalled_share(on_processor, self._began_ns, self._reported_ns)
            longest_ms = max(stall.length_ms for stall in on_processor)
            by_processor.append(
                f"processor {processor} {len(counted)}, longest {longest_ms:.0f} ms, {share:.2%} of the time"
            )
        text = f"stalls over {COUNTED_MS:.0f} ms in {elapsed_ns / NS_PER_S:.0f} s: {'; '.join(by_processor) or 'none'}"
        if not all(probe.has_realtime_priority for probe in self.probes):
            text += " (no right to real-time priority: programs of the tests may have caused them)"
        return text

    def end(self) -> None:
        """End all probes."""
        for probe in self.probes:
            probe.end()


class SharedResult(Generic[Result]):
    """A result that several tests judge, such as a drive. After a stall it is computed again, at most twice."""

    def __init__(self, stalls: Stalls, make: Callable[[], Result]) -> None:
        self._stalls, self._make = stalls, make
        self._results: list[Result] = []
        self._failure: Exception | None = None
        self._attempts_left, self._excused = MAX_ATTEMPTS, 0

    def get(self) -> Result:
        """Return the result; make it if there is none yet, or if a failure was excused since the last one was made.

        If `make` fails and no stall explains this, the failure is raised for every test.
        """
        if (
            self._failure is None
            and self._attempts_left
            and not (self._results and self._excused == self._stalls.excused)
        ):
            self._attempts_left -= 1
            self._results.clear()
            try:
                self._results.append(self._make())
            except HostStalled:
                raise
            except Exception as failure:
                self._failure = failure
            self._excused = self._stalls.excused
        if self._failure is not None:
            raise self._failure
        if not self._results:
            raise HostStalledEachTime("the host stalled each attempt to make the result that this test judges")
        return self._results[0]


def excuse_slow_machine(
    failure: Exception, stalls: Stalls, since_ns: int, until_ns: int, *, share: float = SLOW_SHARE
) -> Exception:
    """Return `HostStalled` if many short stalls took `share` of the interval, and the failure otherwise."""
    if isinstance(failure, HostStalled):
        return failure
    recorded = stalls.during(since_ns, until_ns)
    stalled = stalled_share(recorded, since_ns, until_ns)
    message = f"stalled for {stalled:.1%} of the time, {describe(recorded, since_ns)}; {failure}"
    return AssertionError(message) if stalled < share else HostStalled(message)
