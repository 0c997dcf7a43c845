"""Measure how late one processor runs a program of real-time priority, until standard input ends.

    python lateness_probe.py PROCESSOR

The process sleeps 8 ms at a time and keeps each wake that came too late, with the time at which it was due and the time
at which it came (CLOCK_MONOTONIC, ns). Its first line says whether it has real-time priority (SCHED_FIFO), which no
niceness reaches. For each byte on standard input it answers with one line: the time, and what was late since the last
answer. It ends with standard input or with the process that started it. It imports nothing of LAVT, to start fast.
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
"""Above all programs without real-time priority, whatever their niceness; below what stands for a busy host."""
PERIOD_MS = 8
"""Shorter costs more than 1 % of a processor. A stall is recorded at most so much shorter than it was."""
LATE_NS = 1_000_000
"""Less is not kept. A quiet machine wakes the probe within 0.1 ms."""
SET_DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of linux/prctl.h."""


def go_first() -> bool:
    """Take real-time priority; without the right to it take the best niceness allowed, and return False."""
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


def answer(value: object) -> None:
    """Write one line."""
    os.write(1, json.dumps(value).encode() + b"\n")


def main() -> None:
    """Measure one processor until standard input ends."""
    parent = os.getppid()
    ctypes.CDLL(None).prctl(SET_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        return
    os.sched_setaffinity(0, {int(sys.argv[1])})
    answer(go_first())
    late_ns = LATE_NS + 2 * round(time.clock_getres(time.CLOCK_MONOTONIC) * 1e9)
    late: list[tuple[int, int]] = []
    requested = select.poll()
    requested.register(0, select.POLLIN)
    due_ns = time.monotonic_ns() + PERIOD_MS * 1_000_000
    while True:
        ready = requested.poll(PERIOD_MS)
        now_ns = time.monotonic_ns()
        if now_ns - due_ns > late_ns:
            late.append((due_ns, now_ns))
        if ready:
            if not os.read(0, 4096):
                return
            answer([now_ns, late])
            late.clear()
        due_ns = time.monotonic_ns() + PERIOD_MS * 1_000_000


if __name__ == "__main__":
    main()
