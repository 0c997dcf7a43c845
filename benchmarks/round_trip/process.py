"""One of the two processes of a round trip: the asking one, which sends commands, or the one that echoes them.

The arguments are `echo CARRIER ROUTERS`, or `ask CARRIER ROUTERS ADDRESS SECONDS MESSAGES`.
"""

from __future__ import annotations

import json
import sys
import time  # noqa: TID251 (a benchmark reads the clock)

from benchmarks.round_trip.carriers import CARRIERS, CarrierEnd

from lavt.domain import NS_PER_S, PATH_POINTS, Command
from lavt.transport.messages import encode

PERIOD_NS = NS_PER_S // 50
ECHO_TIMEOUT_S = 1.0
"""An echo that takes longer is lost."""
FIRST_ECHO_TIMEOUT_S = 20.0
"""The first echo takes longer, because routers and participants have to find each other."""
END_MESSAGE = b"end"
WARM_UP_MESSAGES = 50


def command(sequence: int) -> bytes:
    """Encode a command like the driver's, with numbers that are as long on the wire as in a drive."""
    wall_ns = time.time_ns()
    path = tuple(0.01 + 0.001 * point for point in range(PATH_POINTS))
    return encode(Command(2**63 + 5, sequence, wall_ns, wall_ns - 1, wall_ns - 2, 0.123, 0.456, 0.01, path, "drive", 0))


def echo(end: CarrierEnd) -> None:
    """Send back every message, until the end message arrives or no message has arrived for a minute."""
    while (data := end.receive(60.0)) is not None and data != END_MESSAGE:
        end.send(data)


def round_trip_ns(end: CarrierEnd, sequence: int, timeout_s: float) -> int | None:
    """Send a command and return the time until its echo arrives; None if it is lost."""
    data = command(sequence)
    begin_ns = time.perf_counter_ns()
    end.send(data)
    while (echoed := end.receive(timeout_s)) is not None:
        if echoed == data:
            return time.perf_counter_ns() - begin_ns
    return None


def warm_up(end: CarrierEnd) -> None:
    """Send commands until the first echo arrives, and then 50 more; raise `SystemExit` if no echo arrives."""
    until_ns = time.monotonic_ns() + round(FIRST_ECHO_TIMEOUT_S * NS_PER_S)
    while round_trip_ns(end, 0, 0.1) is None:
        if time.monotonic_ns() > until_ns:
            raise SystemExit(f"no echo within {FIRST_ECHO_TIMEOUT_S:.0f} s")
    for sequence in range(WARM_UP_MESSAGES):
        round_trip_ns(end, sequence, ECHO_TIMEOUT_S)


def ask(end: CarrierEnd, seconds: float, messages: int) -> dict[str, list[int | None]]:
    """Return round trips in nanoseconds by pace: for `seconds` at 50 Hz, and for `messages` back to back.

    A lost echo is None.
    """
    warm_up(end)
    paced: list[int | None] = []
    begin_ns = time.monotonic_ns()
    for number in range(round(seconds * 50)):
        time.sleep(max(0, begin_ns + number * PERIOD_NS - time.monotonic_ns()) / NS_PER_S)
        paced.append(round_trip_ns(end, number, ECHO_TIMEOUT_S))
    return {
        "at_50_hz": paced,
        "back_to_back": [round_trip_ns(end, number, ECHO_TIMEOUT_S) for number in range(messages)],
    }


def main() -> None:
    """Ask or echo."""
    role, carrier, routers, *asking_arguments = sys.argv[1:]
    address = asking_arguments[0] if role == "ask" else ""
    end = CARRIERS[carrier].end(address, json.loads(routers))
    try:
        if role == "echo":
            print(json.dumps({"address": end.address}), flush=True)
            echo(end)
        else:
            _, seconds, messages = asking_arguments
            print(json.dumps(ask(end, float(seconds), int(messages))), flush=True)
            end.send(END_MESSAGE)
    finally:
        end.close()


if __name__ == "__main__":
    main()
