"""One process of a round trip: `echo CARRIER ROUTERS`, or `ask CARRIER ROUTERS ADDRESS SECONDS MESSAGES`."""

from __future__ import annotations

import json
import sys
import time  # noqa: TID251 (a benchmark reads the clock)

from benchmarks.round_trip.carriers import CARRIERS, End

from lavt.domain import NS_PER_S, PATH_POINTS, Command
from lavt.transport.messages import encode

PERIOD_NS = NS_PER_S // 50
WAITS_S = 1.0
"""So long for one echo; then it is lost."""
READY_S = 20.0
"""So long for the first one: routers, discovery."""
END = b"end"
WARM_UP = 50


def command(sequence: int) -> bytes:
    """Encode a command as the driver sends it, full of numbers that take their room."""
    wall_ns = time.time_ns()
    path = tuple(0.01 + 0.001 * each for each in range(PATH_POINTS))
    return encode(Command(2**63 + 5, sequence, wall_ns, wall_ns - 1, wall_ns - 2, 0.123, 0.456, 0.01, path, "drive", 0))


def echo(end: End) -> None:
    """Send back whatever comes, until told to end."""
    while (data := end.receive(60.0)) is not None and data != END:
        end.send(data)


def round_trip_ns(end: End, sequence: int, timeout_s: float) -> int | None:
    """Send a command and wait for the very same; None: it is lost."""
    data = command(sequence)
    begin_ns = time.perf_counter_ns()
    end.send(data)
    while (echoed := end.receive(timeout_s)) is not None:
        if echoed == data:
            return time.perf_counter_ns() - begin_ns
    return None


def wait_until_it_works(end: End) -> None:
    """Ask until there is an echo, and some more; raises `SystemExit` where there is none."""
    until_ns = time.monotonic_ns() + round(READY_S * NS_PER_S)
    while round_trip_ns(end, 0, 0.1) is None:
        if time.monotonic_ns() > until_ns:
            raise SystemExit(f"no echo within {READY_S:.0f} s")
    for sequence in range(WARM_UP):
        round_trip_ns(end, sequence, WAITS_S)


def ask(end: End, seconds: float, messages: int) -> dict[str, list[int | None]]:
    """Measure round trips at 50 Hz for so long, and so many back to back; None is a lost one."""
    wait_until_it_works(end)
    paced: list[int | None] = []
    begin_ns = time.monotonic_ns()
    for number in range(round(seconds * 50)):
        time.sleep(max(0, begin_ns + number * PERIOD_NS - time.monotonic_ns()) / NS_PER_S)
        paced.append(round_trip_ns(end, number, WAITS_S))
    return {"at_50_hz": paced, "back_to_back": [round_trip_ns(end, number, WAITS_S) for number in range(messages)]}


def main() -> None:
    """Be one side."""
    what, carrier, routers, *more = sys.argv[1:]
    address = more[0] if what == "ask" else ""
    end = CARRIERS[carrier].end(address, json.loads(routers))
    try:
        if what == "echo":
            print(json.dumps({"address": end.address}), flush=True)
            echo(end)
        else:
            print(json.dumps(ask(end, float(more[1]), int(more[2]))), flush=True)
            end.send(END)
    finally:
        end.close()


if __name__ == "__main__":
    main()
