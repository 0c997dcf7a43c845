"""Measure how late one processor wakes a program of real-time priority, until standard input ends.

    python lateness_probe.py PROCESSOR

The process sleeps for 8 ms at a time and records each late wake, with the time when it was due and the time when it
occurred (CLOCK_MONOTONIC, ns). Its first line says whether the process has real-time priority (SCHED_FIFO), which is
above any niceness. It answers each byte on standard input with one line: the present time, and the late wakes since the
last answer. It ends with standard input or with its parent process. It imports nothing of LAVT, so that it starts fast.
"""

from __future__ import annotations

import ctypes
import json
import os
import select
import signal
import sys
import time  # noqa: TID251 (a program that measures the machine itself)

PRIORITY = 10
"""Above all programs without real-time priority, whatever their niceness; below the load of `host_load.py`."""
PERIOD_MS = 8
"""A shorter period costs more than 1 % of a processor. The recorded length of a stall lacks at most one period."""
LATE_NS = 1_000_000
"""Shorter delays are not recorded. A quiet machine wakes the probe within 0.1 ms."""
PR_SET_PDEATHSIG = 1
"""linux/prctl.h: the kernel sends this process a signal when its parent ends."""


def take_priority() -> bool:
    """Take real-time priority and return True; without the right to it take the best niceness, and return False."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        for niceness in range(-20, os.getpriority(os.PRIO_PROCESS, 0)):
            try:
                os.setpriority(os.PRIO_PROCESS, 0, niceness)
            except PermissionError:
                continue
            break
        return False
    return True


def write_line(value: object) -> None:
    """Write a value to standard output as one line of JSON."""
    os.write(1, json.dumps(value).encode() + b"\n")


def main() -> None:
    """Measure one processor until standard input ends."""
    parent = os.getppid()
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        return
    os.sched_setaffinity(0, {int(sys.argv[1])})
    write_line(take_priority())
    limit_ns = LATE_NS + 2 * round(time.clock_getres(time.CLOCK_MONOTONIC) * 1e9)
    late_wakes: list[tuple[int, int]] = []
    poller = select.poll()
    poller.register(0, select.POLLIN)
    due_ns = time.monotonic_ns() + PERIOD_MS * 1_000_000
    while True:
        ready = poller.poll(PERIOD_MS)
        now_ns = time.monotonic_ns()
        if now_ns - due_ns > limit_ns:
            late_wakes.append((due_ns, now_ns))
        if ready:
            if not os.read(0, 4096):
                return
            write_line([now_ns, late_wakes])
            late_wakes.clear()
        due_ns = time.monotonic_ns() + PERIOD_MS * 1_000_000


if __name__ == "__main__":
    main()
