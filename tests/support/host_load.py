"""Run a command on a machine whose host is busy with other work.

    python -m tests.support.host_load --share 0.3 --stop-ms 300 --stops-every-s 20 --seed 1 -- COMMAND...

Processes of the highest real-time priority, one on each processor, occupy a share of every 10 ms. At random times they
also occupy all processors for a while (a "stop"). During a stop no other program runs, whatever its priority, as under
a hypervisor that gives the processors to other machines. The load ends with the command, and this program then returns
the command's exit code. It needs root.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import subprocess
import sys
import time  # noqa: TID251 (spins, and so measures the machine itself)

PRIORITY = 99
PERIOD_NS = 10_000_000
LAST_STOP_S = 4 * 3600
"""No stop begins later than this."""
MAX_SHARE = 0.95
"""The kernel's limit for real-time programs, as a share of each second (sched_rt_runtime_us)."""


def stop_times(seed: int, every_s: float, stop_ms: float, last_stop_s: float = LAST_STOP_S) -> list[tuple[int, int]]:
    """Return the begin and end of each stop, in ns from the start; the times between stops are exponential."""
    from lavt.streams import stream

    generator, stops, at_s = stream(seed, "host load"), [], 0.0
    while every_s > 0 and stop_ms > 0:
        at_s += float(generator.exponential(every_s))
        if at_s > last_stop_s:
            break
        stops.append((round(at_s * 1e9), round(at_s * 1e9 + stop_ms * 1e6)))
        at_s += stop_ms / 1e3
    return stops


def spin_until(end_ns: int) -> int:
    """Occupy the processor until a time of CLOCK_MONOTONIC; return how long that took."""
    begin_ns = now_ns = time.monotonic_ns()
    while now_ns < end_ns:
        now_ns = time.monotonic_ns()
    return now_ns - begin_ns


def spin(processor: int) -> None:
    """Occupy a processor as the first line of standard input says, until standard input ends.

    At the end print the requested CPU time, the actual CPU time, and the time since the start, in ns. The actual time
    is shorter if the kernel did not give the processor to this program.
    """
    os.sched_setaffinity(0, {processor})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    begin_ns, share, stops = json.loads(sys.stdin.readline())
    stdin_poll = select.poll()
    stdin_poll.register(0, select.POLLIN | select.POLLHUP)
    spun_ns, used_before_ns = 0, time.process_time_ns()
    while True:
        now_ns = time.monotonic_ns()
        if stops and now_ns >= begin_ns + stops[0][0]:
            _, stop_end_ns = stops.pop(0)
            spun_ns += spin_until(begin_ns + stop_end_ns)
            now_ns = time.monotonic_ns()
        next_ns = now_ns - (now_ns - begin_ns) % PERIOD_NS + PERIOD_NS
        spun_ns += spin_until(now_ns + round(share * (next_ns - now_ns)))
        if stdin_poll.poll(max(next_ns - time.monotonic_ns(), 0) / 1e6):
            break
    sys.stdout.write(json.dumps([spun_ns, time.process_time_ns() - used_before_ns, time.monotonic_ns() - begin_ns]))


def run_under_load(command: list[str], share: float, stops: list[tuple[int, int]]) -> int:
    """Run a command while the processors are occupied; return its exit code, or 128 plus the signal that killed it."""
    spinners = [
        subprocess.Popen(
            [sys.executable, "-I", "-S", __file__, "--processor", str(processor)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        for processor in sorted(os.sched_getaffinity(0))
    ]
    begin_ns = time.monotonic_ns()
    try:
        for spinner in spinners:
            assert spinner.stdin is not None
            spinner.stdin.write(json.dumps([begin_ns, share, stops]) + "\n")
            spinner.stdin.flush()
        code = subprocess.run(command, check=False).returncode
    finally:
        reports = [spinner.communicate()[0] for spinner in spinners]
    for number, line in enumerate(reports):
        spun_ns, used_ns, lasted_ns = json.loads(line)
        stop_count = sum(begin < lasted_ns for begin, _ in stops)
        sys.stderr.write(
            f"host load: spinner {number} had {used_ns / spun_ns:.1%} of the requested time, "
            f"{spun_ns / lasted_ns:.1%} of {lasted_ns / 1e9:.0f} s, with {stop_count} stops\n"
        )
    return code if code >= 0 else 128 - code


def main() -> int:
    """Parse the arguments and run the command under load."""
    parser = argparse.ArgumentParser(description="Run a command on a machine whose host is busy with other work.")
    parser.add_argument("--share", type=float, default=0.3, help="share of each processor to take")
    parser.add_argument("--stop-ms", type=float, default=300, help="duration of the stops of all processors")
    parser.add_argument("--stops-every-s", type=float, default=20, help="mean interval between stops; 0: no stops")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processor", type=int, help=argparse.SUPPRESS)
    parser.add_argument("command", nargs="*")
    options = parser.parse_args()
    if options.processor is not None:
        spin(options.processor)
        return 0
    if not options.command:
        parser.error("give the command after --")
    if options.share + options.stop_ms / 1e3 >= MAX_SHARE:
        parser.error(
            f"the kernel limits real-time programs to {MAX_SHARE:.0%} of a second: take less, or make shorter stops"
        )
    stops = stop_times(options.seed, options.stops_every_s, options.stop_ms)
    return run_under_load(options.command, options.share, stops)


if __name__ == "__main__":
    sys.exit(main())
