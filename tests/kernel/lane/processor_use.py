"""The use of this machine's single processor, as the kernel counts it.

A user-mode kernel has one processor and slow system calls. While that processor has no idle time, the programs on it,
of LAVT and of the tests, wait for each other, whatever their priorities. A drive that ends early for a time-out in such
a moment says nothing about LAVT on a machine that is fast enough. A program that wrongly occupies a processor has the
same effect; the field tests, on two processors, would find it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.stalls import HostStalled

from lavt.clock import MachineClock
from lavt.domain import NS_PER_S

PERIOD_S = 0.1
WINDOW_NS = 2 * NS_PER_S
"""The use is measured over this time before an event: the queues of a busy machine take about this long to empty."""
KEPT_SAMPLES = 1200
MIN_IDLE_SHARE = 0.05
"""A machine with a smaller idle share is too slow for its programs."""


class ProcessorUse:
    """Samples of the processor's idle time."""

    def __init__(self) -> None:
        self._clock = MachineClock()
        self._samples: deque[tuple[int, int, int]] = deque(maxlen=KEPT_SAMPLES)

    def sample(self) -> None:
        """Take a sample."""
        fields = [int(field) for field in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
        self._samples.append((self._clock.now().mono_ns, fields[3] + fields[4], sum(fields)))

    def idle_share(self, until_ns: int) -> float:
        """Return the idle share of the `WINDOW_NS` before a time; 1 if there are not enough samples."""
        within = [sample for sample in tuple(self._samples) if until_ns - WINDOW_NS <= sample[0] <= until_ns]
        ticks = within[-1][2] - within[0][2] if within else 0
        return (within[-1][1] - within[0][1]) / ticks if ticks > 0 else 1.0

    def verdict(self, failure: Exception, at_ns: int) -> Exception:
        """Return `HostStalled` if the machine had no idle time before `at_ns`, and the failure otherwise."""
        if isinstance(failure, HostStalled):
            return failure
        share = self.idle_share(at_ns)
        message = f"the processor was idle for {share:.0%} of the time before; {failure}"
        return HostStalled(message) if share < MIN_IDLE_SHARE else AssertionError(message)


@contextmanager
def measured_processor() -> Iterator[ProcessorUse]:
    """Measure the use of the processor in a thread."""
    use, ended = ProcessorUse(), threading.Event()

    def run() -> None:
        while not ended.wait(PERIOD_S):
            use.sample()

    thread = threading.Thread(target=run, name="processor use", daemon=True)
    thread.start()
    try:
        yield use
    finally:
        ended.set()
        thread.join()
